"""Published LiDAR checkpoints: which network they belong to, and their parameters by our names."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.presets import PRESETS
from lcf3d.detectors.openpcdet import translate
from lcf3d.errors import DetectorError
from lcf3d.networks.checkpoints import difference, differences, load_parameters, read_state_dict
from lcf3d.networks.torch import torch

LIDAR_DETECTORS = {
    "pointpillars": "lcf3d.detectors.lidar.pointpillars:PointPillars",
    "second": "lcf3d.detectors.lidar.second:SECOND",
    "ssn": "lcf3d.detectors.lidar.ssn:SSN",
    "centerpoint": "lcf3d.detectors.lidar.centerpoint:CenterPoint",
    "part-a2": "lcf3d.detectors.lidar.part_a2:PartA2",
    "pv-rcnn": "lcf3d.detectors.lidar.pv_rcnn:PVRCNN",
}
"""Architecture -> class of the detector."""


def published_names(state: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters by the names of our networks: without ``pts_``, and with OpenPCDet's names and layouts translated."""
    if any(name.startswith(("backbone_2d.", "dense_head.")) for name in state):
        return translate(state)
    return {name.removeprefix("pts_"): value for name, value in state.items()}


def fit_layouts(network: Any, state: Mapping[str, Any]) -> dict[str, Any]:
    """``state`` with sparse-convolution weights of spconv 2, (out, kz, ky, kx, in), as (kz, ky, kx, in, out)."""
    expected = network.state_dict()
    fitted = dict(state)
    for name, value in state.items():
        if name in expected and value.ndim == 5 and value.shape != expected[name].shape:
            turned = value.permute(1, 2, 3, 4, 0)
            if turned.shape == expected[name].shape:
                fitted[name] = turned.contiguous()
    return fitted


def load_published(network: Any, state: Mapping[str, Any], name: str) -> None:
    """Fill a LiDAR ``network`` with a published checkpoint's parameters, translated to our names and layouts.

    Raises:
        DetectorError: see `load_parameters`; the network is called ``name`` in the message.
    """
    load_parameters(network, fit_layouts(network, published_names(state)), f"the checkpoint for {name}")


def find_config(state: Mapping[str, Any], architecture: str | None = None) -> LidarConfig:
    """The configuration whose network has exactly the parameters of ``state``, by name and shape.

    Args:
        state: parameter name -> tensor.
        architecture: only networks of this kind; any without it.

    Raises:
        DetectorError: none fits; the message says how the nearest one differs.
    """

    names = published_names(state)
    foreign = any(name.startswith("dense_head.") for name in state)
    nearest: tuple[int, str, str] | None = None
    for config in PRESETS.values():
        if architecture is not None and config.architecture != architecture:
            continue
        if foreign != config.name.endswith("-openpcdet"):
            continue
        with torch.device("meta"):
            network = detector_class(config.architecture).build(config)
        fitted = fit_layouts(network, names)
        found = differences(network, fitted)
        count = sum(map(len, found))
        if count == 0:
            return config
        if nearest is None or count < nearest[0]:
            nearest = (count, config.name, difference(network, fitted))
    if nearest is None:
        raise DetectorError(f"no configuration of {architecture} is known for checkpoints of this origin")
    raise DetectorError(f"the checkpoint fits no known network; nearest is {nearest[1]}: {nearest[2]}")


def detector_class(architecture: str) -> Any:
    """The detector class of an architecture in `LIDAR_DETECTORS`."""
    module, _, name = LIDAR_DETECTORS[architecture].partition(":")
    return getattr(import_module(module), name)


def read_lidar_checkpoint(
    path: Path, preset: str | None = None, architecture: str | None = None
) -> tuple[dict[str, Any], LidarConfig]:
    """A checkpoint's parameters and the configuration of its network.

    Args:
        path: the file.
        preset: name of the configuration; found from the parameters without it.
        architecture: what the network must be, if anything.

    Raises:
        DetectorError: the file cannot be read, or fits no configuration, or another architecture.
    """
    require_architecture(preset, architecture)
    state = read_state_dict(path)
    return state, PRESETS[preset] if preset is not None else find_config(state, architecture)


def require_architecture(preset: str | None, architecture: str | None) -> None:
    """See that a preset, if one is named, is known and of an architecture, if one is wanted.

    Raises:
        DetectorError: it is not.
    """
    if preset is None:
        return
    if preset not in PRESETS:
        raise DetectorError(f"unknown preset {preset!r}; known: {', '.join(PRESETS)}")
    if architecture is not None and PRESETS[preset].architecture != architecture:
        raise DetectorError(f"{preset} is a {PRESETS[preset].architecture} network, not {architecture}")

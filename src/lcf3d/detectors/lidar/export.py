"""Export of the pillar networks to ONNX: everything between voxelization and decoding, with dynamic point numbers."""

# mypy: allow-subclassing-any
from __future__ import annotations

import json
from pathlib import Path

from lcf3d.detectors.lidar.compact import CompactNetwork, statistics_width
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.detector import TorchLidarDetector
from lcf3d.detectors.lidar.heads import center_channels
from lcf3d.detectors.lidar.onnx import CONFIG_KEY
from lcf3d.detectors.lidar.pillars import PillarNetwork
from lcf3d.errors import DetectorError, MissingExtraError
from lcf3d.files import atomic_path
from lcf3d.networks.torch import Tensor, nn, torch

OPSET = 18
"""First version whose scatter can take a maximum."""
INPUTS = {"points": ("features", "pillar", "padded", "cells"), "statistics": ("features", "cells")}
"""Names of the network's inputs by `LidarConfig.encoding`."""


class _Flat(nn.Module):
    """A pillar network with its output maps in one flat tuple."""

    def __init__(self, network: nn.Module, config: LidarConfig) -> None:
        super().__init__()
        self.network = network
        self.config = config

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Maps in the order of `output_names`."""
        flat: list[Tensor] = []
        for maps in self.network(*inputs):
            flat += [maps[name] for name in _center_names(self.config)] if isinstance(maps, dict) else maps
        return tuple(flat)


def output_names(detector: TorchLidarDetector) -> list[str]:
    """Names of the exported maps: ``LEVEL.KIND`` for anchors, ``TASK.KIND`` for centres."""
    config = detector.config
    if config.anchors is not None:
        return [f"{i}.{kind}" for i in range(len(config.anchors.levels)) for kind in ("cls", "reg", "dir")]
    assert config.centers is not None
    return [f"{i}.{kind}" for i in range(len(config.centers.tasks)) for kind in _center_names(config)]


def _center_names(config: LidarConfig) -> tuple[str, ...]:
    """The maps of one task of a centre head."""
    assert config.centers is not None
    return (*center_channels(config.centers), "heatmap")


def _example(config: LidarConfig) -> tuple[Tensor, ...]:
    """Inputs of two pillars to trace the network with."""
    cells = torch.tensor([0, 1])
    if config.encoding == "statistics":
        return torch.zeros(2, statistics_width(config)), cells
    return torch.zeros(3, len(config.channels) + 6), torch.tensor([0, 0, 1]), torch.ones(2, 1), cells


def export_onnx(detector: TorchLidarDetector, path: Path | str) -> None:
    """Write a detector on pillars as an ONNX file for `OnnxLidarDetector`.

    The configuration travels in the file's metadata. The network is exported as it is used: normalization folded.

    Raises:
        MissingExtraError: the package onnx is not installed.
        DetectorError: the network has sparse convolutions, for which ONNX has no operator.
    """
    if not isinstance(detector.network, (PillarNetwork, CompactNetwork)):
        raise DetectorError(
            f"{detector.config.name} has sparse convolutions, which ONNX cannot express; "
            "CompactPillars, PointPillars, SSN and CenterPoint with pillars can be exported"
        )
    try:
        import onnx
    except ModuleNotFoundError:
        raise MissingExtraError("onnx", "train", "exporting a network") from None
    network = detector.network.to("cpu")
    names = output_names(detector)
    inputs = INPUTS[detector.config.encoding]
    rows = "points" if detector.config.encoding == "points" else "pillars"
    axes = {name: {0: rows if name in ("features", "pillar") else "pillars"} for name in inputs}
    with atomic_path(Path(path)) as temporary:
        torch.onnx.export(
            _Flat(network, detector.config).eval(),
            _example(detector.config),
            str(temporary),
            input_names=list(inputs),
            output_names=names,
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(str(temporary))
        entry = model.metadata_props.add()
        entry.key, entry.value = CONFIG_KEY, json.dumps(detector.config.to_dict())
        onnx.save(model, str(temporary))
    detector.network.to(detector.device)

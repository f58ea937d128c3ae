"""Checkpoint files: reading them without executing code, and finding out what network they belong to."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcf3d.errors import DetectorError, MissingExtraError

if TYPE_CHECKING:
    from lcf3d.detectors.lidar.config import LidarConfig

SHOWN_NAMES = 5
"""Names listed in a message before it goes on with how many more there are."""

LIDAR_DETECTORS = {
    "pointpillars": "lcf3d.detectors.lidar.pointpillars:PointPillars",
    "second": "lcf3d.detectors.lidar.second:SECOND",
    "ssn": "lcf3d.detectors.lidar.ssn:SSN",
    "centerpoint": "lcf3d.detectors.lidar.centerpoint:CenterPoint",
    "part-a2": "lcf3d.detectors.lidar.part_a2:PartA2",
    "pv-rcnn": "lcf3d.detectors.lidar.pv_rcnn:PVRCNN",
}
"""Architecture -> class of the detector."""


class _Inert:
    """Stands for whatever a checkpoint holds beside tensors: training logs, settings, random states."""

    def __init__(self, *arguments: Any, **settings: Any) -> None: ...

    def __setstate__(self, state: Any) -> None: ...

    def __setitem__(self, key: Any, value: Any) -> None: ...

    def append(self, item: Any) -> None:
        """Take an item of a pickled list, and forget it."""

    def extend(self, items: Any) -> None:
        """Take items of a pickled list, and forget them."""


def read_state_dict(path: Path) -> dict[str, Any]:
    """Parameter name -> tensor (on the CPU) of a checkpoint file of torch.

    Nothing in the file is executed: only tensors and plain containers are built, and objects of any other class are
    replaced by empty ones.

    Raises:
        MissingExtraError: torch is not installed.
        DetectorError: no such file, a damaged one, or one without parameters.
    """
    try:
        import torch
    except ModuleNotFoundError:
        raise MissingExtraError("torch", "train", "reading a checkpoint") from None
    if not path.is_file():
        raise DetectorError(f"checkpoint {path} does not exist; lcf3d models get NAME downloads a published one")
    try:
        content = _load_inert(torch, path)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, AttributeError, TypeError, ImportError) as error:
        reason = str(error).splitlines()[0][:160] if str(error) else type(error).__name__
        raise _damaged(path, reason) from None
    except Exception as error:
        # torch raises pickle.UnpicklingError for globals that it refuses, and struct or zip errors for torn files
        if type(error).__name__ in {"UnpicklingError", "error", "BadZipFile"}:
            raise _damaged(path, str(error).splitlines()[0][:160]) from None
        raise
    for key in ("state_dict", "model_state", "model"):
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
            break
    if not isinstance(content, Mapping):
        raise DetectorError(f"checkpoint {path} holds no parameters (expected a mapping of names to tensors)")
    state = {str(name): value for name, value in content.items() if isinstance(value, torch.Tensor)}
    if not state:
        raise DetectorError(f"checkpoint {path} holds no parameters")
    return {name.removeprefix("module."): value for name, value in state.items()}


def _damaged(path: Path, reason: str) -> DetectorError:
    size = path.stat().st_size
    return DetectorError(
        f"checkpoint {path} ({size} bytes) cannot be read: damaged, only half downloaded, or not made of plain "
        f"tensors; download it again ({reason})"
    )


def _load_inert(torch: Any, path: Path) -> Any:
    """`torch.load` with ``weights_only``, every class it does not know replaced by `_Inert`."""
    stand_ins: list[tuple[type, str]] = []
    while True:
        try:
            with torch.serialization.safe_globals(list(stand_ins)):
                return torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:
            # the message names the class that was refused; anything else is for the caller
            refused = re.search(r"Unsupported global: GLOBAL ([\w.]+)", str(error))
            if refused is None or any(name == refused.group(1) for _, name in stand_ins):
                raise
            stand_ins.append((type("Inert", (_Inert,), {}), refused.group(1)))


def published_names(state: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters by the names of our networks: without ``pts_``, and with OpenPCDet's names and layouts translated."""
    if any(name.startswith(("backbone_2d.", "dense_head.")) for name in state):
        from lcf3d.detectors.openpcdet import translate

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


def load_parameters(network: Any, state: Mapping[str, Any], name: str) -> None:
    """Fill ``network`` (which may be on the meta device) with a checkpoint's parameters.

    Args:
        network: a torch module.
        state: parameter name -> tensor.
        name: what the network is called in the message.

    Raises:
        DetectorError: names or shapes differ; the message lists missing, unexpected and differently shaped ones.
            Or a parameter is not finite.
    """
    import torch

    state = fit_layouts(network, published_names(state))
    report = difference(network, state)
    if report:
        raise DetectorError(f"the checkpoint does not fit {name}: {report}")
    for key, value in state.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise DetectorError(f"parameter {key} of the checkpoint for {name} is NaN or infinite; use an earlier one")
    counters = {key: value for key, value in network.state_dict().items() if key.endswith("num_batches_tracked")}
    zeros = {key: _zeros(value) for key, value in counters.items() if key not in state}
    # half precision is for storage here: the networks compute in float32
    full = {key: value.float() if value.is_floating_point() else value for key, value in {**zeros, **state}.items()}
    network.load_state_dict({key: value.clone() for key, value in full.items()}, assign=True)


def _zeros(value: Any) -> Any:
    import torch

    return torch.zeros(value.shape, dtype=value.dtype)


def difference(network: Any, state: Mapping[str, Any]) -> str:
    """What keeps ``state`` from being loaded into ``network``, in words; empty when nothing does."""
    missing, unexpected, shapes = _differences(network, state)
    parts = (("missing", missing), ("unexpected", unexpected), ("of another shape", shapes))
    return "; ".join(f"{len(names)} {what}: {_listed(names)}" for what, names in parts if names)


def _differences(network: Any, state: Mapping[str, Any]) -> tuple[list[str], list[str], list[str]]:
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    missing = [key for key in expected if key not in state and not key.endswith("num_batches_tracked")]
    unexpected = [key for key in state if key not in expected]
    shapes = [
        f"{key} (expected {expected[key]}, got {tuple(state[key].shape)})"
        for key in expected
        if key in state and tuple(state[key].shape) != expected[key]
    ]
    return missing, unexpected, shapes


def _listed(names: list[str]) -> str:
    rest = len(names) - SHOWN_NAMES
    return ", ".join(names[:SHOWN_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def find_config(state: Mapping[str, Any], architecture: str | None = None) -> LidarConfig:
    """The configuration whose network has exactly the parameters of ``state``, by name and shape.

    Args:
        state: parameter name -> tensor.
        architecture: only networks of this kind; any without it.

    Raises:
        DetectorError: none fits; the message says how the nearest one differs.
    """
    import torch

    from lcf3d.detectors.lidar.presets import PRESETS

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
        differences = _differences(network, fitted)
        count = sum(map(len, differences))
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
    from lcf3d.detectors.lidar.presets import PRESETS

    if preset is not None and preset not in PRESETS:
        raise DetectorError(f"unknown preset {preset!r}; known: {', '.join(PRESETS)}")
    state = read_state_dict(path)
    config = PRESETS[preset] if preset is not None else find_config(state, architecture)
    if architecture is not None and config.architecture != architecture:
        raise DetectorError(f"preset {config.name} is a {config.architecture} network, not {architecture}")
    return state, config

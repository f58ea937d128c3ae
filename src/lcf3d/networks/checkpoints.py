"""Checkpoint files of torch: read without executing code in them, and put into networks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcf3d.errors import DetectorError, MissingExtraError
from lcf3d.networks.inert_pickle import Inert, LazyTensor, load_inert

TRAINING_FORMAT = "lcf3d-training-1"
"""What the checkpoints of our own trainings call themselves."""
SHOWN_NAMES = 5
"""Names listed in a message before it goes on with how many more there are."""


def read_state_dict(path: Path) -> dict[str, Any]:
    """Parameter name -> tensor (on the CPU) of a checkpoint file of torch.

    Nothing in the file is executed: only tensors and plain containers are built, and objects of any other class are
    replaced by empty ones.

    Raises:
        MissingExtraError: torch is not installed.
        DetectorError: no such file, a damaged one, or one without parameters.
    """
    if not path.is_file():
        raise DetectorError(f"checkpoint {path} does not exist; lcf3d models get NAME downloads a published one")
    try:
        content = load_inert(path)
        for key in ("state_dict", "model_state", "model"):
            if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
                content = content[key]
                break
        named = content.items() if isinstance(content, Mapping) else ()
        state = {str(name): value.load() for name, value in named if isinstance(value, LazyTensor)}
    except MissingExtraError:
        raise
    except Exception as error:
        # a torn file fails in pickle, zipfile, struct or torch, with errors of unrelated classes
        raise _damaged(path, str(error).splitlines()[0][:160] if str(error) else type(error).__name__) from None
    if not state:
        raise DetectorError(f"checkpoint {path} holds no parameters (expected a mapping of names to tensors)")
    return {name.removeprefix("module."): value for name, value in state.items()}


def read_notes(path: Path) -> tuple[str, tuple[str, ...]]:
    """What OpenMMLab's frameworks leave beside the parameters: the configuration's text, and the class names.

    Either is empty where the file tells none.

    Raises:
        DetectorError: the file cannot be read.
    """
    try:
        content = load_inert(path)
    except Exception as error:
        raise _damaged(path, type(error).__name__) from None
    meta = content.get("meta") if isinstance(content, Mapping) else None
    if not isinstance(meta, Mapping):
        return "", ()
    found = [meta.get("cfg"), meta.get("config")]
    for value in tuple(found):
        # a pickled Config holds its text among other things
        state = value.state if isinstance(value, Inert) else ()
        found += state.values() if isinstance(state, Mapping) else state if isinstance(state, (tuple, list)) else ()
    described = meta.get("dataset_meta")
    classes = described.get("classes") if isinstance(described, Mapping) else meta.get("CLASSES")
    names = tuple(classes) if isinstance(classes, (tuple, list)) else ()
    config = "\n".join(value for value in found if isinstance(value, str))
    return config, names if all(isinstance(name, str) for name in names) else ()


def _damaged(path: Path, reason: str) -> DetectorError:
    size = path.stat().st_size
    return DetectorError(
        f"checkpoint {path} ({size} bytes) cannot be read: damaged, only half downloaded, or not made of plain "
        f"tensors; download it again ({reason})"
    )


def read_training(path: Path) -> dict[str, Any]:
    """The content of a ``last.pt`` of our own trainings; no code in it is executed.

    Raises:
        DetectorError: the file is absent, damaged or no such checkpoint.
    """
    from lcf3d.networks.torch import torch

    if not path.is_file():
        raise DetectorError(f"training checkpoint {path} does not exist")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # torch raises errors of many unrelated classes for torn files
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise DetectorError(f"training checkpoint {path} is damaged ({reason})") from None
    if not isinstance(state, dict) or state.get("format") != TRAINING_FORMAT:
        raise DetectorError(f"{path} is no training checkpoint of lcf3d")
    return state


def load_parameters(network: Any, state: Mapping[str, Any], source: str) -> None:
    """Fill ``network`` (which may be on the meta device) with parameters of the same names and shapes.

    Args:
        network: a torch module.
        state: parameter name -> tensor.
        source: what they come from and what they are for, in the message.

    Raises:
        DetectorError: names or shapes differ; the message lists missing, unexpected and differently shaped ones.
            Or a parameter is not finite.
    """
    from lcf3d.networks.torch import torch

    report = difference(network, state)
    if report:
        raise DetectorError(f"{source} is of another architecture: {report}")
    for key, value in state.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise DetectorError(f"{source}: parameter {key} is NaN or infinite; use an earlier checkpoint")
    own = network.state_dict()
    zeros = {key: torch.zeros(value.shape, dtype=value.dtype) for key, value in own.items() if key not in state}
    # half precision is for storage here: the networks compute in float32
    full = {key: value.float() if value.is_floating_point() else value for key, value in {**zeros, **state}.items()}
    on_meta = any(value.is_meta for value in own.values())
    network.load_state_dict({key: value.clone() for key, value in full.items()} if on_meta else full, assign=on_meta)


def difference(network: Any, state: Mapping[str, Any]) -> str:
    """What keeps ``state`` from being loaded into ``network``, in words; empty when nothing does."""
    missing, unexpected, shapes = differences(network, state)
    parts = (("missing", missing), ("unexpected", unexpected), ("of another shape", shapes))
    return "; ".join(f"{len(names)} {what}: {_listed(names)}" for what, names in parts if names)


def differences(network: Any, state: Mapping[str, Any]) -> tuple[list[str], list[str], list[str]]:
    """Names of parameters that are missing, unexpected, and of another shape (with both shapes)."""
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

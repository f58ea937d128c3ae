"""The one place that imports torch and what belongs to it; says what to install where it is absent."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from lcf3d.errors import ConfigError, MissingExtraError

try:
    import torch
    from torch import Tensor, nn
    from torch.nn import functional
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise MissingExtraError("torch", "train", "a network in torch") from None

__all__ = ["Tensor", "count_flops", "functional", "nn", "summary_writer", "torch", "torch_device", "torchvision"]


def torch_device(name: str) -> Any:
    """The torch device of that name, which can be used.

    Raises:
        ConfigError: there is no such device on this machine, or this torch does not know it.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, ImportError) as error:
        # a torch without CUDA says so with an AssertionError
        reason = str(error).split("\n", 1)[0].split(". ", 1)[0]
        raise ConfigError(f"torch cannot use device {str(name)!r} here ({reason}); use device=cpu") from None
    return device


def torchvision() -> Any:
    """The module ``torchvision``.

    Raises:
        MissingExtraError: torchvision is not installed.
    """
    return _import("torchvision", "a camera detector of torch")


def summary_writer(folder: Path) -> Any:
    """A writer of TensorBoard's event files in a folder.

    Raises:
        MissingExtraError: tensorboard is not installed.
    """
    return _import("torch.utils.tensorboard", "training", package="tensorboard").SummaryWriter(str(folder))


def count_flops(run: Callable[[], object]) -> float:
    """Operations of convolutions and matrix products, a multiplication and an addition counted as two."""
    with import_module("torch.utils.flop_counter").FlopCounterMode(display=False) as counter:
        run()
    return float(counter.get_total_flops())


def _import(module: str, what: str, package: str | None = None) -> Any:
    try:
        return import_module(module)
    except ModuleNotFoundError:
        raise MissingExtraError(package or module, "train", what) from None

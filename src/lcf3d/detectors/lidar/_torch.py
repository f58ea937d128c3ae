"""The one place where the networks import torch, with a sentence saying what to install where it is absent."""

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

__all__ = ["Tensor", "functional", "nn", "torch", "torch_device"]


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

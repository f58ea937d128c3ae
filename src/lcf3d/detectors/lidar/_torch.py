"""The one place where the networks import torch, with a sentence saying what to install where it is absent."""

from lcf3d.errors import MissingExtraError

try:
    import torch
    from torch import Tensor, nn
    from torch.nn import functional
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    raise MissingExtraError("torch", "train", "a network in torch") from None

__all__ = ["Tensor", "functional", "nn", "torch"]

"""Folding batch normalization into the convolution or linear layer before it, for inference."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

from lcf3d.detectors.lidar.sparse import SparseConvolution
from lcf3d.networks.torch import nn, torch

_NORMS = (nn.BatchNorm1d, nn.BatchNorm2d)
_LAYERS = (nn.Conv1d, nn.Conv2d, nn.ConvTranspose2d, nn.Linear, SparseConvolution)
_NAMED_PAIRS = (("conv", "bn"), ("linear", "norm"), ("conv1", "bn1"), ("conv2", "bn2"), ("conv3", "bn3"))


def _pairs(module: nn.Module) -> Iterator[tuple[str, str]]:
    """Names of the children of ``module`` that are a layer and the normalization of its output."""
    if isinstance(module, nn.Sequential):
        names = list(module._modules)
        yield from pairwise(names)
    else:
        yield from (pair for pair in _NAMED_PAIRS if all(hasattr(module, name) for name in pair))


def normalized_layers(network: nn.Module) -> list[tuple[str, nn.Module, str, str]]:
    """Name and module that hold a layer and the normalization of its output, and the names of these two in it."""
    return [
        (name, module, layer, norm)
        for name, module in network.named_modules()
        for layer, norm in _pairs(module)
        if isinstance(module._modules.get(layer), _LAYERS) and isinstance(module._modules.get(norm), _NORMS)
    ]


def fuse_batch_norm(network: nn.Module) -> nn.Module:
    """``network`` (in evaluation mode) with every normalization folded into the layer before it."""
    for _, module, layer_name, norm_name in normalized_layers(network):
        _fold(module.get_submodule(layer_name), module.get_submodule(norm_name))
        module._modules[norm_name] = nn.Identity()
    return network


@torch.no_grad()
def _fold(layer: nn.Module, norm: nn.Module) -> None:
    """Put the scale and shift of ``norm`` into the weight and bias of ``layer``."""
    scale = norm.weight.double() / torch.sqrt(norm.running_var.double() + norm.eps)
    shift = norm.bias.double() - norm.running_mean.double() * scale
    bias = shift if layer.bias is None else shift + layer.bias.double() * scale
    shape = [1] * layer.weight.ndim
    shape[-1 if isinstance(layer, SparseConvolution) else 1 if isinstance(layer, nn.ConvTranspose2d) else 0] = -1
    weight = layer.weight.double() * scale.reshape(shape)
    layer.weight = nn.Parameter(weight.to(layer.weight.dtype), requires_grad=False)
    layer.bias = nn.Parameter(bias.to(layer.weight.dtype), requires_grad=False)

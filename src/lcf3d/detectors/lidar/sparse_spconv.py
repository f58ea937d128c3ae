"""The sparse convolutions of `sparse`, computed by spconv 2 where it is installed and the features are on a GPU.

On the CPU the torch form of `sparse` is always used: spconv (2.3.8) adds rows there from several threads through
pointers that the threads share, so that with two threads or more some sums are wrong, others in every run.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from lcf3d.detectors.lidar.sparse_sites import Sites, Triple
from lcf3d.networks.torch import Tensor, nn, torch

_STRIDED = "strided"
"""Under this name the sites that a strided convolution made keep how they were made, for the way back."""


def spconv_for(features: Tensor) -> Any | None:
    """``spconv.pytorch``, if it is installed and shall convolve these (N, C) features; else None."""
    return _library() if features.is_cuda and len(features) else None


@cache
def _library() -> Any | None:
    try:
        return import_module("spconv.pytorch")
    except ImportError:
        return None


def submanifold(library: Any, weight: Tensor, features: Tensor, sites: Sites) -> Tensor:
    """(N, out) convolution at the sites of the input.

    Args:
        library: of `spconv_for`.
        weight: (kz, ky, kx, in, out).
        features: (N, in) at ``sites``.
        sites: keep which input meets which output, for further convolutions with such a kernel.
    """
    kernel = tuple(weight.shape[:3])
    key = f"submanifold {kernel}"
    half = [k // 2 for k in kernel]
    with torch.device("meta"):
        conv = library.SubMConv3d(*weight.shape[3:], list(kernel), padding=half, bias=False, indice_key=key)
    result = _run(conv, weight, _tensor(library, features, sites, sites.spconv_indices))
    sites.spconv_indices.update(result.indice_dict)
    return _features(result)


def strided(
    library: Any, weight: Tensor, features: Tensor, sites: Sites, *, stride: Triple, padding: Triple
) -> tuple[Tensor, Tensor, Triple, dict[str, Any]]:
    """Features (M, out), cells (M, 4) and grid of the outputs wherever an input is reached, and how they were made.

    The outputs stand in spconv's order, which on a GPU is not that of the inputs.
    """
    with torch.device("meta"):
        layer = library.SparseConv3d(
            *weight.shape[3:],
            list(weight.shape[:3]),
            stride=list(stride),
            padding=list(padding),
            bias=False,
            indice_key=_STRIDED,
        )
    result = _run(layer, weight, _tensor(library, features, sites, {}))
    depth, height, width = (int(cells) for cells in result.spatial_shape)
    made = {_STRIDED: result.indice_dict[_STRIDED]}
    return _features(result), result.indices.long(), (depth, height, width), made


def inverse(library: Any, weight: Tensor, features: Tensor, sites: Sites) -> Tensor:
    """(N, out) convolution from sites that `strided` made back to those that it made them from."""
    with torch.device("meta"):
        conv = library.SparseInverseConv3d(*weight.shape[3:], list(weight.shape[:3]), bias=False, indice_key=_STRIDED)
    made = {_STRIDED: sites.spconv_indices[_STRIDED]}
    return _features(_run(conv, weight, _tensor(library, features, sites, made)))


def _tensor(library: Any, features: Tensor, sites: Sites, indices: dict[str, Any]) -> Any:
    batch = int(sites.coordinates[:, 0].max()) + 1
    cells = sites.coordinates.int().contiguous()
    return library.SparseConvTensor(features.contiguous(), cells, list(sites.shape), batch, indice_dict=dict(indices))


def _run(conv: nn.Module, weight: Tensor, tensor: Any) -> Any:
    """The convolution with our weights in spconv's layout (out, kz, ky, kx, in)."""
    conv.train(weight.requires_grad and torch.is_grad_enabled())
    parameters = {"weight": weight.permute(4, 0, 1, 2, 3).contiguous()}
    return torch.func.functional_call(conv, parameters, (tensor,))


def _features(tensor: Any) -> Tensor:
    features: Tensor = tensor.features
    return features

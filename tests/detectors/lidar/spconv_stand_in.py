"""As much of spconv 2's ``spconv.pytorch`` as the networks use, with its rules, computed by dense convolutions.

Written after spconv 2.3.8: weights are (out, kz, ky, kx, in), coordinates int32 ``batch, z, y, x``, what a layer worked
out stands in the tensor's ``indice_dict`` under the layer's key. Outputs stand in another order than in `sparse`, so
that nothing can depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.nn import functional


@dataclass(frozen=True)
class Made:
    """What a layer worked out: between which cells, and how."""

    indices: torch.Tensor
    out_indices: torch.Tensor
    shape: list[int]
    kernel: list[int]
    stride: list[int]
    padding: list[int]
    is_subm: bool


@dataclass(frozen=True)
class SparseConvTensor:
    """Features (N, C) at int32 cells (N, 4)."""

    features: torch.Tensor
    indices: torch.Tensor
    spatial_shape: list[int]
    batch_size: int
    indice_dict: dict[str, Made]

    def __post_init__(self) -> None:
        assert self.indices.dtype == torch.int32
        assert self.features.ndim == 2
        assert len(self.spatial_shape) == 3
        assert self.features.is_contiguous()
        assert int(self.indices[:, 0].max()) < self.batch_size

    def dense(self) -> torch.Tensor:
        """(B, C, D, H, W)."""
        dense = self.features.new_zeros(self.batch_size, *self.spatial_shape, self.features.shape[1])
        return dense.index_put(self.indices.long().unbind(1), self.features).permute(0, 4, 1, 2, 3)


def at_cells(dense: torch.Tensor, indices: torch.Tensor) -> torch.Tensor:
    """(N, C) values of a dense map at (N, 4) cells."""
    batch, z, y, x = indices.long().unbind(1)
    return dense[batch, :, z, y, x]


class _Convolution(nn.Module):
    def __init__(self, in_channels, out_channels, kernel_size, stride, padding, bias, indice_key) -> None:
        super().__init__()
        assert not bias
        assert indice_key is not None
        self.weight = nn.Parameter(torch.zeros(out_channels, *kernel_size, in_channels))
        self.kernel, self.stride, self.padding, self.key = kernel_size, stride, padding, indice_key


class SubMConv3d(_Convolution):
    """Outputs at the cells of the input; a known key must be of the same cells and kernel."""

    def __init__(self, in_channels, out_channels, kernel_size, stride=1, padding=0, bias=True, indice_key=None) -> None:
        assert stride == 1
        super().__init__(in_channels, out_channels, kernel_size, [1, 1, 1], padding, bias, indice_key)

    def forward(self, x: SparseConvTensor) -> SparseConvTensor:
        """The padding is the kernel's half, whatever was said."""
        known = x.indice_dict.get(self.key)
        if known is None:
            half = [k // 2 for k in self.kernel]
            known = Made(x.indices, x.indices, x.spatial_shape, self.kernel, self.stride, half, True)
        assert known.is_subm
        assert known.kernel == self.kernel
        assert torch.equal(known.indices, x.indices)
        full = functional.conv3d(x.dense(), self.weight.permute(0, 4, 1, 2, 3), padding=tuple(known.padding))
        return replace(x, features=at_cells(full, x.indices), indice_dict={**x.indice_dict, self.key: known})


class SparseConv3d(_Convolution):
    """Outputs wherever an input is reached; its key must be new."""

    def __init__(self, in_channels, out_channels, kernel_size, stride=1, padding=0, bias=True, indice_key=None) -> None:
        super().__init__(in_channels, out_channels, kernel_size, stride, padding, bias, indice_key)

    def forward(self, x: SparseConvTensor) -> SparseConvTensor:
        """Outputs from the last cell to the first."""
        assert self.key not in x.indice_dict
        options = {"stride": tuple(self.stride), "padding": tuple(self.padding)}
        full = functional.conv3d(x.dense(), self.weight.permute(0, 4, 1, 2, 3), **options)
        occupied = replace(x, features=x.features.new_ones(len(x.features), 1)).dense()
        reached = functional.conv3d(occupied, occupied.new_ones(1, 1, *self.kernel), **options)[:, 0] > 0.5
        cells = torch.nonzero(reached).flip(0).int()
        made = Made(x.indices, cells, x.spatial_shape, self.kernel, self.stride, self.padding, False)
        return SparseConvTensor(
            at_cells(full, cells), cells, list(full.shape[2:]), x.batch_size, {**x.indice_dict, self.key: made}
        )


class SparseInverseConv3d(_Convolution):
    """Back from the outputs of the `SparseConv3d` with the same key."""

    def __init__(self, in_channels, out_channels, kernel_size, indice_key, bias=True) -> None:
        super().__init__(in_channels, out_channels, kernel_size, None, None, bias, indice_key)

    def forward(self, x: SparseConvTensor) -> SparseConvTensor:
        """Outputs in the order of that layer's inputs."""
        made = x.indice_dict[self.key]
        assert not made.is_subm
        assert made.kernel == self.kernel
        assert torch.equal(made.out_indices, x.indices)
        spare = [
            fine - ((coarse - 1) * s - 2 * p + k)
            for fine, coarse, s, p, k in zip(
                made.shape, x.spatial_shape, made.stride, made.padding, made.kernel, strict=True
            )
        ]
        full = functional.conv_transpose3d(
            x.dense(),
            self.weight.permute(4, 0, 1, 2, 3),
            stride=tuple(made.stride),
            padding=tuple(made.padding),
            output_padding=tuple(spare),
        )
        return replace(x, features=at_cells(full, made.indices), indices=made.indices, spatial_shape=made.shape)

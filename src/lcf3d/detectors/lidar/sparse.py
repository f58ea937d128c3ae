"""Sparse 3D convolution in plain torch: gather the inputs of every output, multiply with the kernel.

Sites (the active cells) know which input meets which output at every kernel offset; this is worked out once and shared
by all convolutions between the same sites. Weights are (kz, ky, kx, in, out). On a GPU with spconv installed, spconv
does the same (`sparse_spconv`).
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lcf3d.detectors.lidar import sparse_spconv
from lcf3d.detectors.lidar._torch import Tensor, functional, nn, torch

Triple = tuple[int, int, int]
GATHERED = 1 << 22
"""Numbers gathered at once; more rows than fit are taken in turns."""


class Sites:
    """Active cells of a sparse tensor.

    Args:
        coordinates: (N, 4) int64 ``batch, z, y, x``, all different.
        shape: cells along z, y, x.
        spconv_indices: what spconv has worked out about these sites.
    """

    def __init__(self, coordinates: Tensor, shape: Triple, spconv_indices: dict[str, Any] | None = None) -> None:
        self.coordinates = coordinates
        self.shape = shape
        self.spconv_indices = {} if spconv_indices is None else spconv_indices
        self._sorted_keys, self._order = torch.sort(flat_keys(coordinates, shape))
        self._submanifold: dict[Triple, Tensor] = {}
        self._strided: dict[tuple[Triple, Triple, Triple], tuple[Sites, Tensor]] = {}

    def __len__(self) -> int:
        return len(self.coordinates)

    def find(self, keys: Tensor) -> Tensor:
        """Index of the site with each of the flat keys, -1 where there is none."""
        if not len(self):
            return torch.full_like(keys, -1)
        position = torch.searchsorted(self._sorted_keys, keys).clamp_(max=len(self) - 1)
        return torch.where(self._sorted_keys[position] == keys, self._order[position], -1)

    def submanifold_table(self, kernel: Triple) -> Tensor:
        """(N, K) input of each site at each offset of an odd kernel; N where there is none."""
        if kernel not in self._submanifold:
            offsets = kernel_offsets(kernel, self.coordinates.device)
            half = len(offsets) // 2
            steps = offsets[:half] - torch.tensor(kernel, device=offsets.device) // 2
            cells = self.coordinates[None].repeat(half, 1, 1)
            cells[:, :, 1:] += steps[:, None]
            flat = cells.reshape(-1, 4)
            found = torch.where(inside(flat, self.shape), self.find(flat_keys(flat, self.shape)), -1).reshape(half, -1)
            table = torch.full((len(self), len(offsets)), len(self), device=offsets.device)
            table[:, half] = torch.arange(len(self), device=offsets.device)
            offset, output = torch.nonzero(found >= 0, as_tuple=True)
            source = found[offset, output]
            table[output, offset] = source
            # offset k from A to B is the mirrored offset from B to A
            table[source, len(offsets) - 1 - offset] = output
            self._submanifold[kernel] = table
        return self._submanifold[kernel]

    def strided_table(self, kernel: Triple, stride: Triple, padding: Triple) -> tuple[Sites, Tensor]:
        """Output sites, every cell that an input reaches, and the output of each input at each offset (N, K).

        Where an input reaches none, the table holds the number of outputs.
        """
        key = (kernel, stride, padding)
        if key not in self._strided:
            self._strided[key] = self._stride(kernel, stride, padding)
        return self._strided[key]

    def _stride(self, kernel: Triple, stride: Triple, padding: Triple) -> tuple[Sites, Tensor]:
        sizes = [(n + 2 * p - k) // s + 1 for n, k, s, p in zip(self.shape, kernel, stride, padding, strict=True)]
        shape = (sizes[0], sizes[1], sizes[2])
        offsets = kernel_offsets(kernel, self.coordinates.device)
        cells = self.coordinates[None].repeat(len(offsets), 1, 1)
        cells[:, :, 1:] += (torch.tensor(padding, device=offsets.device) - offsets)[:, None]
        step = torch.tensor(stride, device=offsets.device)
        whole = (cells[:, :, 1:] % step == 0).all(dim=2)
        cells[:, :, 1:] = torch.div(cells[:, :, 1:], step, rounding_mode="floor")
        reached = whole & inside(cells.reshape(-1, 4), shape).reshape(whole.shape)
        offset, inputs = torch.nonzero(reached, as_tuple=True)
        keys, inverse = torch.unique(flat_keys(cells[reached], shape), return_inverse=True)
        # outputs stand in the order in which the inputs first reach them, as in the original
        arrival = inputs * len(offsets) + offset
        first = torch.full_like(keys, len(self) * len(offsets)).scatter_reduce(0, inverse, arrival, "amin")
        order = first.argsort()
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order), device=order.device)
        table = torch.full((len(self), len(offsets)), len(order), device=offsets.device)
        table[inputs, offset] = rank[inverse]
        return Sites(coordinates_of(keys[order], shape), shape), table


def swap_table(table: Tensor, rows: int) -> Tensor:
    """The table of the opposite direction: (rows, K) from one of N rows with entries below ``rows`` or none."""
    source, offset = torch.nonzero(table < rows, as_tuple=True)
    swapped = torch.full((rows, table.shape[1]), len(table), device=table.device)
    swapped[table[source, offset], offset] = source
    return swapped


def kernel_offsets(kernel: Triple, device: Any) -> Tensor:
    """(K, 3) offsets of a kernel along z, y, x, in row-major order."""
    return torch.cartesian_prod(*(torch.arange(k, device=device) for k in kernel)).reshape(-1, 3)


def flat_keys(coordinates: Tensor, shape: Triple) -> Tensor:
    """(N,) one number for each (N, 4) cell."""
    batch, z, y, x = coordinates.unbind(1)
    return ((batch * shape[0] + z) * shape[1] + y) * shape[2] + x


def coordinates_of(keys: Tensor, shape: Triple) -> Tensor:
    """(N, 4) cells of flat keys."""
    rest, x = torch.div(keys, shape[2], rounding_mode="floor"), keys % shape[2]
    rest, y = torch.div(rest, shape[1], rounding_mode="floor"), rest % shape[1]
    return torch.stack([torch.div(rest, shape[0], rounding_mode="floor"), rest % shape[0], y, x], dim=1)


def inside(coordinates: Tensor, shape: Triple) -> Tensor:
    """(N,) whether each (N, 4) cell lies in the grid."""
    cells = coordinates[:, 1:]
    return ((cells >= 0) & (cells < torch.tensor(shape, device=cells.device))).all(dim=1)


@dataclass(frozen=True)
class SparseTensor:
    """(N, C) features at N sites."""

    features: Tensor
    sites: Sites

    def with_features(self, features: Tensor) -> SparseTensor:
        """Other features at the same sites."""
        return SparseTensor(features, self.sites)

    def dense(self, batch: int = 1) -> Tensor:
        """(batch, C, D, H, W) with zero where there is no site."""
        depth, height, width = self.sites.shape
        channels = self.features.shape[1]
        flat = self.features.new_zeros(batch * depth * height * width, channels)
        flat[flat_keys(self.sites.coordinates, self.sites.shape)] = self.features
        return flat.reshape(batch, depth, height, width, channels).permute(0, 4, 1, 2, 3).contiguous()


class SparseConvolution(nn.Module):
    """Weights of a sparse convolution (kz, ky, kx, in, out), and the sum over the inputs of each output."""

    def __init__(self, in_channels: int, out_channels: int, kernel: Triple = (3, 3, 3)) -> None:
        super().__init__()
        self.kernel = kernel
        self.weight = nn.Parameter(torch.empty(*kernel, in_channels, out_channels))
        self.register_parameter("bias", None)
        if not self.weight.is_meta:
            nn.init.kaiming_uniform_(self.weight.view(-1, out_channels))

    def convolve(self, features: Tensor, table: Tensor) -> Tensor:
        """(M, out) sums over the inputs of each output; the (M, K) table holds N where there is none."""
        weight = self.weight.reshape(-1, self.weight.shape[-1])
        padded = torch.cat([features, features.new_zeros(1, features.shape[1])])
        rows = max(1, GATHERED // len(weight))
        parts = []
        for chunk in table.split(rows):
            gathered = padded[chunk.reshape(-1)].reshape(len(chunk), len(weight))
            parts.append(functional.linear(gathered, weight.t(), self.bias))
        return torch.cat(parts)

    def biased(self, features: Tensor) -> Tensor:
        """(M, out) features with the bias, if normalization was folded into one."""
        return features if self.bias is None else features + self.bias


class SubmanifoldConv(SparseConvolution):
    """Convolution whose outputs are the sites of its input (Graham et al., 2018)."""

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features at the same sites."""
        library = sparse_spconv.spconv_for(x.features)
        if library is not None:
            return x.with_features(self.biased(sparse_spconv.submanifold(library, self.weight, x.features, x.sites)))
        return x.with_features(self.convolve(x.features, x.sites.submanifold_table(self.kernel)))


class StridedConv(SparseConvolution):
    """Convolution with outputs wherever an input is reached."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel: Triple = (3, 3, 3),
        stride: Triple = (2, 2, 2),
        padding: Triple = (1, 1, 1),
    ) -> None:
        super().__init__(in_channels, out_channels, kernel)
        self.stride = stride
        self.padding = padding

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features at the output sites."""
        library = sparse_spconv.spconv_for(x.features)
        if library is not None:
            features, cells, shape, made = sparse_spconv.strided(library, self, x.features, x.sites)
            return SparseTensor(self.biased(features), Sites(cells, shape, made))
        sites, table = x.sites.strided_table(self.kernel, self.stride, self.padding)
        return SparseTensor(self.convolve(x.features, swap_table(table, len(sites))), sites)


class InverseConv(SparseConvolution):
    """Convolution back from the outputs of a `StridedConv` to its inputs, over the same pairs."""

    def forward(self, x: SparseTensor, fine: Sites, strided: StridedConv) -> SparseTensor:
        """Features at the ``fine`` sites, from which ``strided`` made those of ``x``."""
        library = sparse_spconv.spconv_for(x.features)
        if library is not None:
            return SparseTensor(self.biased(sparse_spconv.inverse(library, self.weight, x.features, x.sites)), fine)
        _, table = fine.strided_table(strided.kernel, strided.stride, strided.padding)
        return SparseTensor(self.convolve(x.features, table), fine)


class SparseBlock(nn.Sequential):
    """Sparse convolution, batch normalization and ReLU."""

    def __init__(self, conv: SparseConvolution) -> None:
        channels = conv.weight.shape[-1]
        super().__init__(conv, nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01), nn.ReLU(inplace=True))

    def forward(self, x: SparseTensor, *arguments: object) -> SparseTensor:
        """The convolution's output, normalized and rectified; further arguments go to the convolution."""
        x = self[0](x, *arguments)
        return x.with_features(functional.relu(self[1](x.features)))


class SparseResidualBlock(nn.Module):
    """Two submanifold convolutions with a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = SubmanifoldConv(channels, channels)
        self.bn1 = nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)
        self.conv2 = SubmanifoldConv(channels, channels)
        self.bn2 = nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features at the same sites."""
        y = self.conv1(x)
        y = self.conv2(y.with_features(functional.relu(self.bn1(y.features))))
        return x.with_features(functional.relu(self.bn2(y.features) + x.features))

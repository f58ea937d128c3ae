"""Sparse 3D convolution in plain torch: for each kernel offset gather the inputs, multiply, add to the outputs.

Sites (the active cells) know which input meets which output at every kernel offset; this is worked out once and shared
by all convolutions between the same sites. Weights are (kz, ky, kx, in, out).
"""

# mypy: allow-subclassing-any
from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from lcf3d.detectors.lidar._torch import Tensor, functional, nn, torch

Triple = tuple[int, int, int]
Pairs = list[tuple[Tensor, Tensor]]
"""For each kernel offset, in row-major order, indices of the input and of the output sites that it connects."""


class Sites:
    """Active cells of a sparse tensor.

    Args:
        coordinates: (N, 4) int64 ``batch, z, y, x``, all different.
        shape: cells along z, y, x.
    """

    def __init__(self, coordinates: Tensor, shape: Triple) -> None:
        self.coordinates = coordinates
        self.shape = shape
        self._sorted_keys, self._order = torch.sort(flat_keys(coordinates, shape))
        self._submanifold: dict[Triple, Pairs] = {}
        self._strided: dict[tuple[Triple, Triple, Triple], tuple[Sites, Pairs]] = {}

    def __len__(self) -> int:
        return len(self.coordinates)

    def find(self, keys: Tensor) -> Tensor:
        """Index of the site with each of the flat keys, -1 where there is none."""
        if not len(self):
            return torch.full_like(keys, -1)
        position = torch.searchsorted(self._sorted_keys, keys).clamp_(max=len(self) - 1)
        return torch.where(self._sorted_keys[position] == keys, self._order[position], -1)

    def submanifold_pairs(self, kernel: Triple) -> Pairs:
        """Pairs of a convolution whose outputs are these same sites (odd kernel, stride 1)."""
        if kernel not in self._submanifold:
            offsets = list(itertools.product(*(range(k) for k in kernel)))
            center = len(offsets) // 2
            everything = torch.arange(len(self), device=self.coordinates.device)
            first_half: Pairs = []
            for offset in offsets[:center]:
                step = [o - k // 2 for o, k in zip(offset, kernel, strict=True)]
                first_half.append(self._neighbours(step, everything))
            # offset k from A to B is the mirrored offset from B to A
            mirrored = [(outputs, inputs) for inputs, outputs in reversed(first_half)]
            self._submanifold[kernel] = [*first_half, (everything, everything), *mirrored]
        return self._submanifold[kernel]

    def _neighbours(self, step: Sequence[int], everything: Tensor) -> tuple[Tensor, Tensor]:
        cells = self.coordinates.clone()
        cells[:, 1:] += torch.tensor(step, device=cells.device)
        found = torch.where(inside(cells, self.shape), self.find(flat_keys(cells, self.shape)), -1)
        connected = found >= 0
        return found[connected], everything[connected]

    def strided_pairs(self, kernel: Triple, stride: Triple, padding: Triple) -> tuple[Sites, Pairs]:
        """Output sites, every cell that an input reaches, and the pairs of a strided convolution."""
        key = (kernel, stride, padding)
        if key not in self._strided:
            shape = tuple(
                (n + 2 * p - k) // s + 1 for n, k, s, p in zip(self.shape, kernel, stride, padding, strict=True)
            )
            reached = [
                self._reached(offset, (shape[0], shape[1], shape[2]), stride, padding)
                for offset in itertools.product(*(range(k) for k in kernel))
            ]
            keys, inverse = torch.unique(torch.cat([keys for keys, _ in reached]), return_inverse=True)
            # outputs stand in the order in which the inputs first reach them, as in the original
            arrival = torch.cat([inputs * len(reached) + k for k, (_, inputs) in enumerate(reached)])
            first = torch.full_like(keys, arrival.max() + 1 if len(arrival) else 0)
            order = first.scatter_reduce(0, inverse, arrival, "amin").argsort()
            rank = torch.empty_like(order)
            rank[order] = torch.arange(len(order), device=order.device)
            keys, inverse = keys[order], rank[inverse]
            outputs = inverse.split([len(keys) for keys, _ in reached])
            sites = Sites(coordinates_of(keys, (shape[0], shape[1], shape[2])), (shape[0], shape[1], shape[2]))
            pairs = [(inputs, output) for (_, inputs), output in zip(reached, outputs, strict=True)]
            self._strided[key] = (sites, pairs)
        return self._strided[key]

    def _reached(self, offset: Sequence[int], shape: Triple, stride: Triple, padding: Triple) -> tuple[Tensor, Tensor]:
        """Flat keys of the output cells that meet an input at a kernel offset, and the index of that input."""
        device = self.coordinates.device
        step = torch.tensor(stride, device=device)
        cells = self.coordinates.clone()
        cells[:, 1:] += torch.tensor(padding, device=device) - torch.tensor(offset, device=device)
        whole = (cells[:, 1:] % step == 0).all(dim=1)
        cells[:, 1:] = torch.div(cells[:, 1:], step, rounding_mode="floor")
        inputs = torch.nonzero(whole & inside(cells, shape)).squeeze(1)
        return flat_keys(cells[inputs], shape), inputs


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
    """Weights of a sparse convolution (kz, ky, kx, in, out) and the gather, multiply, add over its pairs."""

    def __init__(self, in_channels: int, out_channels: int, kernel: Triple = (3, 3, 3)) -> None:
        super().__init__()
        self.kernel = kernel
        self.weight = nn.Parameter(torch.empty(*kernel, in_channels, out_channels))
        self.register_parameter("bias", None)
        if not self.weight.is_meta:
            nn.init.kaiming_uniform_(self.weight.view(-1, out_channels))

    def convolve(self, features: Tensor, pairs: Pairs, outputs: int) -> Tensor:
        """(outputs, out) sums over the pairs of every kernel offset."""
        weights = self.weight.reshape(-1, *self.weight.shape[-2:])
        result = features.new_zeros(outputs, weights.shape[-1])
        if self.bias is not None:
            result += self.bias
        for weight, (source, target) in zip(weights, pairs, strict=True):
            if len(source):
                result.index_add_(0, target, features[source] @ weight)
        return result


class SubmanifoldConv(SparseConvolution):
    """Convolution whose outputs are the sites of its input (Graham et al., 2018)."""

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features at the same sites."""
        pairs = x.sites.submanifold_pairs(self.kernel)
        return x.with_features(self.convolve(x.features, pairs, len(x.sites)))


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
        sites, pairs = x.sites.strided_pairs(self.kernel, self.stride, self.padding)
        return SparseTensor(self.convolve(x.features, pairs, len(sites)), sites)


class InverseConv(SparseConvolution):
    """Convolution back from the outputs of a `StridedConv` to its inputs, over the same pairs."""

    def forward(self, x: SparseTensor, fine: Sites, strided: StridedConv) -> SparseTensor:
        """Features at the ``fine`` sites, from which ``strided`` made those of ``x``."""
        _, pairs = fine.strided_pairs(strided.kernel, strided.stride, strided.padding)
        swapped = [(outputs, inputs) for inputs, outputs in pairs]
        return SparseTensor(self.convolve(x.features, swapped, len(fine)), fine)


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

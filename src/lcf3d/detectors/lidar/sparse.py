"""Sparse 3D convolution in plain torch: gather the inputs of every output, multiply with the kernel.

Sites (the active cells) know which input meets which output at every kernel offset; this is worked out once and shared
by all convolutions between the same sites. Weights are (kz, ky, kx, in, out). On a GPU with spconv installed, spconv
does the same (`sparse_spconv`).
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from dataclasses import dataclass

from lcf3d.detectors.lidar import sparse_spconv
from lcf3d.detectors.lidar.sparse_sites import Sites, Triple, flat_keys, swap_table
from lcf3d.networks.torch import Tensor, functional, nn, torch

GATHERED = 1 << 22
"""Numbers gathered at once; more rows than fit are taken in turns."""


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
            features, cells, shape, made = sparse_spconv.strided(
                library, self.weight, x.features, x.sites, stride=self.stride, padding=self.padding
            )
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

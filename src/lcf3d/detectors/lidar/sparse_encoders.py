"""The sparse 3D encoders between the voxels and the bird's-eye-view map."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Iterator

from lcf3d.detectors.lidar.config import VoxelSpec
from lcf3d.detectors.lidar.sparse import SparseBlock, SparseResidualBlock, SparseTensor, StridedConv, SubmanifoldConv
from lcf3d.detectors.lidar.sparse_sites import Sites, Triple
from lcf3d.networks.torch import Tensor, nn, torch

_PADDINGS: tuple[Triple, ...] = ((1, 1, 1), (1, 1, 1), (0, 1, 1))
"""Of the three strided convolutions; the last does not pad the height, so that 41 cells become 2 in the end."""


def sparse_shape(voxels: VoxelSpec) -> Triple:
    """Cells along z, y, x; one more in height than there are voxels, which the strided convolutions need."""
    nx, ny, nz = voxels.grid
    return nz + 1, ny, nx


def sparse_input(features: Tensor, coordinates: Tensor, shape: Triple) -> SparseTensor:
    """One cloud's voxel features (V, C) at (V, 3) ``z, y, x`` as a sparse tensor."""
    return SparseTensor(features, Sites(nn.functional.pad(coordinates, (1, 0)), shape))


def _plain_stages() -> Iterator[nn.Sequential]:
    """Stages of SECOND: a strided convolution (but in the first stage), then submanifold ones."""
    yield nn.Sequential(SparseBlock(SubmanifoldConv(16, 16)))
    for before, after, padding in zip((16, 32, 64), (32, 64, 64), _PADDINGS, strict=True):
        yield nn.Sequential(
            SparseBlock(StridedConv(before, after, padding=padding)),
            SparseBlock(SubmanifoldConv(after, after)),
            SparseBlock(SubmanifoldConv(after, after)),
        )


def _residual_stages() -> Iterator[nn.Sequential]:
    """Stages of CenterPoint: two residual blocks, then a strided convolution (but in the last stage)."""
    for before, after, padding in zip((16, 32, 64), (32, 64, 128), _PADDINGS, strict=True):
        blocks = (SparseResidualBlock(before), SparseResidualBlock(before))
        yield nn.Sequential(*blocks, SparseBlock(StridedConv(before, after, padding=padding)))
    yield nn.Sequential(SparseResidualBlock(128), SparseResidualBlock(128))


class SparseEncoder(nn.Module):
    """Three halvings of the grid, then the height folded into the channels (section 3.2.1 of the SECOND paper).

    Args:
        in_channels: channels of a voxel.
        shape: the grid, see `sparse_shape`.
        residual: the deeper form of CenterPoint.
    """

    def __init__(self, in_channels: int, shape: Triple, residual: bool = False) -> None:
        super().__init__()
        self.shape = shape
        self.conv_input = SparseBlock(SubmanifoldConv(in_channels, 16))
        self.encoder_layers = nn.Sequential()
        for i, stage in enumerate(_residual_stages() if residual else _plain_stages(), start=1):
            self.encoder_layers.add_module(f"encoder_layer{i}", stage)
        last = 128 if residual else 64
        self.conv_out = SparseBlock(StridedConv(last, 128, (3, 1, 1), (2, 1, 1), (0, 0, 0)))

    def stages(self, features: Tensor, coordinates: Tensor) -> list[SparseTensor]:
        """The sparse output of every stage, from (V, C) voxel features at (V, 3) ``z, y, x``."""
        x = self.conv_input(sparse_input(features, coordinates, self.shape))
        outputs = []
        for stage in self.encoder_layers:
            x = stage(x)
            outputs.append(x)
        return outputs

    def flatten(self, x: SparseTensor) -> Tensor:
        """(1, 256, H / 8, W / 8) bird's-eye-view map of the last stage."""
        return self.conv_out(x).dense().flatten(1, 2).contiguous(memory_format=torch.channels_last)

    def forward(self, features: Tensor, coordinates: Tensor) -> Tensor:
        """(1, 256, H / 8, W / 8) bird's-eye-view map."""
        return self.flatten(self.stages(features, coordinates)[-1])

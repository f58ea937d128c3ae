"""The sparse U-Net of Part-A2 (section 3.1 of its paper): an encoder, and a decoder back to the input voxels."""

# mypy: allow-subclassing-any
from __future__ import annotations

from lcf3d.detectors.lidar.sparse import InverseConv, SparseBlock, SparseResidualBlock, SparseTensor, SubmanifoldConv
from lcf3d.detectors.lidar.sparse_encoders import SparseEncoder
from lcf3d.detectors.lidar.sparse_sites import Triple
from lcf3d.networks.torch import Tensor, torch


class SparseUNet(SparseEncoder):
    """The encoder of SECOND with lateral, merging and upsampling layers at every stage."""

    def __init__(self, in_channels: int, shape: Triple) -> None:
        super().__init__(in_channels, shape)
        for stage, channels, after in ((4, 64, 64), (3, 64, 32), (2, 32, 16), (1, 16, 16)):
            self.add_module(f"lateral_layer{stage}", SparseResidualBlock(channels))
            self.add_module(f"merge_layer{stage}", SparseBlock(SubmanifoldConv(2 * channels, channels)))
            conv = SubmanifoldConv if stage == 1 else InverseConv
            self.add_module(f"upsample_layer{stage}", SparseBlock(conv(channels, after)))

    def forward(self, features: Tensor, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """(1, 256, H / 8, W / 8) bird's-eye-view map and (V, 16) features of the input voxels."""
        stages = self.stages(features, coordinates)
        x = stages[-1]
        for number in range(len(stages), 0, -1):
            lateral = getattr(self, f"lateral_layer{number}")(stages[number - 1])
            both = torch.cat([x.features, lateral.features], dim=1)
            merged = getattr(self, f"merge_layer{number}")(lateral.with_features(both))
            # the shortcut: neighbouring channels summed until there are as many as merged
            reduced = both.reshape(len(both), merged.features.shape[1], -1).sum(dim=2)
            x = self._upsample(number, merged.with_features(merged.features + reduced), stages)
        return self.flatten(stages[-1]), x.features

    def _upsample(self, number: int, x: SparseTensor, stages: list[SparseTensor]) -> SparseTensor:
        layer: SparseBlock = getattr(self, f"upsample_layer{number}")
        if number == 1:
            return layer.forward(x)
        strided = self.encoder_layers[number - 1][0][0]
        return layer.forward(x, stages[number - 2].sites, strided)

"""Pillar encoders: from the points of a pillar to one feature vector, and the map they are scattered into.

A pillar that is not full is padded with zero points in the original networks, and what the layers make of a zero point
takes part in the maximum. Here only real points are computed; the zero point is computed once and joins the maximum of
the pillars that are not full. The result is the same, at a fraction of the work.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from lcf3d.networks.torch import Tensor, functional, nn, torch


def pillar_maximum(features: Tensor, pillar: Tensor, padding: Tensor) -> Tensor:
    """(P, C) maximum of the (M, C) features of each pillar and its (P, C) padding (which is 0 for full pillars)."""
    index = pillar[:, None].expand(-1, features.shape[1])
    return padding.scatter_reduce(0, index, features, "amax", include_self=True)


class PointLayer(nn.Module):
    """Linear, batch normalization and ReLU on points (the simplified PointNet layer of section 2.1, PointPillars)."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(out_channels, eps=1e-3, momentum=0.01)
        self.linear = nn.Linear(in_channels, out_channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """(M, in) -> (M, out)."""
        return functional.relu(self.norm(self.linear(features)))


class PillarFeatureNet(nn.Module):
    """One point layer and the maximum over a pillar."""

    def __init__(self, in_channels: int, out_channels: int = 64) -> None:
        super().__init__()
        self.pfn_layers = nn.ModuleList([PointLayer(in_channels, out_channels)])

    def forward(self, features: Tensor, pillar: Tensor, padded: Tensor) -> Tensor:
        """(P, 64) pillar features.

        Args:
            features: (M, in) decorated points.
            pillar: (M,) int64 pillar of each point.
            padded: (P, 1) 1 where a pillar has room for more points, else 0.
        """
        layer = self.pfn_layers[0]
        zero_point = layer(torch.zeros_like(features[:1]))
        return pillar_maximum(layer(features), pillar, padded * zero_point)


class HardVFE(nn.Module):
    """Two point layers, the second of which sees each point together with the maximum over its pillar."""

    def __init__(self, in_channels: int, out_channels: int = 64) -> None:
        super().__init__()
        self.vfe_layers = nn.ModuleList(
            [PointLayer(in_channels, out_channels), PointLayer(2 * out_channels, out_channels)]
        )

    def forward(self, features: Tensor, pillar: Tensor, padded: Tensor) -> Tensor:
        """(P, 64) pillar features; arguments as in `PillarFeatureNet`."""
        first, second = self.vfe_layers
        zero_point = first(torch.zeros_like(features[:1]))
        points = first(features)
        pooled = pillar_maximum(points, pillar, padded * zero_point)
        padding = second(torch.cat([zero_point.expand_as(pooled), pooled], dim=1)) * padded
        return pillar_maximum(second(torch.cat([points, pooled[pillar]], dim=1)), pillar, padding)


class StatisticsEncoder(nn.Module):
    """Two layers on the statistics of a pillar (`lcf3d.detectors.lidar.statistics`)."""

    def __init__(self, in_channels: int, hidden: int, out_channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(PointLayer(in_channels, hidden), PointLayer(hidden, out_channels))

    def forward(self, features: Tensor) -> Tensor:
        """(P, out) pillar features of (P, in) statistics."""
        encoded: Tensor = self.layers(features)
        return encoded


def scatter_pillars(features: Tensor, cells: Tensor, height: int, width: int, scans: int = 1) -> Tensor:
    """(scans, C, H, W) maps with the (P, C) features at the (P,) int64 flat cells and zero elsewhere."""
    canvas = features.new_zeros(scans * height * width, features.shape[1])
    canvas = canvas.index_put((cells,), features)
    # channels stay innermost in memory, which convolutions on a CPU prefer
    return canvas.reshape(scans, height, width, -1).permute(0, 3, 1, 2)

"""Set abstraction: what surrounds a point, at several radii (PointNet++, section 3.3; PV-RCNN, section 3.2)."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence

from lcf3d.detectors.lidar.point_ops import ball_query
from lcf3d.networks.convolution import ConvModule
from lcf3d.networks.torch import Tensor, functional, nn, torch


class SetAbstraction(nn.Module):
    """For each radius: neighbours, shared layers, maximum; the results concatenated.

    Args:
        in_channels: channels of the points, without their position.
        radii: in metres.
        counts: neighbours taken at each radius.
        channels: output channels of both layers, at every radius.
    """

    def __init__(self, in_channels: int, radii: Sequence[float], counts: Sequence[int], channels: int) -> None:
        super().__init__()
        self.radii = tuple(radii)
        self.counts = tuple(counts)
        self.mlps = nn.ModuleList()
        for _ in radii:
            layers = nn.Sequential()
            layers.add_module("layer0", ConvModule(in_channels + 3, channels, 1, eps=1e-5))
            layers.add_module("layer1", ConvModule(channels, channels, 1, eps=1e-5))
            self.mlps.append(layers)

    def forward(self, positions: Tensor, features: Tensor, centers: Tensor) -> Tensor:
        """(M, channels * radii) features at (M, 3) centers from (N, C) features at (N, 3) positions."""
        outputs = []
        for radius, count, mlp in zip(self.radii, self.counts, self.mlps, strict=True):
            index = ball_query(centers, positions, radius, count)
            empty = index[:, 0] < 0
            index = index.clamp(min=0)
            # the first layer is linear: a point's features go through it once, not once for each neighbourhood
            weight = mlp.layer0.conv.weight[:, :, 0, 0]
            offsets = positions[index] - centers[:, None]
            grouped = (features @ weight[:, 3:].t())[index] + offsets @ weight[:, :3].t()
            grouped[empty] = 0
            if mlp.layer0.conv.bias is not None:
                grouped += mlp.layer0.conv.bias
            hidden = functional.relu_(mlp.layer0.bn(as_map(grouped)))
            outputs.append(mlp.layer1(hidden).reshape(len(centers), count, -1).amax(dim=1))
        return torch.cat(outputs, dim=1)


def as_map(values: Tensor) -> Tensor:
    """(..., C) values as a (N, C, 1, 1) map for layers of two dimensions."""
    return values.reshape(-1, values.shape[-1], 1, 1)

"""Necks: from the backbone's maps of several strides to the maps that the head reads."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence

from lcf3d.detectors.lidar.backbones import conv_bn_relu
from lcf3d.networks.torch import Tensor, nn, torch


class SecondFPN(nn.Module):
    """Bring every map to one resolution and concatenate them (section 2.2 of the PointPillars paper).

    Args:
        in_channels: channels of the backbone's maps.
        channels: channels each is brought to.
        upsampling: factor for each; below 1 it is a strided convolution.
        convolve_unscaled: a factor of 1 is a convolution, otherwise a transposed one (they store weights differently).
    """

    def __init__(
        self,
        in_channels: Sequence[int],
        channels: Sequence[int],
        upsampling: Sequence[float],
        convolve_unscaled: bool = False,
    ) -> None:
        super().__init__()
        self.deblocks = nn.ModuleList()
        for before, after, factor in zip(in_channels, channels, upsampling, strict=True):
            if factor > 1 or (factor == 1 and not convolve_unscaled):
                conv = nn.ConvTranspose2d(before, after, int(factor), int(factor), bias=False)
            else:
                stride = round(1 / factor)
                conv = nn.Conv2d(before, after, stride, stride, bias=False)
            self.deblocks.append(nn.Sequential(*conv_bn_relu(conv, after)))

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """One map of ``sum(channels)`` channels."""
        return [torch.cat([block(x) for block, x in zip(self.deblocks, maps, strict=True)], dim=1)]

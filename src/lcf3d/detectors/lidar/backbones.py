"""2D backbones on bird's-eye-view maps."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence

from lcf3d.networks.torch import Tensor, functional, nn


def conv_bn_relu(conv: nn.Module, channels: int, eps: float = 1e-3) -> list[nn.Module]:
    """A convolution with its batch normalization and ReLU, as three modules."""
    return [conv, nn.BatchNorm2d(channels, eps=eps, momentum=0.01), nn.ReLU(inplace=True)]


class SecondBackbone(nn.Module):
    """The plain convolutional backbone of SECOND and PointPillars: blocks of 3 x 3 convolutions.

    Args:
        in_channels: channels of the input map.
        channels: output channels of each block.
        layers: convolutions of each block after the first.
        strides: stride of the first convolution of each block.
    """

    def __init__(
        self, in_channels: int, channels: Sequence[int], layers: Sequence[int], strides: Sequence[int]
    ) -> None:
        super().__init__()
        self.blocks = nn.ModuleList()
        for out_channels, count, stride in zip(channels, layers, strides, strict=True):
            first = nn.Conv2d(in_channels, out_channels, 3, stride, 1, bias=False)
            modules = conv_bn_relu(first, out_channels)
            for _ in range(count):
                conv = nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False)
                modules += conv_bn_relu(conv, out_channels)
            self.blocks.append(nn.Sequential(*modules))
            in_channels = out_channels

    def forward(self, x: Tensor) -> list[Tensor]:
        """The output of every block."""
        outputs = []
        for block in self.blocks:
            x = block(x)
            outputs.append(x)
        return outputs


class RegNetBlock(nn.Module):
    """A residual bottleneck with a grouped 3 x 3 convolution (section 3.3 of the RegNet paper, block X)."""

    def __init__(self, in_channels: int, channels: int, stride: int, group_width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)
        self.conv2 = nn.Conv2d(channels, channels, 3, stride, 1, groups=channels // group_width, bias=False)
        self.bn2 = nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)
        self.conv3 = nn.Conv2d(channels, channels, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)
        self.downsample = None
        if stride != 1 or in_channels != channels:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_channels, channels, 1, stride, bias=False),
                nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01),
            )

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, channels, H / stride, W / stride)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = functional.relu(self.bn1(self.conv1(x)))
        x = functional.relu(self.bn2(self.conv2(x)))
        return functional.relu(self.bn3(self.conv3(x)) + shortcut)


class RegNet400MF(nn.Module):
    """RegNetX-400MF without its stem, for the pillar map of SSN; returns the last three stages."""

    def __init__(self, in_channels: int = 64) -> None:
        super().__init__()
        stages = ((32, 1, 1), (64, 2, 2), (160, 7, 2), (384, 12, 2))
        for i, (channels, depth, stride) in enumerate(stages, start=1):
            blocks = [RegNetBlock(in_channels, channels, stride, 16)]
            blocks += [RegNetBlock(channels, channels, 1, 16) for _ in range(depth - 1)]
            self.add_module(f"layer{i}", nn.Sequential(*blocks))
            in_channels = channels

    def forward(self, x: Tensor) -> list[Tensor]:
        """Maps of 64, 160 and 384 channels at strides 2, 4 and 8."""
        x = self.layer1(x)
        outputs = []
        for layer in (self.layer2, self.layer3, self.layer4):
            x = layer(x)
            outputs.append(x)
        return outputs

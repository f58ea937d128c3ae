"""A convolution with what follows it, and the feature pyramid, under the names that OpenMMLab's checkpoints use."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence

from lcf3d.networks.torch import Tensor, functional, nn


class ConvModule(nn.Module):
    """Convolution, batch normalization, ReLU under the names ``conv`` and ``bn``.

    Args:
        in_channels: channels of the input.
        out_channels: channels of the output.
        kernel: odd width and height; the border is padded so that stride 1 keeps the size.
        stride: of the convolution.
        eps: of the normalization.
        bias: whether the convolution has one.
        norm: whether there is a normalization.
        relu: whether there is a ReLU.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel: int,
        stride: int = 1,
        eps: float = 1e-3,
        bias: bool = False,
        norm: bool = True,
        relu: bool = True,
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, kernel, stride, kernel // 2, bias=bias)
        self.bn = nn.BatchNorm2d(out_channels, eps=eps, momentum=0.01) if norm else nn.Identity()
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, out, H / stride, W / stride)."""
        x = self.bn(self.conv(x))
        return functional.relu(x) if self.relu else x


class FeaturePyramid(nn.Module):
    """Feature pyramid (Lin et al., CVPR 2017): each map, plus the enlarged sum of the coarser ones, convolved again.

    Args:
        in_channels: channels of the backbone's maps, finest first.
        channels: of every output map.
        eps: of the normalizations.
        norm: each convolution is followed by batch normalization; otherwise it has a bias.
        relu: and by a ReLU.
        extra: one more level, every second cell of the coarsest output.
    """

    def __init__(
        self,
        in_channels: Sequence[int],
        channels: int = 256,
        eps: float = 1e-5,
        norm: bool = False,
        relu: bool = False,
        extra: bool = False,
    ) -> None:
        super().__init__()
        self.extra = extra

        def convolution(before: int, kernel: int) -> ConvModule:
            return ConvModule(before, channels, kernel, eps=eps, bias=not norm, norm=norm, relu=relu)

        self.lateral_convs = nn.ModuleList([convolution(before, 1) for before in in_channels])
        self.fpn_convs = nn.ModuleList([convolution(channels, 3) for _ in in_channels])

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """As many maps as came in, and perhaps one more, all of ``channels`` channels."""
        sums = [conv(x) for conv, x in zip(self.lateral_convs, maps, strict=True)]
        for i in range(len(sums) - 1, 0, -1):
            enlarged = functional.interpolate(sums[i], size=sums[i - 1].shape[-2:], mode="nearest")
            sums[i - 1] = sums[i - 1] + enlarged
        outputs = [conv(x) for conv, x in zip(self.fpn_convs, sums, strict=True)]
        return [*outputs, functional.max_pool2d(outputs[-1], 1, 2)] if self.extra else outputs

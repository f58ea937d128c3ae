"""Dense heads: anchors, shape-aware groups of anchors (SSN), centres (CenterPoint)."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence

from lcf3d.detectors.lidar.config import AnchorSpec, CenterSpec
from lcf3d.networks.convolution import ConvModule
from lcf3d.networks.torch import Tensor, nn, torch

AnchorMaps = list[tuple[Tensor, Tensor, Tensor]]
CENTER_CHANNELS = {"reg": 2, "height": 1, "dim": 3, "rot": 2, "vel": 2}


def center_channels(spec: CenterSpec) -> dict[str, int]:
    """Channels of the box maps of a centre head by name, in order."""
    channels = {name: count for name, count in CENTER_CHANNELS.items() if spec.velocity or name != "vel"}
    return {**channels, "axis": 2} if spec.axis else channels


class AnchorHead(nn.Module):
    """1 x 1 convolutions to class logits, box residuals and direction logits of every anchor, shared by all levels."""

    def __init__(self, in_channels: int, spec: AnchorSpec, classes: int) -> None:
        super().__init__()
        anchors = len(spec.levels[0].sizes) * len(spec.rotations)
        self.conv_cls = nn.Conv2d(in_channels, anchors * classes, 1)
        self.conv_reg = nn.Conv2d(in_channels, anchors * spec.code_size, 1)
        self.conv_dir_cls = nn.Conv2d(in_channels, anchors * 2, 1)

    def forward(self, maps: Sequence[Tensor]) -> AnchorMaps:
        """For each level class logits (N, A K, H, W), residuals (N, A D, H, W), direction logits (N, A 2, H, W)."""
        return [(self.conv_cls(x), self.conv_reg(x), self.conv_dir_cls(x)) for x in maps]


class ShapeGroupHead(nn.Module):
    """The branch of one group of similarly shaped classes, with its own resolution."""

    def __init__(self, in_channels: int, strides: Sequence[int], sizes: int, spec: AnchorSpec, classes: int) -> None:
        super().__init__()
        convs = []
        for stride in strides:
            convs.append(ConvModule(in_channels, 64, 3, stride, eps=1e-5))
            in_channels = 64
        self.shared_conv = nn.Sequential(*convs)
        anchors = sizes * len(spec.rotations)
        self.conv_cls = nn.Conv2d(64, anchors * classes, 1)
        self.conv_reg = nn.Conv2d(64, anchors * spec.code_size, 1)
        self.conv_dir_cls = nn.Conv2d(64, anchors * 2, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Class logits, residuals and direction logits of the group's anchors."""
        x = self.shared_conv(x)
        return self.conv_cls(x), self.conv_reg(x), self.conv_dir_cls(x)


class ShapeAwareHead(nn.Module):
    """One branch a shape group; large classes are found at half the resolution (section 3.3 of the SSN paper)."""

    def __init__(self, in_channels: int, spec: AnchorSpec, classes: int) -> None:
        super().__init__()
        strides = ((1, 1), (1, 1), (1, 1), (2, 1, 1), (2, 1, 1))
        self.heads = nn.ModuleList(
            [
                ShapeGroupHead(in_channels, group, len(level.sizes), spec, classes)
                for group, level in zip(strides, spec.levels, strict=True)
            ]
        )

    def forward(self, maps: Sequence[Tensor]) -> AnchorMaps:
        """The maps of every group."""
        return [head(maps[0]) for head in self.heads]


class SeparateHead(nn.Module):
    """Heat map and box values of one task of CenterPoint, two convolutions each."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        for name, channels in {**CENTER_CHANNELS, "heatmap": classes}.items():
            layers = [ConvModule(64, 64, 3, eps=1e-5), nn.Conv2d(64, channels, 3, padding=1)]
            self.add_module(name, nn.Sequential(*layers))

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """Maps by name."""
        return {name: module(x) for name, module in self.named_children()}


class CenterHead(nn.Module):
    """A shared convolution and one `SeparateHead` a task (section 4.1 of the CenterPoint paper)."""

    def __init__(self, in_channels: int, spec: CenterSpec) -> None:
        super().__init__()
        self.shared_conv = ConvModule(in_channels, 64, 3, eps=1e-5)
        self.task_heads = nn.ModuleList([SeparateHead(len(task)) for task in spec.tasks])

    def forward(self, maps: Sequence[Tensor]) -> list[dict[str, Tensor]]:
        """The maps of every task."""
        shared = self.shared_conv(maps[0])
        return [head(shared) for head in self.task_heads]


class LightCenterHead(nn.Module):
    """A centre head of two convolutions in all: one shared, and a 1 x 1 convolution to all maps of a task."""

    def __init__(self, in_channels: int, channels: int, spec: CenterSpec) -> None:
        super().__init__()
        self.shared_conv = ConvModule(in_channels, channels, 3)
        self.maps = [{**center_channels(spec), "heatmap": len(task)} for task in spec.tasks]
        self.task_heads = nn.ModuleList([nn.Conv2d(channels, sum(maps.values()), 1) for maps in self.maps])
        for maps, head in zip(self.maps, self.task_heads, strict=True):
            # a scan is almost empty: start from a probability that says so
            nn.init.constant_(head.bias[-maps["heatmap"] :], -4.0)

    def forward(self, maps: Sequence[Tensor]) -> list[dict[str, Tensor]]:
        """The maps of every task."""
        shared = self.shared_conv(maps[0])
        # in full precision also where the convolutions before are not: a hundredth of a metre matters
        with torch.autocast(shared.device.type, enabled=False):
            return self._maps(shared.float())

    def _maps(self, shared: Tensor) -> list[dict[str, Tensor]]:
        return [
            dict(zip(names, head(shared).split(list(names.values()), dim=1), strict=True))
            for names, head in zip(self.maps, self.task_heads, strict=True)
        ]

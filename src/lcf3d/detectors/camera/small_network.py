"""The small camera detector in torch: one look at the image, no anchors, instance masks from shared prototypes.

A narrow residual backbone, a pyramid that adds coarse maps to fine ones, and one head for the grids of strides 8, 16
and 32. Every cell predicts the offset of a box's centre, the logarithm of its sides, a score a class and mask
coefficients; a mask is the sum of the prototypes weighted by the coefficients (as in YOLACT, Bolya et al., ICCV 2019).
In evaluation mode the outputs are those of the layout ``ultralytics`` of `lcf3d.detectors.camera.onnx_layouts`.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lcf3d.detectors.camera.onnx_layouts import STRIDES
from lcf3d.errors import ConfigError
from lcf3d.networks.torch import Tensor, functional, nn, torch

PROTOTYPE_STRIDE = 4
# score of every cell before training: rare positives
PRIOR = 0.01
# log of the longest side in strides; keeps the exponential finite
LONGEST = 6.0


@dataclass(frozen=True)
class SmallConfig:
    """Size of the network.

    Attributes:
        classes: number of classes.
        channels: of the maps of strides 2, 4, 8, 16 and 32.
        depths: residual blocks at strides 4, 8, 16 and 32.
        neck: channels of the pyramid and the head.
        prototypes: number of mask prototypes, 0 for a network without masks.
    """

    classes: int = 3
    channels: tuple[int, int, int, int, int] = (16, 24, 48, 96, 160)
    depths: tuple[int, int, int, int] = (0, 2, 3, 2)
    neck: int = 64
    prototypes: int = 16

    def __post_init__(self) -> None:
        if self.classes < 1 or self.prototypes < 0:
            raise ConfigError(f"classes must be 1 or more and prototypes 0 or more, got {self.classes}")


@dataclass(frozen=True)
class SmallOutputs:
    """What the network predicts for a batch, in pixels of its input.

    Attributes:
        logits: (B, M, classes).
        boxes: (B, M, 4) corners.
        coefficients: (B, M, K), K = 0 without masks.
        prototypes: (B, K, H / 4, W / 4), or None without masks.
    """

    logits: Tensor
    boxes: Tensor
    coefficients: Tensor
    prototypes: Tensor | None


def convolution(source: int, target: int, kernel: int = 3, stride: int = 1, groups: int = 1) -> nn.Sequential:
    """Convolution, batch normalization, ReLU."""
    return nn.Sequential(
        nn.Conv2d(source, target, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(target, eps=1e-3, momentum=0.1),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Two 3 x 3 convolutions, the first onto half the channels, added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(convolution(channels, channels // 2), convolution(channels // 2, channels))

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        return x + self.body(x)


class SmallDetector(nn.Module):
    """The whole network.

    Args:
        config: its size.
    """

    def __init__(self, config: SmallConfig) -> None:
        super().__init__()
        self.config = config
        first, *others = config.channels
        self.stem = convolution(3, first, stride=2)
        self.stages = nn.ModuleList()
        for source, target, depth in zip(config.channels[:-1], others, config.depths, strict=True):
            blocks = [Residual(target) for _ in range(depth)]
            self.stages.append(nn.Sequential(convolution(source, target, stride=2), *blocks))
        neck = config.neck
        # a wide look around at the coarsest grid costs little
        self.context = nn.Sequential(convolution(others[-1], others[-1], 5, groups=others[-1]))
        self.lateral = nn.ModuleList(convolution(channels, neck, 1) for channels in others[1:])
        self.smooth = nn.ModuleList(convolution(neck, neck) for _ in STRIDES)
        self.tower = nn.Sequential(convolution(neck, neck))
        outputs = config.classes + 4 + config.prototypes
        self.scale = nn.Parameter(torch.ones(len(STRIDES)))
        self.predict = nn.Conv2d(neck, outputs, 1)
        # slope and shift of each class's logit, fitted after training so that scores are probabilities
        self.register_buffer("calibration", torch.tensor([[1.0, 0.0]] * config.classes))
        with torch.no_grad():
            self.predict.bias.zero_()
            self.predict.bias[: config.classes] = -math.log((1 - PRIOR) / PRIOR)
        if config.prototypes:
            fine = others[0]
            self.fine = convolution(others[0], fine, 1)
            self.coarse = convolution(neck, fine, 1)
            self.prototype = nn.Sequential(convolution(fine, fine), nn.Conv2d(fine, config.prototypes, 1))

    def forward(self, image: Tensor) -> Tensor | tuple[Tensor, Tensor] | SmallOutputs:
        """(B, 3, H, W) in 0 to 1, sides multiples of 32.

        Returns:
            In training mode a `SmallOutputs`; in evaluation mode (B, 4 + classes + K, M) of centre, size, scores and
            coefficients, with the prototypes as second value if there are masks.
        """
        outputs = self.outputs(image)
        if self.training:
            return outputs
        low, high = outputs.boxes.split(2, dim=2)
        scores = (outputs.logits * self.calibration[:, 0] + self.calibration[:, 1]).sigmoid()
        table = torch.cat([(low + high) / 2, high - low, scores, outputs.coefficients], dim=2)
        table = table.transpose(1, 2)
        return table if outputs.prototypes is None else (table, outputs.prototypes)

    def outputs(self, image: Tensor) -> SmallOutputs:
        """Everything that is predicted, in either mode."""
        x = self.stem(image - 0.45)
        maps = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        maps[-1] = maps[-1] + self.context(maps[-1])
        pyramid = self._pyramid(maps[1:])
        rows, boxes = [], []
        for level, (stride, features) in enumerate(zip(STRIDES, pyramid, strict=True)):
            hidden = self.tower(features)
            # in full precision also where the convolutions are not: a pixel is a small part of an image
            with torch.autocast(features.device.type, enabled=False):
                raw = self.predict(hidden.float()).flatten(2).transpose(1, 2)
            rows.append(raw)
            boxes.append(self._boxes(raw, features, stride, level))
        table = torch.cat(rows, dim=1)
        classes = self.config.classes
        prototypes = None
        if self.config.prototypes:
            merged = self.fine(maps[0]) + _twice(self.coarse(pyramid[0]))
            prototypes = self.prototype(merged).float()
        return SmallOutputs(table[..., :classes], torch.cat(boxes, dim=1), table[..., classes + 4 :], prototypes)

    def _pyramid(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Maps of strides 8, 16 and 32 with ``neck`` channels, each informed by the coarser ones."""
        merged = [lateral(x) for lateral, x in zip(self.lateral, maps, strict=True)]
        for level in (1, 0):
            merged[level] = merged[level] + _twice(merged[level + 1])
        return [smooth(x) for smooth, x in zip(self.smooth, merged, strict=True)]

    def _boxes(self, raw: Tensor, features: Tensor, stride: int, level: int) -> Tensor:
        """(B, cells, 4) corners from offsets in strides and logarithms of sides in strides."""
        classes = self.config.classes
        rows = torch.arange(features.shape[2], device=raw.device, dtype=raw.dtype)
        columns = torch.arange(features.shape[3], device=raw.device, dtype=raw.dtype)
        down, across = torch.meshgrid(rows, columns, indexing="ij")
        cells = torch.stack([across, down], dim=-1).flatten(0, 1) + 0.5
        centres = (cells + raw[..., classes : classes + 2]) * stride
        sides = (raw[..., classes + 2 : classes + 4] * self.scale[level]).clamp(-LONGEST, LONGEST).exp() * stride
        return torch.cat([centres - sides / 2, centres + sides / 2], dim=2)


def _twice(x: Tensor) -> Tensor:
    """(N, C, H, W) -> (N, C, 2H, 2W), every value repeated."""
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")

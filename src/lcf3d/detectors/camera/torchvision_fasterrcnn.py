"""Faster R-CNN (Ren et al., NeurIPS 2015) with a ResNet-FPN, for checkpoints of OpenMMLab, on torchvision's operators.

The parameter names are those of the checkpoints. What the parameters do not tell (anchors, image normalization, final
suppression) is in `STYLES`: facts of the configurations of the LCF3D authors (KITTI) and of the nuImages models.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.detectors.base import Image
from lcf3d.detectors.camera.torchvision_boxes import (
    anchor_grid,
    clip_boxes,
    decode_boxes,
    roi_features,
    select_detections,
)
from lcf3d.detectors.classes import to_classes
from lcf3d.errors import ConfigError, DetectorError, ShapeError
from lcf3d.networks.checkpoints import load_parameters, read_state_dict
from lcf3d.networks.torch import Tensor, functional, nn, torch, torch_device, torchvision
from lcf3d.structures import KITTI_CLASSES, Detections2D

STRIDES = (4, 8, 16, 32, 64)
NUIMAGES_CLASSES = (
    "car",
    "truck",
    "trailer",
    "bus",
    "construction_vehicle",
    "bicycle",
    "motorcycle",
    "pedestrian",
    "traffic_cone",
    "barrier",
)


@dataclass(frozen=True)
class Style:
    """What a checkpoint's parameters do not tell.

    Attributes:
        ratios: height over width of the anchors.
        scale: side of the square anchor in strides.
        mean: subtracted from the image's channels, RGB.
        std: then divided by, RGB.
        bgr: channels in the order blue, green, red.
        caffe: the stride of a bottleneck is in its first convolution.
        image_size: longer and shorter side that the image is brought into, in pixels.
        iou_threshold: of the final suppression, per class.
        soft: that suppression lowers scores instead of removing boxes.
        classes: in the order of the checkpoint.
    """

    ratios: tuple[float, ...]
    scale: float
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    bgr: bool
    caffe: bool
    image_size: tuple[int, int]
    iou_threshold: float
    soft: bool
    classes: tuple[str, ...]


STYLES: dict[str, Style] = {
    "kitti": Style(
        (0.5, 1.0, 2.0, 3.0),
        4,
        (123.675, 116.28, 103.53),
        (58.395, 57.12, 57.375),
        bgr=False,
        caffe=False,
        image_size=(1333, 800),
        iou_threshold=0.7,
        soft=True,
        classes=KITTI_CLASSES,
    ),
    "nuscenes": Style(
        (0.5, 1.0, 2.0),
        8,
        (123.675, 116.28, 103.53),
        (1.0, 1.0, 1.0),
        bgr=True,
        caffe=True,
        image_size=(1600, 900),
        iou_threshold=0.5,
        soft=False,
        classes=NUIMAGES_CLASSES,
    ),
}


class _Named(nn.Module):
    """A convolution under the name ``conv``."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, kernel, padding=kernel // 2)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, out, H, W)."""
        return self.conv(x)


class Backbone(nn.Module):
    """torchvision's ResNet without its classifier."""

    def __init__(self, depth: int, caffe: bool) -> None:
        super().__init__()
        resnet = getattr(torchvision().models, f"resnet{depth}")(weights=None)
        for name in ("conv1", "bn1", "layer1", "layer2", "layer3", "layer4"):
            setattr(self, name, getattr(resnet, name))
        if caffe:
            for layer in (self.layer2, self.layer3, self.layer4):
                layer[0].conv1.stride, layer[0].conv2.stride = (2, 2), (1, 1)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Maps of strides 4, 8, 16 and 32."""
        x = functional.relu(self.bn1(self.conv1(image)))
        x = functional.max_pool2d(x, 3, 2, 1)
        maps = []
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = layer(x)
            maps.append(x)
        return maps


class Neck(nn.Module):
    """Feature pyramid (Lin et al., CVPR 2017); the fifth level is every second cell of the fourth."""

    def __init__(self) -> None:
        super().__init__()
        self.lateral_convs = nn.ModuleList([_Named(channels, 256, 1) for channels in (256, 512, 1024, 2048)])
        self.fpn_convs = nn.ModuleList([_Named(256, 256, 3) for _ in range(4)])

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Five maps of 256 channels at strides 4 to 64."""
        sums = [conv(x) for conv, x in zip(self.lateral_convs, maps, strict=True)]
        for i in range(3, 0, -1):
            sums[i - 1] = sums[i - 1] + functional.interpolate(sums[i], size=sums[i - 1].shape[-2:], mode="nearest")
        outputs = [conv(x) for conv, x in zip(self.fpn_convs, sums, strict=True)]
        return [*outputs, functional.max_pool2d(outputs[-1], 1, 2)]


class RPNHead(nn.Module):
    """Objectness and box residuals of every anchor."""

    def __init__(self, anchors: int) -> None:
        super().__init__()
        self.rpn_conv = nn.Conv2d(256, 256, 3, padding=1)
        self.rpn_cls = nn.Conv2d(256, anchors, 1)
        self.rpn_reg = nn.Conv2d(256, anchors * 4, 1)

    def forward(self, maps: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Logits (1, A, H, W) and residuals (1, 4 A, H, W) of each level."""
        hidden = [functional.relu(self.rpn_conv(x)) for x in maps]
        return [self.rpn_cls(x) for x in hidden], [self.rpn_reg(x) for x in hidden]


class BoxHead(nn.Module):
    """Class logits and class-wise residuals of each region."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.shared_fcs = nn.ModuleList([nn.Linear(256 * 49, 1024), nn.Linear(1024, 1024)])
        self.fc_cls = nn.Linear(1024, classes + 1)
        self.fc_reg = nn.Linear(1024, classes * 4)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """(R, K + 1) logits, background last, and (R, 4 K) residuals, from (R, 256, 7, 7)."""
        x = pooled.flatten(1)
        for layer in self.shared_fcs:
            x = functional.relu(layer(x))
        return self.fc_cls(x), self.fc_reg(x)


class _RoIHead(nn.Module):
    def __init__(self, classes: int) -> None:
        super().__init__()
        self.bbox_head = BoxHead(classes)


class FasterRCNNNetwork(nn.Module):
    """The network: image to regions to boxes."""

    def __init__(self, depth: int, style: Style) -> None:
        super().__init__()
        self.style = style
        self.backbone = Backbone(depth, style.caffe)
        self.neck = Neck()
        self.rpn_head = RPNHead(len(style.ratios))
        self.roi_head = _RoIHead(len(style.classes))

    def regions(self, maps: Sequence[Tensor], height: int, width: int) -> Tensor:
        """(R, 4) at most 1,000 proposals in pixels, best first."""
        boxes, scores, levels = [], [], []
        for level, (logits, residuals) in enumerate(zip(*self.rpn_head(maps), strict=True)):
            objectness = logits[0].permute(1, 2, 0).reshape(-1).sigmoid()
            best = objectness.topk(min(1000, len(objectness))).indices
            anchors = anchor_grid(logits.shape[-2:], STRIDES[level], self.style.scale, self.style.ratios)
            flat = residuals[0].permute(1, 2, 0).reshape(-1, 4)
            boxes.append(clip_boxes(decode_boxes(anchors.to(flat)[best], flat[best]), height, width))
            scores.append(objectness[best])
            levels.append(torch.full_like(best, level))
        all_boxes, all_scores, all_levels = torch.cat(boxes), torch.cat(scores), torch.cat(levels)
        sides = all_boxes[:, 2:] - all_boxes[:, :2]
        valid = (sides > 0).all(dim=1)
        all_boxes, all_scores, all_levels = all_boxes[valid], all_scores[valid], all_levels[valid]
        return all_boxes[torchvision().ops.batched_nms(all_boxes, all_scores, all_levels, 0.7)[:1000]]

    def forward(self, image: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """(R, K) scores and (R, K, 4) boxes of the regions of a padded (1, 3, H, W) image of height x width pixels."""
        maps = self.neck(self.backbone(image))
        regions = self.regions(maps, height, width)
        logits, residuals = self.roi_head.bbox_head(roi_features(maps[:4], regions, STRIDES))
        scales = residuals.new_tensor([0.1, 0.1, 0.2, 0.2])
        residuals = residuals.reshape(len(regions), -1, 4) * scales
        boxes = decode_boxes(regions[:, None].expand_as(residuals), residuals)
        return logits.softmax(dim=1)[:, :-1], clip_boxes(boxes, height, width)


class TorchvisionFasterRCNN:
    """Faster R-CNN from an OpenMMLab checkpoint; a `CameraDetector`.

    Args:
        path: checkpoint file; no code in it is executed.
        class_names: classes the detections shall have, mapped by name; the network's own without it.
        score_threshold: boxes need a higher score.
        style: ``kitti`` or ``nuscenes``; found from the parameter shapes without it.
        device: torch device.

    Raises:
        DetectorError: the file cannot be read, or is no Faster R-CNN with ResNet-50 or -101 and FPN.
        ConfigError: unknown style or device.
    """

    def __init__(
        self,
        path: Path | str,
        class_names: Sequence[str] | None = None,
        score_threshold: float = 0.05,
        style: str | None = None,
        device: str = "cpu",
    ) -> None:
        self._setup(read_state_dict(Path(path)), class_names, score_threshold, style, device)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], **options: Any) -> TorchvisionFasterRCNN:
        """The detector with given weights; options as of the class."""
        detector = cls.__new__(cls)
        settings = {"class_names": None, "score_threshold": 0.05, "style": None, "device": "cpu", **options}
        detector._setup(state, **settings)
        return detector

    def _setup(
        self,
        state: Mapping[str, Any],
        class_names: Sequence[str] | None,
        score_threshold: float,
        style: str | None,
        device: str,
    ) -> None:
        torchvision()
        if style is not None and style not in STYLES:
            raise ConfigError(f"style must be one of {', '.join(STYLES)}, got {style!r}")
        self.style = STYLES[style] if style is not None else find_style(state)
        depth = 101 if "backbone.layer3.22.conv1.weight" in state else 50
        with torch.device("meta"):
            network = FasterRCNNNetwork(depth, self.style)
        load_parameters(network, state, f"Faster R-CNN with ResNet-{depth} and FPN")
        self.device = torch_device(device)
        self.network = network.eval().requires_grad_(False).to(self.device)
        self.class_names = self.style.classes if class_names is None else tuple(class_names)
        self.score_threshold = score_threshold

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detections in (H, W, 3) uint8 RGB images."""
        return [self._detect(image) for image in images]

    def _detect(self, image: Image) -> Detections2D:
        tensor, scale = self.prepare(image)
        height, width = (round(side * scale) for side in image.shape[:2])
        with torch.inference_mode():
            scores, boxes = self.network(tensor, height, width)
        style = self.style
        selected = select_detections(
            boxes.cpu().numpy(), scores.cpu().numpy(), self.score_threshold, style.iou_threshold, style.soft
        )
        found = Detections2D(selected[0] / scale, selected[1], selected[2], style.classes)
        return to_classes(found, self.class_names)

    def prepare(self, image: Image) -> tuple[Tensor, float]:
        """The network's (1, 3, H, W) input, scaled, normalized and padded to a multiple of 32, and the scale.

        Raises:
            ShapeError: not an RGB image.
        """
        if image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ShapeError(f"an image must have shape (H, W, 3), got {image.shape}")
        longer, shorter = self.style.image_size
        scale = min(longer / max(image.shape[:2]), shorter / min(image.shape[:2]))
        size = tuple(round(side * scale) for side in image.shape[:2])
        tensor = torch.from_numpy(np.ascontiguousarray(image)).to(self.device).permute(2, 0, 1)[None].float()
        if size != image.shape[:2]:
            tensor = functional.interpolate(tensor, size=size, mode="bilinear", align_corners=False)
        return self.normalize(tensor), scale

    def normalize(self, image: Tensor) -> Tensor:
        """A (1, 3, H, W) RGB image in 0 to 255 as the network was trained with, padded at the right and the bottom."""
        mean, std = (image.new_tensor(values)[None, :, None, None] for values in (self.style.mean, self.style.std))
        image = (image - mean) / std
        if self.style.bgr:
            image = image.flip(1)
        height, width = image.shape[-2:]
        return functional.pad(image, (0, -width % 32, 0, -height % 32))


def find_style(state: Mapping[str, Any]) -> Style:
    """The style whose numbers of classes and anchors are those of the parameters.

    Raises:
        DetectorError: none is, or the parameters are not of a Faster R-CNN.
    """
    names = ("roi_head.bbox_head.fc_cls.weight", "rpn_head.rpn_cls.weight")
    if not all(name in state for name in names):
        raise DetectorError(f"the checkpoint is no Faster R-CNN of OpenMMLab: it lacks {' and '.join(names)}")
    classes, anchors = len(state[names[0]]) - 1, len(state[names[1]])
    for style in STYLES.values():
        if len(style.classes) == classes and len(style.ratios) == anchors:
            return style
    known = ", ".join(f"{name}: {len(s.classes)} and {len(s.ratios)}" for name, s in STYLES.items())
    raise DetectorError(f"no Faster R-CNN with {classes} classes and {anchors} anchors a cell is known ({known})")

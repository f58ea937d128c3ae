"""Faster R-CNN (Ren et al., NeurIPS 2015) with a ResNet-FPN, for checkpoints of OpenMMLab, on torchvision's operators.

The parameter names are those of the checkpoints. What the parameters do not tell (anchors, image normalization, final
suppression) is in `STYLES`. With a mask head it is Mask R-CNN (He et al., ICCV 2017), and masks come out.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from lcf3d.detectors.camera.torchvision_masks import MaskHead, instance_masks
from lcf3d.detectors.camera.torchvision_styles import (
    STYLES,
    Style,
    find_style,
    normalization_of,
    normalized,
    parse_size,
)
from lcf3d.detectors.classes import reported_classes, to_classes
from lcf3d.detectors.downloads import local_path
from lcf3d.errors import ConfigError, ShapeError
from lcf3d.networks.checkpoints import load_parameters, read_notes, read_state_dict
from lcf3d.networks.convolution import FeaturePyramid
from lcf3d.networks.resnet import ResNet
from lcf3d.networks.torch import Tensor, functional, nn, torch, torch_device, torchvision
from lcf3d.structures import Detections2D

STRIDES = (4, 8, 16, 32, 64)


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

    def propose(
        self, maps: Sequence[Tensor], scale: float, ratios: Sequence[float], height: int, width: int
    ) -> tuple[Tensor, Tensor]:
        """(R, 4) at most 1,000 regions in pixels, best first, and their (R,) objectness.

        Args:
            maps: of strides 4 to 64.
            scale: side of the square anchor in strides.
            ratios: height over width of the anchors.
            height: of the image in pixels.
            width: of the image in pixels.
        """
        boxes, scores, levels = [], [], []
        for level, (logits, residuals) in enumerate(zip(*self(maps), strict=True)):
            objectness = logits[0].permute(1, 2, 0).reshape(-1).sigmoid()
            best = objectness.topk(min(1000, len(objectness))).indices
            anchors = anchor_grid(logits.shape[-2:], STRIDES[level], scale, ratios)
            flat = residuals[0].permute(1, 2, 0).reshape(-1, 4)
            boxes.append(clip_boxes(decode_boxes(anchors.to(flat)[best], flat[best]), height, width))
            scores.append(objectness[best])
            levels.append(torch.full_like(best, level))
        all_boxes, all_scores, all_levels = torch.cat(boxes), torch.cat(scores), torch.cat(levels)
        sides = all_boxes[:, 2:] - all_boxes[:, :2]
        valid = (sides > 0).all(dim=1)
        all_boxes, all_scores, all_levels = all_boxes[valid], all_scores[valid], all_levels[valid]
        kept = torchvision().ops.batched_nms(all_boxes, all_scores, all_levels, 0.7)[:1000]
        return all_boxes[kept], all_scores[kept]


class BoxHead(nn.Module):
    """Class logits and residuals of each region, class by class or (``agnostic``) one for all classes."""

    def __init__(self, classes: int, agnostic: bool = False) -> None:
        super().__init__()
        self.shared_fcs = nn.ModuleList([nn.Linear(256 * 49, 1024), nn.Linear(1024, 1024)])
        self.fc_cls = nn.Linear(1024, classes + 1)
        self.fc_reg = nn.Linear(1024, 4 if agnostic else classes * 4)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """(R, K + 1) logits, background last, and (R, 4 K or 4) residuals, from (R, 256, 7, 7)."""
        x = pooled.flatten(1)
        for layer in self.shared_fcs:
            x = functional.relu(layer(x))
        return self.fc_cls(x), self.fc_reg(x)


class _RoIHead(nn.Module):
    def __init__(self, classes: int, masks: bool) -> None:
        super().__init__()
        self.bbox_head = BoxHead(classes)
        if masks:
            self.mask_head = MaskHead(classes)


class FasterRCNNNetwork(nn.Module):
    """The network: image to regions to boxes, and with ``masks`` a mask of each final box."""

    def __init__(self, depth: int, style: Style, masks: bool = False) -> None:
        super().__init__()
        self.style = style
        self.backbone = ResNet(depth, style.caffe)
        self.neck = FeaturePyramid((256, 512, 1024, 2048), extra=True)
        self.rpn_head = RPNHead(len(style.ratios))
        self.roi_head = _RoIHead(len(style.classes), masks)

    def maps(self, image: Tensor) -> list[Tensor]:
        """The feature pyramid of a padded (1, 3, H, W) image."""
        pyramid: list[Tensor] = self.neck(self.backbone(image))
        return pyramid

    def propose(self, maps: Sequence[Tensor], height: int, width: int) -> Tensor:
        """(R, 4) at most 1,000 regions in pixels, best first."""
        return self.rpn_head.propose(maps, self.style.scale, self.style.ratios, height, width)[0]

    def forward(self, maps: Sequence[Tensor], height: int, width: int) -> tuple[Tensor, Tensor]:
        """(R, K) scores and (R, K, 4) boxes of the regions of an image of height x width pixels, from its `maps`."""
        regions = self.propose(maps, height, width)
        logits, residuals = self.roi_head.bbox_head(roi_features(maps[:4], regions, STRIDES))
        scales = residuals.new_tensor([0.1, 0.1, 0.2, 0.2])
        residuals = residuals.reshape(len(regions), residuals.shape[1] // 4, 4) * scales
        boxes = decode_boxes(regions[:, None].expand_as(residuals), residuals)
        return logits.softmax(dim=1)[:, :-1], clip_boxes(boxes, height, width)

    def masks(self, maps: Sequence[Tensor], boxes: Tensor, labels: Tensor) -> Tensor:
        """(D, 28, 28) probability of the object in each cell of (D, 4) final boxes of (D,) classes."""
        logits = self.roi_head.mask_head(roi_features(maps[:4], boxes, STRIDES, size=14))
        return logits[torch.arange(len(boxes)), labels].sigmoid()


class TorchvisionFasterRCNN:
    """Faster R-CNN from an OpenMMLab checkpoint; a `CameraDetector`.

    Args:
        path: checkpoint file, or the name of a published one, downloaded at first use; no code in it is executed.
        class_names: classes the detections shall have, mapped by name; the network's own without it.
        score_threshold: boxes need a higher score.
        style: ``kitti``, ``nuscenes`` or ``coco``; found from the parameter shapes without it.
        device: torch device.
        normalization: ``pytorch`` or ``caffe``, how images were normalized in training; without it what the
            configuration in the file says, or else the style's.
        size: ``LONGERxSHORTER`` sides that images are brought into, in pixels; those of its training without it.
            Smaller is quicker and finds less.

    Raises:
        DetectorError: the file cannot be read, or is no Faster or Mask R-CNN with ResNet-50 or -101 and FPN.
        ConfigError: unknown style, normalization or device, or a size that is none.
    """

    style: Style

    def __init__(
        self,
        path: Path | str,
        class_names: Sequence[str] | None = None,
        score_threshold: float = 0.05,
        style: str | None = None,
        device: str = "cpu",
        normalization: str | None = None,
        size: str | None = None,
    ) -> None:
        file = local_path(str(path), "camera")
        state = read_state_dict(file)
        config, classes = read_notes(file)
        told = normalization or normalization_of(config)
        image_size = None if size is None else parse_size(size)
        self._setup(state, class_names, score_threshold, style, device, told, classes, image_size)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], **options: Any) -> TorchvisionFasterRCNN:
        """The detector with given weights; options as of the class."""
        detector = cls.__new__(cls)
        settings = {"class_names": None, "score_threshold": 0.05, "style": None, "device": "cpu", **options}
        detector._setup(state, **{"normalization": None, **settings})
        return detector

    def _setup(
        self,
        state: Mapping[str, Any],
        class_names: Sequence[str] | None,
        score_threshold: float,
        style: str | None,
        device: str,
        normalization: str | None,
        classes: tuple[str, ...] = (),
        image_size: tuple[int, int] | None = None,
    ) -> None:
        torchvision()
        if style is not None and style not in STYLES:
            raise ConfigError(f"style must be one of {', '.join(STYLES)}, got {style!r}")
        found = STYLES[style] if style is not None else find_style(state, classes)
        found = found if image_size is None else replace(found, image_size=image_size)
        self.style = found if normalization is None else normalized(found, normalization)
        depth = 101 if "backbone.layer3.22.conv1.weight" in state else 50
        self.has_masks = any(name.startswith("roi_head.mask_head.") for name in state)
        with torch.device("meta"):
            network = FasterRCNNNetwork(depth, self.style, self.has_masks)
        load_parameters(network, state, f"the checkpoint for Faster R-CNN with ResNet-{depth} and FPN")
        self.device = torch_device(device)
        self.network = network.eval().requires_grad_(False).to(self.device)
        self.class_names = self.style.classes if class_names is None else tuple(class_names)
        self.reports = reported_classes(self.style.classes, self.class_names)
        self.score_threshold = score_threshold

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detections in (H, W, 3) uint8 RGB images."""
        return [self._detect(image) for image in images]

    def _detect(self, image: Image) -> Detections2D:
        tensor, scale = self.prepare(image)
        height, width = (round(side * scale) for side in image.shape[:2])
        style = self.style
        with torch.inference_mode():
            maps = self.network.maps(tensor)
            scores, boxes = self.network(maps, height, width)
            final, certain, labels = select_detections(
                boxes.cpu().numpy(), scores.cpu().numpy(), self.score_threshold, style.iou_threshold, style.soft
            )
            masks = None
            if self.has_masks:
                chosen = torch.from_numpy(final).to(tensor), torch.from_numpy(labels).to(self.device)
                cells = self.network.masks(maps, *chosen).cpu().numpy()
                masks = instance_masks(cells, final / scale, image.shape[0], image.shape[1])
        found = Detections2D(final / scale, certain, labels, style.classes, masks)
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
        # a copy, because images of datasets are read-only, which torch warns of
        tensor = torch.from_numpy(np.array(image, order="C")).to(self.device).permute(2, 0, 1)[None].float()
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

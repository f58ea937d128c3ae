"""Boxes of a two-stage camera detector: anchors, residuals, pooling, final selection."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lcf3d.geometry.iou import image_iou
from lcf3d.networks.torch import Tensor, torch, torchvision
from lcf3d.structures import FloatArray, IntArray

MAX_BOXES = 100
MIN_SOFT_SCORE = 1e-3
_MAX_LOG_RATIO = math.log(1000 / 16)


def anchor_grid(shape: Sequence[int], stride: int, scale: float, ratios: Sequence[float]) -> Tensor:
    """(H W A, 4) anchors ``x1 y1 x2 y2`` around the cell corners (x, y) * stride, row-major, anchors innermost."""
    height, width = shape
    side = stride * scale
    halves = torch.tensor([[side / math.sqrt(ratio) / 2, side * math.sqrt(ratio) / 2] for ratio in ratios])
    base = torch.cat([-halves, halves], dim=1)
    y, x = torch.meshgrid(torch.arange(height) * stride, torch.arange(width) * stride, indexing="ij")
    shifts = torch.stack([x, y, x, y], dim=-1).reshape(-1, 1, 4)
    return (shifts + base).reshape(-1, 4)


def decode_boxes(reference: Tensor, residuals: Tensor) -> Tensor:
    """Boxes (..., 4) from reference boxes and residuals (centre in sides, logarithm of sides; Fast R-CNN)."""
    sides = reference[..., 2:] - reference[..., :2]
    centers = (reference[..., 2:] + reference[..., :2]) / 2 + residuals[..., :2] * sides
    halves = sides * residuals[..., 2:].clamp(-_MAX_LOG_RATIO, _MAX_LOG_RATIO).exp() / 2
    return torch.cat([centers - halves, centers + halves], dim=-1)


def clip_boxes(boxes: Tensor, height: int, width: int) -> Tensor:
    """Boxes (..., 4) cut to an image."""
    return torch.stack([boxes[..., i].clamp(0, width if i % 2 == 0 else height) for i in range(4)], dim=-1)


def roi_features(maps: Sequence[Tensor], regions: Tensor, strides: Sequence[int], size: int = 7) -> Tensor:
    """(R, C, size, size) features of (R, 4) regions, each from the map of its size (FPN, equation 1)."""
    area = ((regions[:, 2] - regions[:, 0]) * (regions[:, 3] - regions[:, 1])).clamp(min=0)
    level = torch.floor(torch.log2(area.sqrt() / 56 + 1e-6)).clamp(0, len(maps) - 1)
    pooled = regions.new_zeros(len(regions), maps[0].shape[1], size, size)
    for i, values in enumerate(maps):
        chosen = torch.nonzero(level == i).squeeze(1)
        if len(chosen):
            pooled[chosen] = torchvision().ops.roi_align(values, [regions[chosen]], size, 1 / strides[i], aligned=True)
    return pooled


def select_detections(
    boxes: NDArray[np.floating],
    scores: NDArray[np.floating],
    score_threshold: float,
    iou_threshold: float,
    soft: bool,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """At most 100 final boxes, scores and labels, best first.

    Args:
        boxes: (R, K, 4) box of each region for each class.
        scores: (R, K).
        score_threshold: boxes need a higher score.
        iou_threshold: overlap, within a class, above which the worse box goes or loses score.
        soft: scores fall by a factor of 1 - IoU instead (linear soft-NMS, Bodla et al., ICCV 2017).
    """
    parts = []
    for label in range(scores.shape[1]):
        passed = np.flatnonzero(scores[:, label] > score_threshold)
        order = passed[np.argsort(-scores[passed, label], kind="stable")]
        candidates = boxes[order, label].astype(np.float64)
        kept, values = _suppress(candidates, scores[order, label].astype(np.float64), iou_threshold, soft)
        parts.append((candidates[kept], values, np.full(len(kept), label)))
    all_boxes, all_scores, labels = (np.concatenate(values) for values in zip(*parts, strict=True))
    best = np.argsort(-all_scores, kind="stable")[:MAX_BOXES]
    return all_boxes[best], all_scores[best], labels[best]


def _suppress(boxes: FloatArray, scores: FloatArray, iou_threshold: float, soft: bool) -> tuple[IntArray, FloatArray]:
    """Indices and (lowered) scores of at most 100 boxes of one class, the best of the rest each time."""
    remaining = np.arange(len(boxes))
    values = scores.copy()
    kept: list[int] = []
    while len(remaining) and len(kept) < MAX_BOXES:
        index = int(remaining[values[remaining].argmax()])
        kept.append(index)
        remaining = remaining[remaining != index]
        overlap = image_iou(boxes[index : index + 1], boxes[remaining])[0]
        if soft:
            values[remaining] *= np.where(overlap > iou_threshold, 1 - overlap, 1.0)
            remaining = remaining[values[remaining] > MIN_SOFT_SCORE]
        else:
            remaining = remaining[overlap <= iou_threshold]
    order = np.array(kept, dtype=np.int64)
    return order, values[order]

"""How well a camera detector finds the objects of labelled images: average precision, masks, and honest scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lcf3d.detectors.base import CameraDetector
from lcf3d.geometry.iou import image_cover, image_iou
from lcf3d.structures import KITTI_CLASSES, BoolArray, Detections2D, FloatArray, IntArray
from lcf3d.training.camera_augmentation import LOWEST_HEIGHT
from lcf3d.training.camera_images import IGNORED, LabelledImage

OVERLAPS = (0.5, 0.7)
# a detection that lies so much on an ignored object is not counted
ON_IGNORED = 0.5
RECALLS = np.linspace(0, 1, 41)[1:]
BINS = 10


@dataclass(frozen=True, eq=False)
class ImageEvaluation:
    """Detections of a set of images, compared with what there is.

    Attributes:
        scores: (N,) of the detections that count.
        labels: (N,) their classes, indices into `KITTI_CLASSES`.
        hits: (N, 2) whether each found an object of its class, at each of `OVERLAPS`.
        objects: (3,) number of objects to find, by class.
        mask_ious: (H,) mask IoU of detections that found an object at the lower overlap.
        mask_labels: (H,) their classes.
    """

    scores: FloatArray
    labels: IntArray
    hits: BoolArray
    objects: IntArray
    mask_ious: FloatArray
    mask_labels: IntArray

    def ap(self, label: int, overlap: int) -> float:
        """Average precision at 40 recalls of a class at ``OVERLAPS[overlap]``, 0 to 1; NaN without objects."""
        return average_precision(
            self.scores[self.labels == label], self.hits[self.labels == label, overlap], int(self.objects[label])
        )

    def calibration_error(self) -> float:
        """Mean distance between score and share of hits at the lower overlap, over bins of score, by their size."""
        bins = np.minimum((self.scores * BINS).astype(int), BINS - 1)
        error = 0.0
        for index in np.unique(bins):
            inside = bins == index
            error += abs(float(self.scores[inside].mean() - self.hits[inside, 0].mean())) * float(inside.mean())
        return error

    def figures(self) -> dict[str, float]:
        """AP in percent by overlap and class (classes without objects are left out), mask IoU, calibration error."""
        found: dict[str, float] = {}
        for index, overlap in enumerate(OVERLAPS):
            for label, name in enumerate(KITTI_CLASSES):
                if self.objects[label]:
                    found[f"AP{overlap * 100:.0f} {name}"] = round(100 * self.ap(label, index), 2)
        for label, name in enumerate(KITTI_CLASSES):
            if (self.mask_labels == label).any():
                found[f"mask IoU {name}"] = round(float(self.mask_ious[self.mask_labels == label].mean()), 4)
        found["calibration error"] = round(self.calibration_error(), 4)
        return found


def evaluate_detector(
    detector: CameraDetector, images: Sequence[LabelledImage], lowest: float = LOWEST_HEIGHT
) -> ImageEvaluation:
    """Run a detector over labelled images and compare.

    Args:
        detector: of KITTI's three classes.
        images: with labels.
        lowest: pixels of the image; objects and detections less high are not counted.
    """
    return evaluate([detector([image.image])[0] for image in images], images, lowest)


def evaluate(
    detections: Sequence[Detections2D], images: Sequence[LabelledImage], lowest: float = LOWEST_HEIGHT
) -> ImageEvaluation:
    """Compare detections with the objects of their images.

    By falling score, a detection takes the free object of its class that it overlaps most. Objects that are hidden,
    too low or ignored need not be found, and detections on them do not count.

    Args:
        detections: one an image, of KITTI's three classes.
        images: with labels.
        lowest: pixels of the image; objects and detections less high are not counted.
    """
    rows: list[tuple[float, int, bool, bool]] = []
    masks: list[tuple[float, int]] = []
    objects = np.zeros(len(KITTI_CLASSES), dtype=np.int64)
    for found, image in zip(detections, images, strict=True):
        low = image.boxes[:, 3] - image.boxes[:, 1] < lowest
        labels = np.where(low, IGNORED, image.labels)
        objects += np.bincount(labels[labels >= 0], minlength=len(objects))
        found = found[np.argsort(-found.scores, kind="stable")]
        taken = [match(found, image.boxes, labels, overlap) for overlap in OVERLAPS]
        passed = (found.boxes[:, 3] - found.boxes[:, 1] < lowest) | _on_ignored(found, image, labels)
        for row in range(len(found)):
            hits = [bool(chosen[row] >= 0) for chosen in taken]
            if hits[0] or not passed[row]:
                rows.append((float(found.scores[row]), int(found.labels[row]), hits[0], hits[1]))
            if hits[0] and image.owner is not None and found.masks is not None:
                masks.append((_mask_iou(found, row, image, int(taken[0][row])), int(found.labels[row])))
    table, pairs = np.array(rows).reshape(-1, 4), np.array(masks).reshape(-1, 2)
    return ImageEvaluation(
        table[:, 0],
        table[:, 1].astype(np.int64),
        table[:, 2:].astype(bool),
        objects,
        pairs[:, 0],
        pairs[:, 1].astype(np.int64),
    )


def match(found: Detections2D, boxes: FloatArray, labels: IntArray, overlap: float) -> IntArray:
    """(N,) object that each detection (by falling score) finds, -1 for none."""
    iou = image_iou(found.boxes, boxes)
    iou[found.labels[:, None] != labels[None]] = 0
    taken = np.full(len(found), -1, dtype=np.int64)
    for row in range(len(found) if len(boxes) else 0):
        best = int(iou[row].argmax())
        if iou[row, best] >= overlap:
            taken[row] = best
            iou[:, best] = 0
    return taken


def average_precision(scores: FloatArray, hits: BoolArray, objects: int) -> float:
    """Mean over 40 recalls of the best precision at that recall or above; NaN without objects."""
    if not objects:
        return float("nan")
    ranked = hits[np.argsort(-scores, kind="stable")]
    true = np.cumsum(ranked)
    precision = np.maximum.accumulate((true / np.arange(1, len(true) + 1))[::-1])[::-1]
    reached = np.searchsorted(true / objects, RECALLS - 1e-9)
    return float(np.append(precision, np.zeros(1))[np.minimum(reached, len(precision))].mean())


def _on_ignored(found: Detections2D, image: LabelledImage, labels: IntArray) -> BoolArray:
    """(N,) whether a detection lies on an object that need not be found."""
    boxes = np.concatenate([image.boxes[labels < 0], image.visible[labels < 0]])
    if not len(boxes):
        return np.zeros(len(found), dtype=bool)
    covered: BoolArray = image_cover(found.boxes, boxes).max(axis=1) > ON_IGNORED
    return covered


def _mask_iou(found: Detections2D, row: int, image: LabelledImage, index: int) -> float:
    assert found.masks is not None
    assert image.owner is not None
    mask = found.masks[row]
    true = image.owner == image.numbers[index]
    if mask is None:
        return 0.0
    predicted = np.zeros_like(true)
    height, width = mask.bitmap.shape
    predicted[mask.y : mask.y + height, mask.x : mask.x + width] = mask.bitmap
    either = int((true | predicted).sum())
    return float((true & predicted).sum() / either) if either else 1.0

"""Wide images in overlapping tiles, so that a detector with a small square input sees distant objects larger."""

from __future__ import annotations

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, Detections2D, FloatArray, InstanceMask, IntArray

# neighbouring tiles share this part of a tile's width
OVERLAP = 0.2
# a box that ends nearer than this to the inner border of its tile may be cut there, in pixels
BORDER = 3.0


@kernel
def _suppress(boxes, labels, order, threshold):  # type: ignore[no-untyped-def]
    """Mask of the boxes that no higher-ranked kept box of the same label overlaps by more than ``threshold``."""
    kept = np.zeros(len(boxes), dtype=np.bool_)
    survivors = np.empty(len(boxes), dtype=np.int64)
    count = 0
    for i in order:
        x1, y1, x2, y2 = boxes[i]
        area = (x2 - x1) * (y2 - y1)
        free = True
        for s in range(count):
            j = survivors[s]
            if labels[i] != labels[j]:
                continue
            width = min(x2, boxes[j, 2]) - max(x1, boxes[j, 0])
            height = min(y2, boxes[j, 3]) - max(y1, boxes[j, 1])
            if width > 0.0 and height > 0.0:
                shared = width * height
                union = area + (boxes[j, 2] - boxes[j, 0]) * (boxes[j, 3] - boxes[j, 1]) - shared
                if shared > threshold * union:
                    free = False
                    break
        if free:
            kept[i] = True
            survivors[count] = i
            count += 1
    return kept


def non_maximum_suppression(boxes: FloatArray, scores: FloatArray, labels: IntArray, threshold: float) -> IntArray:
    """Greedy suppression of overlapping 2D boxes, each class for itself.

    Args:
        boxes: (N, 4) pixels.
        scores: (N,).
        labels: (N,); only boxes of equal label suppress each other.
        threshold: a box goes when its IoU with a kept, higher-scored one is greater.

    Returns:
        Indices of the kept boxes, by descending score; ties keep the input order.
    """
    order = np.argsort(-scores, kind="stable")
    kept = _suppress(np.ascontiguousarray(boxes, dtype=np.float64), np.asarray(labels), order, threshold)
    result: IntArray = order[kept[order]]
    return result


def tile_spans(width: int, tiles: int) -> list[tuple[int, int]]:
    """Columns (start, stop) of ``tiles`` equally wide tiles that cover an image, overlapping by `OVERLAP` of a tile."""
    if tiles < 1:
        raise ConfigError(f"tiles must be 1 or more, got {tiles}")
    tile_width = min(width, int(np.ceil(width / (tiles - (tiles - 1) * OVERLAP))))
    starts = np.round(np.linspace(0, width - tile_width, tiles)).astype(int)
    return [(int(start), int(start) + tile_width) for start in starts]


def whole_in_tile(boxes: FloatArray, span: tuple[int, int], width: int) -> BoolArray:
    """(N,) whether each of (N, 4) boxes, in image pixels, is surely not cut by an inner border of its tile.

    Whatever an inner border cuts is seen whole by the neighbouring tile if it is narrower than the overlap, and is
    large enough for the pass over the whole image if it is wider.
    """
    start, stop = span
    cut = np.zeros(len(boxes), dtype=bool)
    if start > 0:
        cut |= boxes[:, 0] < start + BORDER
    if stop < width:
        cut |= boxes[:, 2] > stop - BORDER
    return ~cut


def shift(detections: Detections2D, offset: int) -> Detections2D:
    """Detections of a tile in the pixels of the image that the tile starts in at column ``offset``."""
    masks = detections.masks
    if masks is not None:
        masks = tuple(None if m is None else InstanceMask(m.x + offset, m.y, m.bitmap) for m in masks)
    boxes = detections.boxes + np.array([offset, 0, offset, 0])
    return Detections2D(boxes, detections.scores, detections.labels, detections.class_names, masks)


def merge_tiles(
    whole: Detections2D, parts: list[Detections2D], spans: list[tuple[int, int]], width: int, threshold: float
) -> Detections2D:
    """One list from the passes over the whole image and over its tiles.

    Args:
        whole: detections of the pass over the whole image.
        parts: detections of each tile, in pixels of the tile.
        spans: columns of each tile, from `tile_spans`.
        width: of the image.
        threshold: IoU above which two boxes of a class are one object.

    Returns:
        Detections in image pixels, by descending score.
    """
    shifted = [shift(part, span[0]) for part, span in zip(parts, spans, strict=True)]
    complete = [part[whole_in_tile(part.boxes, span, width)] for part, span in zip(shifted, spans, strict=True)]
    joined = Detections2D.concatenate([whole, *complete])
    return joined[non_maximum_suppression(joined.boxes, joined.scores, joined.labels, threshold)]

"""Non-maximum suppression in bird's-eye view, and the modes in which the LiDAR branch uses it."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.geometry.iou import pair_bev_iou
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, IntArray

NmsMode = Literal["off", "low", "keep"]
"""``off``: none, as the paper wants it (section 4.1.2); ``low``: only near-copies go; ``keep``: the network's own."""

LOW_NMS_IOU = 0.7
"""Overlap above which the mode ``low`` takes two boxes for copies of one another."""


def suppression_threshold(mode: NmsMode, own: float) -> float:
    """The IoU above which the lower-scored of two boxes goes: 1 for none, 0.7 for few, or the network's ``own``.

    Raises:
        ConfigError: ``mode`` is none of the three.
    """
    if mode not in get_args(NmsMode):
        raise ConfigError(f"nms must be one of {', '.join(get_args(NmsMode))}, got {mode!r}")
    return {"off": 1.0, "low": max(LOW_NMS_IOU, own), "keep": own}[mode]


@kernel
def _greedy(boxes, iou_threshold):  # type: ignore[no-untyped-def]
    kept = np.empty(len(boxes), np.int64)
    n = 0
    for i in range(len(boxes)):
        free = True
        for k in range(n):
            if pair_bev_iou(boxes[kept[k]], boxes[i]) > iou_threshold:
                free = False
                break
        if free:
            kept[n] = i
            n += 1
    return kept[:n]


def bev_nms(boxes: FloatArray, scores: FloatArray, iou_threshold: float) -> IntArray:
    """Indices of the boxes that stay, best score first.

    Args:
        boxes: (N, 7) with x, y, length, width and yaw where a canonical box has them (the z convention is not used).
        scores: (N,).
        iou_threshold: a box that overlaps a better one by more than this goes; 1 or more keeps all.
    """
    order: IntArray = np.argsort(-scores, kind="stable")
    if iou_threshold >= 1:
        return order
    kept: IntArray = order[_greedy(np.ascontiguousarray(boxes[order, :7], dtype=np.float64), float(iou_threshold))]
    return kept

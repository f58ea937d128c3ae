"""Objects that a frame misses: where tracks expect them, and what the frame's sensors see there instead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lcf3d.geometry.boxes import box_corners, points_in_boxes
from lcf3d.geometry.camera import depths_of, project_boxes
from lcf3d.geometry.iou import image_area, image_iou
from lcf3d.provenance import FusedDetections
from lcf3d.structures import BoolArray, Camera, FloatArray, IntArray

# a box this much farther away than another may be hidden by it, metres
BEHIND = 1.0
# image IoU at which a 2D detection is taken to show a predicted box
CAMERA_IOU = 0.4
# fewer laser beams towards a box than this say nothing
MIN_BEAMS = 5


def seen_by(boxes: FloatArray, cameras: Sequence[Camera]) -> BoolArray:
    """(N,) whether any camera looks at each of (N, 7) boxes in the LiDAR frame; all of them where there is none."""
    if not cameras:
        return np.ones(len(boxes), dtype=bool)
    visible = np.zeros(len(boxes), dtype=bool)
    for camera in cameras:
        visible |= project_boxes(boxes, camera)[1]
    return visible


def hidden_share(boxes: FloatArray, others: FloatArray, cameras: Sequence[Camera]) -> FloatArray:
    """(N,) the largest share of each box's projection that one nearer box of ``others`` (M, 7) covers, 0 to 1.

    Where several cameras look at a box, the one that sees most of it counts.
    """
    least = np.full(len(boxes), np.inf)
    for camera in cameras:
        own, visible = project_boxes(boxes, camera)
        theirs, _ = project_boxes(others, camera)
        sides = np.minimum(own[:, None, 2:], theirs[None, :, 2:]) - np.maximum(own[:, None, :2], theirs[None, :, :2])
        shared = np.maximum(sides, 0).prod(axis=2) / np.maximum(image_area(own), 1e-9)[:, None]
        nearer = depths_of(others, camera)[None] < depths_of(boxes, camera)[:, None] - BEHIND
        share = np.where(nearer, shared, 0.0).max(axis=1, initial=0.0)
        least = np.where(visible, np.minimum(least, share), least)
    return np.where(np.isfinite(least), least, 0.0)


def free_camera_scores(
    boxes: FloatArray, labels: IntArray, fused: FusedDetections, cameras: Sequence[Camera]
) -> FloatArray:
    """(N,) best score of a 2D detection of the box's class on each box that led to no output, 0 without one."""
    best = np.zeros(len(boxes))
    if not len(boxes):
        return best
    by_name = {camera.name: camera for camera in cameras}
    for c, (name, found) in enumerate(zip(fused.camera_names, fused.camera_inputs, strict=True)):
        rows = np.flatnonzero((fused.camera.camera == c) & (fused.camera.output < 0))
        if name not in by_name or not len(rows):
            continue
        found = found[fused.camera.detection[rows]].with_classes(fused.detections.class_names)
        projected, visible = project_boxes(boxes, by_name[name])
        shows = (image_iou(projected, found.boxes) > CAMERA_IOU) & (labels[:, None] == found.labels[None])
        scores = np.where(shows & visible[:, None], found.scores[None], 0.0)
        best = np.maximum(best, scores.max(axis=1, initial=0.0))
    return best


def free_share(boxes: FloatArray, points: NDArray[np.floating]) -> FloatArray:
    """(N,) of the laser beams that went to each box or through it, the share that went through: free space.

    A beam goes through a box when its return lies in the box's angular window, farther than the box's far side.
    Returns nearer than the box say nothing. 0 where fewer than ``MIN_BEAMS`` beams speak.

    Args:
        boxes: (N, 7) in the LiDAR frame, not around the sensor.
        points: (P, 3 or more) the scan.
    """
    free = np.zeros(len(boxes))
    if not len(boxes):
        return free
    ranges = np.hypot(points[:, 0], points[:, 1])
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    slopes = points[:, 2] / np.maximum(ranges, 1e-6)
    for i, (box, corners) in enumerate(zip(boxes, box_corners(boxes), strict=True)):
        middle, reach = np.arctan2(box[1], box[0]), np.hypot(corners[:, 0], corners[:, 1])
        turn = np.abs(np.angle(np.exp(1j * (np.arctan2(corners[:, 1], corners[:, 0]) - middle))))
        off = np.abs(azimuths - middle)
        # the inner half of the window: beams at the rim pass by the box
        window = np.minimum(off, 2 * np.pi - off) < turn.max() / 2
        low, high = (box[2] - box[5] / 4) / reach.mean(), (box[2] + box[5] / 4) / reach.mean()
        window &= (slopes > low) & (slopes < high) & (ranges > reach.min())
        near = points[window]
        inside = int(points_in_boxes(near, box[None])[0].sum())
        through = int((ranges[window] > reach.max()).sum())
        if inside + through >= MIN_BEAMS:
            free[i] = through / (inside + through)
    return free

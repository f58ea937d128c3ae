"""Objects that a frame misses: where tracks expect them, and what the frame's sensors see there instead."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.geometry.boxes import box_corners, points_in_boxes
from lcf3d.geometry.camera import depths_of, project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.kernels import kernel
from lcf3d.provenance import FusedDetections
from lcf3d.structures import BoolArray, Camera, FloatArray, IntArray

# a box this much farther away than another may be hidden by it, metres
BEHIND = 1.0
# image IoU at which a 2D detection is taken to show a predicted box
CAMERA_IOU = 0.4
# fewer laser beams towards a box than this say nothing
MIN_BEAMS = 5


class View(NamedTuple):
    """Boxes as one camera sees them: (N, 4) pixel boxes and (N,) whether it sees them at all."""

    camera: Camera
    pixels: FloatArray
    visible: BoolArray


def views_of(boxes: FloatArray, cameras: Sequence[Camera]) -> list[View]:
    """(N, 7) boxes in the LiDAR frame as each camera sees them."""
    return [View(camera, *project_boxes(boxes, camera)) for camera in cameras]


def seen_by(views: Sequence[View], n: int) -> BoolArray:
    """(N,) whether any camera looks at each of the ``n`` boxes; all of them where there is no camera."""
    if len(views) == 1:
        return views[0].visible
    seen = np.full(n, not views)
    for view in views:
        seen |= view.visible
    return seen


def hidden_share(boxes: FloatArray, others: FloatArray, views: Sequence[View]) -> FloatArray:
    """(N,) the largest share of each box's projection that one nearer box of ``others`` (M, 7) covers, 0 to 1.

    Where several cameras look at a box, the one that sees most of it counts.

    Args:
        boxes: (N, 7) in the LiDAR frame.
        others: (M, 7) that may hide them.
        views: of the ``boxes``.
    """
    least = np.full(len(boxes), np.inf)
    for camera, pixels, visible in views:
        theirs, _ = project_boxes(others, camera)
        _cover(pixels, visible, depths_of(boxes, camera) - BEHIND, theirs, depths_of(others, camera), least)
    return np.where(np.isfinite(least), least, 0.0)


@kernel
def _cover(own, visible, limits, theirs, depths, least):  # type: ignore[no-untyped-def]
    """Lower ``least`` (N,) to the share that one of ``theirs`` (M, 4), nearer than ``limits`` (N,), covers most."""
    for i in range(len(own)):
        if not visible[i]:
            continue
        area = max((own[i, 2] - own[i, 0]) * (own[i, 3] - own[i, 1]), 1e-9)
        most = 0.0
        for j in range(len(theirs)):
            if depths[j] < limits[i]:
                width = min(own[i, 2], theirs[j, 2]) - max(own[i, 0], theirs[j, 0])
                height = min(own[i, 3], theirs[j, 3]) - max(own[i, 1], theirs[j, 1])
                if width > 0 and height > 0:
                    most = max(most, width * height / area)
        least[i] = min(least[i], most)


def free_camera_scores(labels: IntArray, fused: FusedDetections, views: Sequence[View]) -> FloatArray:
    """(N,) best score of a 2D detection of the box's class on each box that led to no output, 0 without one.

    Args:
        labels: (N,) of the boxes.
        fused: whose 2D detections.
        views: of the boxes.
    """
    best = np.zeros(len(labels))
    by_name = {view.camera.name: view for view in views}
    free = fused.camera.output < 0
    if not len(labels) or not free.any():
        return best
    for c, (name, found) in enumerate(zip(fused.camera_names, fused.camera_inputs, strict=True)):
        rows = np.flatnonzero((fused.camera.camera == c) & free)
        if name not in by_name or not len(rows):
            continue
        found = found[fused.camera.detection[rows]].with_classes(fused.detections.class_names)
        _, projected, visible = by_name[name]
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

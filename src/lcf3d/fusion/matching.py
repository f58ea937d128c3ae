"""Bounding box matching: LiDAR clusters assigned to camera detections (paper section 4.1.3, equations 3-4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from lcf3d.fusion.clustering import Clusters
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, Camera, Detections3D, FloatArray, IntArray

Assignment = Literal["gated", "paper"]


class View(NamedTuple):
    """What one camera says of the clusters.

    Attributes:
        boxes: (N, 4) projections of the LiDAR boxes, clipped to the image.
        visible: (C,) whether any member of a cluster is visible.
        iou: (C, M) image IoU of clusters and 2D detections.
        match: (C,) the 2D detection that each cluster is matched with, or -1.
    """

    boxes: FloatArray
    visible: BoolArray
    iou: FloatArray
    match: IntArray


class Matches(NamedTuple):
    """Clusters over all cameras; a cluster matched in several has the camera of highest IoU as its primary match.

    Attributes:
        camera: (C,) primary camera, or -1.
        detection: (C,) 2D detection in the primary camera, or -1.
        iou: (C,) image IoU of the primary match, NaN without one.
        visible: (C,) whether any camera looks at the cluster.
    """

    camera: IntArray
    detection: IntArray
    iou: FloatArray
    visible: BoolArray


def cluster_iou(projected: FloatArray, visible: BoolArray, clusters: Clusters, boxes2d: FloatArray) -> FloatArray:
    """(C, M) IoU of clusters and 2D boxes: the highest among the visible members (paper equation 3).

    Args:
        projected: (N, 4) projections of the 3D boxes.
        visible: (N,) which of them are visible.
        clusters: their clusters.
        boxes2d: (M, 4) camera detections.
    """
    iou: FloatArray = _cluster_iou(projected, visible, clusters.index, np.array(boxes2d), len(clusters))[0]
    return iou


@kernel
def _cluster_iou(projected, visible, cluster_of_box, boxes2d, clusters):  # type: ignore[no-untyped-def]
    """(C, M) the highest IoU of each cluster's visible members with each 2D box; (C,) whether any is visible."""
    result, seen = np.zeros((clusters, len(boxes2d))), np.zeros(clusters, np.bool_)
    for i in range(len(projected)):
        if not visible[i] or cluster_of_box[i] < 0:
            continue
        c = cluster_of_box[i]
        seen[c] = True
        x1, y1, x2, y2 = projected[i, 0], projected[i, 1], projected[i, 2], projected[i, 3]
        area = (x2 - x1) * (y2 - y1)
        for m in range(len(boxes2d)):
            width = min(x2, boxes2d[m, 2]) - max(x1, boxes2d[m, 0])
            height = min(y2, boxes2d[m, 3]) - max(y1, boxes2d[m, 1])
            if width > 0.0 and height > 0.0:
                shared = width * height
                union = area + (boxes2d[m, 2] - boxes2d[m, 0]) * (boxes2d[m, 3] - boxes2d[m, 1]) - shared
                result[c, m] = max(result[c, m], shared / union)
    return result, seen


@kernel
def _assign_undisputed(iou, iou_threshold, match):  # type: ignore[no-untyped-def]
    """Fill ``match`` (C,) with the one good 2D box of every cluster; False where two claim one and must be weighed."""
    taken = np.zeros(iou.shape[1], np.bool_)
    for c in range(iou.shape[0]):
        for m in range(iou.shape[1]):
            if iou[c, m] > iou_threshold:
                if match[c] >= 0 or taken[m]:
                    return False
                match[c], taken[m] = m, True
    return True


@kernel
def _free_iou(iou, allowed, match):  # type: ignore[no-untyped-def]
    """``iou`` (C, M) of the allowed pairs of which neither is matched yet, else 0."""
    free, taken = np.zeros(iou.shape), np.zeros(iou.shape[1], np.bool_)
    for c in range(iou.shape[0]):
        if match[c] >= 0:
            taken[match[c]] = True
    for c in range(iou.shape[0]):
        for m in range(iou.shape[1]):
            if allowed[c, m] and match[c] < 0 and not taken[m]:
                free[c, m] = iou[c, m]
    return free


def assign(iou: FloatArray, iou_threshold: float, method: Assignment = "gated") -> IntArray:
    """One-to-one assignment of clusters to 2D detections that maximises the sum of IoU (paper equation 4).

    Solved by the Jonker-Volgenant algorithm. ``paper`` assigns on the full matrix and then drops pairs not above the
    threshold; ``gated`` zeroes those entries first, so that a hopeless pair cannot displace a good one.

    Args:
        iou: (C, M) image IoU.
        iou_threshold: ``tau_b``, exclusive.
        method: see above.

    Returns:
        (C,) index of the 2D detection, or -1.
    """
    match = np.full(iou.shape[0], -1, dtype=np.int64)
    if method == "gated" and _assign_undisputed(iou, iou_threshold, match):
        return match
    from scipy.optimize import linear_sum_assignment

    match[:] = -1
    good = iou > iou_threshold
    if not good.any():
        return match
    if method == "gated":
        # rows and columns without any good entry can only hold zeros: leave them out
        rows, columns = np.flatnonzero(good.any(axis=1)), np.flatnonzero(good.any(axis=0))
        picked = np.ix_(rows, columns)
        r, c = linear_sum_assignment(np.where(good[picked], iou[picked], 0.0), maximize=True)
        r, c = rows[r], columns[c]
    else:
        r, c = linear_sum_assignment(iou, maximize=True)
    kept = good[r, c]
    match[r[kept]] = c[kept]
    return match


def match_view(
    boxes: FloatArray,
    clusters: Clusters,
    camera: Camera,
    boxes2d: FloatArray,
    *,
    iou_threshold: float,
    method: Assignment = "gated",
    rounds: Sequence[BoolArray] = (),
) -> View:
    """Project (N, 7) boxes into one camera and match their clusters with its (M, 4) detections.

    Args:
        boxes: (N, 7) LiDAR boxes.
        clusters: their clusters.
        camera: the camera.
        boxes2d: (M, 4) its detections.
        iou_threshold: see `assign`.
        method: see `assign`.
        rounds: (C, M) masks: pairs of the first are assigned first, then those of the next among what is left over;
            all pairs at once if empty.
    """
    projected, visible = project_boxes(boxes, camera)
    iou, seen = _cluster_iou(projected, visible, clusters.index, np.array(boxes2d), len(clusters))
    if not rounds:
        return View(projected, seen, iou, assign(iou, iou_threshold, method))
    match = np.full(len(clusters), -1, dtype=np.int64)
    for allowed in rounds:
        added = assign(_free_iou(iou, allowed, match), iou_threshold, method)
        np.maximum(match, added, out=match)
    return View(projected, seen, iou, match)


def boxes_after(detections: Detections3D, seconds: float) -> FloatArray:
    """(N, 7) boxes as they are some seconds later; those of unknown velocity have stayed."""
    if not seconds or detections.velocities is None:
        return detections.boxes
    boxes = detections.boxes.copy()
    boxes[:, :2] += seconds * np.nan_to_num(detections.velocities)
    return boxes


def merge_views(views: Sequence[View], cluster_count: int) -> Matches:
    """The matches of all cameras: each cluster once, through the camera of highest IoU (docs/method.md, matching 7)."""
    camera = np.full(cluster_count, -1, dtype=np.int64)
    detection = np.full(cluster_count, -1, dtype=np.int64)
    best = np.full(cluster_count, np.nan)
    visible = np.zeros(cluster_count, dtype=bool)
    for v, view in enumerate(views):
        _merge(v, view.visible, view.match, view.iou, camera, detection, best, visible)
    return Matches(camera, detection, best, visible)


@kernel
def _merge(v, seen, match, iou, camera, detection, best, visible):  # type: ignore[no-untyped-def]
    """Take in what camera ``v`` says of the clusters, see `merge_views`."""
    for c in range(len(match)):
        visible[c] = visible[c] or seen[c]
        # not best at all where there is none yet
        if match[c] >= 0 and not iou[c, match[c]] <= best[c]:
            camera[c], detection[c], best[c] = v, match[c], iou[c, match[c]]


def confirmed_elsewhere(
    views: Sequence[View], matches: Matches, clusters: Clusters, boxes2d: FloatArray, at: int, iou_threshold: float
) -> BoolArray:
    """Which of the (M, 4) 2D boxes of camera ``at`` show an object that was confirmed through another camera only.

    Such a box overlaps, with IoU above the threshold, the projection of a cluster that is matched elsewhere and not
    here; it is no candidate for recovery (docs/method.md, matching 7).
    """
    others = (matches.camera >= 0) & (views[at].match < 0)
    if not others.any():
        return np.zeros(len(boxes2d), dtype=bool)
    shown = image_iou(views[at].boxes[clusters.representative[others]], boxes2d)
    return np.asarray((shown > iou_threshold).any(axis=0))

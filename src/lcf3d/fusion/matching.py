"""Bounding box matching: LiDAR clusters assigned to camera detections (paper section 4.1.3, equations 3-4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from lcf3d.fusion.clustering import Clusters
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.structures import BoolArray, Camera, FloatArray, IntArray

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
    result = np.zeros((len(clusters), len(boxes2d)))
    members = np.flatnonzero(visible & (clusters.index >= 0))
    if len(members) and len(boxes2d):
        members = members[np.argsort(clusters.index[members], kind="stable")]
        numbers, first = np.unique(clusters.index[members], return_index=True)
        result[numbers] = np.maximum.reduceat(image_iou(projected[members], boxes2d), first, axis=0)
    return result


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
    from scipy.optimize import linear_sum_assignment

    match = np.full(iou.shape[0], -1, dtype=np.int64)
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
) -> View:
    """Project (N, 7) boxes into one camera and match their clusters with its (M, 4) detections."""
    projected, visible = project_boxes(boxes, camera)
    iou = cluster_iou(projected, visible, clusters, boxes2d)
    seen = np.zeros(len(clusters), dtype=bool)
    seen[clusters.index[visible & (clusters.index >= 0)]] = True
    return View(projected, seen, iou, assign(iou, iou_threshold, method))


def merge_views(views: Sequence[View], cluster_count: int) -> Matches:
    """The matches of all cameras: each cluster once, through the camera of highest IoU (METHOD, matching 7)."""
    camera = np.full(cluster_count, -1, dtype=np.int64)
    detection = np.full(cluster_count, -1, dtype=np.int64)
    best = np.full(cluster_count, np.nan)
    visible = np.zeros(cluster_count, dtype=bool)
    for v, view in enumerate(views):
        visible |= view.visible
        matched = np.flatnonzero(view.match >= 0)
        iou = view.iou[matched, view.match[matched]]
        better = ~(iou <= best[matched])  # also where there is none yet
        rows = matched[better]
        camera[rows], detection[rows], best[rows] = v, view.match[rows], iou[better]
    return Matches(camera, detection, best, visible)


def confirmed_elsewhere(
    views: Sequence[View], matches: Matches, clusters: Clusters, boxes2d: FloatArray, at: int, iou_threshold: float
) -> BoolArray:
    """Which of the (M, 4) 2D boxes of camera ``at`` show an object that was confirmed through another camera only.

    Such a box overlaps, with IoU above the threshold, the projection of a cluster that is matched elsewhere and not
    here; it is no candidate for recovery (METHOD, matching 7).
    """
    others = (matches.camera >= 0) & (views[at].match < 0)
    shown = image_iou(views[at].boxes[clusters.representative[others]], boxes2d)
    return np.asarray((shown > iou_threshold).any(axis=0))

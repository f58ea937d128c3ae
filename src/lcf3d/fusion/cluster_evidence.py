"""Evidence of both branches for every cluster of a frame: what the formula of `lcf3d.fusion.evidence` is fed with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lcf3d.fusion.branches import Branches
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.clustering import cluster_boxes
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.evidence import (
    Evidence,
    evidence_table,
    ground_slope,
    miss_exposure,
    to_log_odds,
    to_probability,
)
from lcf3d.fusion.matching import Matches, View
from lcf3d.geometry.camera import cut_by_field
from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, FloatArray, IntArray


class ClusterEvidence(NamedTuple):
    """One row a cluster.

    Attributes:
        box: (C,) the LiDAR detection that stands for it.
        table: (C, 9) see `evidence_table`.
        labels: (C,) its LiDAR label.
        agreed: (C,) whether it is matched with a detection of that label, or with none.
    """

    box: IntArray
    table: FloatArray
    labels: IntArray
    agreed: BoolArray


def gather_evidence(
    box: IntArray,
    branches: Branches,
    views: Sequence[View],
    matches: Matches,
    config: FusionConfig,
    calibration: Calibration,
) -> ClusterEvidence:
    """Collect the evidence for every cluster, represented by the LiDAR detections ``box``."""
    boxes, scores, own = branches.lidar.boxes[box], branches.lidar.scores[box], branches.lidar.labels[box]
    camera_scores, labels = np.zeros(len(box)), own.copy()
    exposure = np.zeros(len(box))
    for c, (view, found, camera) in enumerate(zip(views, branches.camera, branches.cameras, strict=True)):
        here = matches.camera == c
        camera_scores[here] = found.scores[matches.detection[here]]
        labels[here] = found.labels[matches.detection[here]]
        projected = view.boxes[box]
        plain = miss_exposure(projected, camera.width, camera.height)
        plain[~view.visible] = 0.0
        if camera.distortion is not None:
            plain[cut_by_field(projected, camera)] = 0.0
        np.maximum(exposure, plain, out=exposure)
    table = evidence_table(
        to_log_odds(scores),
        competing_scores(boxes, scores, own, config),
        ground_slope(boxes, calibration.ground_z),
        exposure,
        camera_scores,
        np.where(matches.camera >= 0, matches.iou, 0.0),
    )
    return ClusterEvidence(box, table, own, labels == own)


def fused_scores(weighed: ClusterEvidence, weights: FloatArray) -> FloatArray:
    """(C,) probability of every cluster, by the weights of its class, which are (L, 9)."""
    return to_probability((weighed.table * weights[weighed.labels]).sum(axis=1))


def evidence_of(name: str, config: FusionConfig, calibration: Calibration) -> Evidence:
    """The weights of a class: those of the calibration, else those of the settings, else the defaults."""
    return calibration.evidence.get(name) or config.evidence_of(name)


def recovered_trust(config: FusionConfig, calibration: Calibration) -> FloatArray:
    """(L,) by class, what scores of recovered boxes are multiplied with, see `Evidence`."""
    return np.array([evidence_of(name, config, calibration).recovered for name in config.class_names])


def competing_scores(boxes: FloatArray, scores: FloatArray, labels: IntArray, config: FusionConfig) -> FloatArray:
    """(N,) score of the best box of another class that shares a clique with each box; 0 where that is not higher.

    LiDAR detectors report one object under two classes; the paper's cluster-wise suppression would delete the lower,
    here it loses evidence instead.
    """
    if not config.class_aware or not len(labels) or (labels == labels[0]).all():
        return np.zeros(len(boxes))
    cluster = cluster_boxes(boxes, scores, labels, method="cliques", iou_threshold=config.cluster_iou).index
    # copies, because a compiled version for arrays that are read-only would be another one
    competing: FloatArray = _competing(np.argsort(cluster, kind="stable"), cluster, np.array(scores), np.array(labels))
    return competing


@kernel
def _competing(order, cluster, scores, labels):  # type: ignore[no-untyped-def]
    """See `competing_scores`; ``order`` brings the boxes of each cluster together."""
    competing = np.zeros(len(order))
    start = 0
    while start < len(order):
        end = start + 1
        while end < len(order) and cluster[order[end]] == cluster[order[start]]:
            end += 1
        for i in order[start:end]:
            for j in order[start:end]:
                if labels[j] != labels[i] and scores[j] > scores[i]:
                    competing[i] = max(competing[i], scores[j])
        start = end
    return competing

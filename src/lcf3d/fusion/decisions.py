"""What becomes of every cluster and candidate: the output detections and the table of reasons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lcf3d.fusion.branches import Branches
from lcf3d.fusion.clustering import SUPPRESSED, Clusters
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.matching import Matches, View
from lcf3d.fusion.recovery import Recovery
from lcf3d.fusion.semantic import Ensemble, fuse_scores, semantic_fusion
from lcf3d.geometry.iou import bev_iou
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray, IntArray, with_columns


class ClusterDecisions(NamedTuple):
    """One row a cluster.

    Attributes:
        box: (C,) the LiDAR detection that stands for the cluster.
        outcome: (C,) `Outcome` codes.
        reason: (C,) `Reason` codes.
        scores: (C,) scores after fusion.
        labels: (C,) labels after fusion.
    """

    box: IntArray
    outcome: IntArray
    reason: IntArray
    scores: FloatArray
    labels: IntArray


def choose_representatives(branches: Branches, clusters: Clusters, matches: Matches, config: FusionConfig) -> IntArray:
    """(C,) the LiDAR detection that stands for each cluster (docs/method.md, matching 5)."""
    box = clusters.representative.copy()
    if config.representative == "camera_class":
        matched = np.flatnonzero(matches.camera >= 0)
        _, camera_labels = _matched_detections(branches, matches, matched)
        box[matched] = [
            _best_of_class(branches.lidar, clusters, int(c), int(label))
            for c, label in zip(matched, camera_labels, strict=True)
        ]
    return box


def decide_clusters(
    box: IntArray,
    branches: Branches,
    matches: Matches,
    config: FusionConfig,
    judged: BoolArray,
    weighed: FloatArray | None = None,
) -> ClusterDecisions:
    """Semantic fusion for matched clusters (Algorithm 1), a policy for the others (docs/method.md, matching 6).

    Args:
        box: (C,) the LiDAR detection that stands for each cluster.
        branches: what takes part.
        matches: of the clusters.
        config: settings.
        judged: (C,) whether the camera branch detects the cluster's class at all; if not, LiDAR stands alone.
        weighed: (C,) scores by the evidence of both branches, for ``ensemble: evidence``.
    """
    lidar = branches.lidar
    matched = np.flatnonzero(matches.camera >= 0)
    camera_scores, camera_labels = _matched_detections(branches, matches, matched)
    scores, labels = lidar.scores[box], lidar.labels[box]
    outcome = np.full(len(box), Outcome.KEPT.value, dtype=np.int64)
    reason = np.full(len(box), Reason.UNCONFIRMED.value, dtype=np.int64)

    agreed = labels[matched] == camera_labels
    if config.ensemble != "none":
        ensemble: Ensemble = "product" if config.ensemble == "product" else "probabilistic"
        # a camera detection that is not sure enough of another class confirms the box and leaves it as it is
        sure = agreed | (camera_scores > config.relabel_score)
        fused = matched[sure]
        scores[fused], labels[fused] = semantic_fusion(
            scores[fused], labels[fused], camera_scores[sure], camera_labels[sure], config.prior_array(), ensemble
        )
    if weighed is not None:
        scores[matched[agreed]] = weighed[matched[agreed]]
    outcome[matched], reason[matched] = Outcome.MATCHED.value, Reason.CONFIRMED.value

    unseen = ~matches.visible
    unseen[matched] = False
    reason[unseen] = Reason.OUT_OF_VIEW.value
    # with no camera at all nobody could look: the LiDAR branch then stands alone
    if config.out_of_view == "drop" and branches.cameras:
        outcome[unseen] = Outcome.DROPPED.value
    reason[matches.visible & ~judged] = Reason.CLASS_NOT_DETECTED.value
    unconfirmed = matches.visible & judged & (matches.camera < 0)
    if config.unmatched == "drop":
        outcome[unconfirmed] = Outcome.DROPPED.value
    elif config.unmatched == "downweight":
        reason[unconfirmed] = Reason.DOWNWEIGHTED.value
        scores[unconfirmed] = (
            fuse_scores(scores, np.array(config.miss_likelihood), np.array(0.5))[unconfirmed]
            if weighed is None
            else weighed[unconfirmed]
        )
    return ClusterDecisions(box, outcome, reason, scores, labels)


def _matched_detections(branches: Branches, matches: Matches, matched: IntArray) -> tuple[FloatArray, IntArray]:
    """Scores and labels of the primary 2D detections of the matched clusters."""
    scores, labels = np.empty(len(matched)), np.empty(len(matched), dtype=np.int64)
    for c, found in enumerate(branches.camera):
        here = matches.camera[matched] == c
        scores[here] = found.scores[matches.detection[matched[here]]]
        labels[here] = found.labels[matches.detection[matched[here]]]
    return scores, labels


def _best_of_class(lidar: Detections3D, clusters: Clusters, cluster: int, label: int) -> int:
    """The highest-scoring member of a class, or of all classes where the cluster has none of it."""
    members = np.flatnonzero((clusters.index == cluster) & (lidar.labels == label))
    if not len(members):
        return int(clusters.representative[cluster])
    return int(members[np.argmax(lidar.scores[members])])


def settle_doubles(
    decisions: ClusterDecisions, lidar: Detections3D, recovery: Recovery, duplicate_iou: float
) -> tuple[ClusterDecisions, Recovery]:
    """One object comes out once: where a recovered box stands on a cluster kept without confirmation, the better stays.

    Better is the higher score. A camera that has turned finds every object beside its LiDAR box: a recovered box of
    0.35 must not take the place of a LiDAR box of 0.98.

    Args:
        decisions: of the clusters.
        lidar: what takes part.
        recovery: its ``scores`` on the scale of the decisions'.
        duplicate_iou: BEV IoU above which two boxes are one object.

    Returns:
        The decisions, clusters that give way dropped as ``REPLACED``; the recovery, boxes that do as ``DUPLICATE``.
    """
    found = recovery.found
    if not len(found):
        return decisions, recovery
    kept = np.flatnonzero(
        np.isin(
            decisions.reason, [Reason.UNCONFIRMED.value, Reason.DOWNWEIGHTED.value, Reason.CLASS_NOT_DETECTED.value]
        )
        & (decisions.outcome == Outcome.KEPT.value)
    )
    if not len(kept):
        return decisions, recovery
    double = bev_iou(lidar.boxes[decisions.box[kept]], recovery.boxes[found]) > duplicate_iou
    better = decisions.scores[kept][:, None] >= recovery.scores[found][None]
    doubles = found[(double & better).any(axis=0)]
    reasons = recovery.reason.copy()
    reasons[doubles] = Reason.DUPLICATE.value
    # a recovered box that gave way to one cluster takes the place of no other
    gone = kept[(double & ~better & ~np.isin(found, doubles)[None]).any(axis=1)]
    outcomes, reason = decisions.outcome.copy(), decisions.reason.copy()
    outcomes[gone], reason[gone] = Outcome.DROPPED.value, Reason.REPLACED.value
    return decisions._replace(outcome=outcomes, reason=reason), recovery._replace(reason=reasons)


def assemble(
    branches: Branches,
    clusters: Clusters,
    views: Sequence[View],
    matches: Matches,
    decisions: ClusterDecisions,
    recovery: Recovery,
    notes: Sequence[str],
    lidar_inputs: Detections3D,
    camera_inputs: tuple[Detections2D, ...],
) -> FusedDetections:
    """Output detections, highest score first, and the reason for every input."""
    surviving = (decisions.outcome != Outcome.DROPPED.value).nonzero()[0]
    found = recovery.found
    detections = with_columns(
        branches.lidar[decisions.box[surviving]],
        scores=decisions.scores[surviving],
        labels=decisions.labels[surviving],
    )
    if len(found):
        recovered = recovery.boxes[found], recovery.scores[found], recovery.labels[found]
        detections = Detections3D.concatenate([detections, Detections3D(*recovered, detections.class_names)])
    order = np.lexsort((*detections.boxes.T[::-1], -detections.scores))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    cluster_output = np.full(len(clusters), -1, dtype=np.int64)
    cluster_output[surviving] = place[: len(surviving)]

    _write_lidar_rows(branches, clusters, matches, decisions, cluster_output)
    _write_camera_rows(branches, views, matches, decisions, cluster_output)
    _write_recovery_rows(branches, recovery, place[len(surviving) :])
    return FusedDetections(
        detections=detections[order],
        lidar=branches.lidar_table,
        camera=branches.camera_table,
        lidar_inputs=lidar_inputs,
        camera_inputs=camera_inputs,
        camera_names=tuple(c.name for c in branches.cameras),
        notes=(*branches.notes, *notes),
    )


def _write_lidar_rows(
    branches: Branches, clusters: Clusters, matches: Matches, decisions: ClusterDecisions, cluster_output: IntArray
) -> None:
    """Fill the rows of the 3D detections that took part."""
    table, rows = branches.lidar_table, branches.lidar_index
    table.cluster[rows] = clusters.index
    table.reason[rows] = np.where(clusters.index == SUPPRESSED, Reason.SUPPRESSED.value, Reason.IN_CLUSTER.value)
    own = rows[decisions.box]
    table.outcome[own], table.reason[own] = decisions.outcome, decisions.reason
    table.camera[own], table.iou[own] = matches.camera, matches.iou
    table.output[own] = cluster_output
    lasting = decisions.outcome != Outcome.DROPPED.value
    table.score[own[lasting]] = decisions.scores[lasting]
    for c, chosen in enumerate(branches.camera_index):
        here = matches.camera == c
        table.detection[own[here]] = chosen[matches.detection[here]]
        table.camera_score[own[here]] = branches.camera[c].scores[matches.detection[here]]


def _write_camera_rows(
    branches: Branches, views: Sequence[View], matches: Matches, decisions: ClusterDecisions, cluster_output: IntArray
) -> None:
    """Fill the rows of the 2D detections that matched a cluster, in their primary camera or in another."""
    table = branches.camera_table
    for c, (view, chosen, start) in enumerate(zip(views, branches.camera_index, branches.camera_start, strict=True)):
        cluster = np.flatnonzero(view.match >= 0)
        detection = view.match[cluster]
        rows = start + chosen[detection]
        primary = (matches.camera[cluster] == c) & (matches.detection[cluster] == detection)
        table.outcome[rows] = Outcome.MATCHED.value
        table.reason[rows] = np.where(primary, Reason.CONFIRMED.value, Reason.OTHER_VIEW.value)
        table.cluster[rows] = cluster
        table.lidar[rows] = branches.lidar_index[decisions.box[cluster]]
        table.lidar_score[rows] = branches.lidar.scores[decisions.box[cluster]]
        table.iou[rows] = view.iou[cluster, detection]
        table.score[rows] = decisions.scores[cluster]
        table.output[rows] = cluster_output[cluster]


def _write_recovery_rows(branches: Branches, recovery: Recovery, outputs: IntArray) -> None:
    """Fill the rows of the 2D detections that were candidates for recovery, alike for both views of a pair."""
    table = branches.camera_table
    if not len(recovery.camera):
        return
    output = np.full(len(recovery.camera), -1, dtype=np.int64)
    output[recovery.found] = outputs
    first = _camera_rows(branches, recovery.camera, recovery.detection)
    paired = np.flatnonzero(recovery.second_camera >= 0)
    second = _camera_rows(branches, recovery.second_camera[paired], recovery.second_detection[paired])
    table.pair[first[paired]], table.pair[second] = second, first[paired]
    every = np.arange(len(first))
    for rows, own, iou in ((first, every, recovery.iou), (second, paired, recovery.second_iou[paired])):
        table.reason[rows], table.iou[rows], table.quality[rows] = recovery.reason[own], iou, recovery.quality[own]
        found = output[own] >= 0
        table.outcome[rows[found]] = Outcome.RECOVERED.value
        table.score[rows[found]], table.output[rows[found]] = recovery.scores[own[found]], output[own[found]]


def _camera_rows(branches: Branches, camera: IntArray, detection: IntArray) -> IntArray:
    """Rows of the camera table of some detections that take part, given by camera and index in it."""
    rows = [branches.camera_start[c] + branches.camera_index[c][d] for c, d in zip(camera, detection, strict=True)]
    return np.array(rows, dtype=np.int64)

"""Detection recovery: camera detections without a LiDAR match become 3D boxes (paper section 4.1.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DetectorError
from lcf3d.fusion.frustum import FrustumProposals, MaskMode, extract_frustums
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import bev_iou, image_iou
from lcf3d.localizers.base import Localizer
from lcf3d.provenance import Reason
from lcf3d.structures import Camera, Detections2D, FloatArray, IntArray


class Recovery(NamedTuple):
    """One row a candidate, recovered or not.

    Attributes:
        camera: (K,) its camera.
        detection: (K,) its index among that camera's detections.
        reason: (K,) `Reason` codes; ``LOCALIZED`` for those recovered.
        boxes: (K, 7) localized boxes in the LiDAR frame, NaN where there is none.
        iou: (K,) image IoU of the projected box and the 2D box, NaN where there is no box.
        scores: (K,) ``s2d * IoU``, NaN where there is no box.
        labels: (K,) labels of the 2D detections.
    """

    camera: IntArray
    detection: IntArray
    reason: IntArray
    boxes: FloatArray
    iou: FloatArray
    scores: FloatArray
    labels: IntArray

    @property
    def found(self) -> IntArray:
        """Rows of the candidates that were recovered."""
        return np.flatnonzero(self.reason == Reason.LOCALIZED)


def recover(
    points: NDArray[np.float32],
    cameras: Sequence[Camera],
    detections: Sequence[Detections2D],
    candidates: Sequence[IntArray],
    confirmed: FloatArray,
    localizer: Localizer,
    *,
    enlargement: float,
    min_points: int,
    mask_mode: MaskMode,
    confirm_iou: float,
    duplicate_iou: float,
) -> Recovery:
    """Lift 2D detections into frustums, localize, confirm, remove duplicates.

    Args:
        points: (N, 4 or more) float32 scan in the LiDAR frame.
        cameras: the cameras.
        detections: for each camera its 2D detections.
        candidates: for each camera the indices of the detections to recover.
        confirmed: (M, 7) boxes that are confirmed already; a recovered box that overlaps one is a duplicate.
        localizer: puts boxes into frustums.
        enlargement: see `extract_frustums`.
        min_points: see `extract_frustums`.
        mask_mode: see `extract_frustums`.
        confirm_iou: ``tau_d``; a box is confirmed when the IoU of its projection and the 2D box is higher.
        duplicate_iou: BEV IoU above which two boxes are one object; of two recovered boxes the higher score stays.

    Raises:
        DetectorError: the localizer's answer does not have one box a proposal.
    """
    table = _candidate_table(detections, candidates)
    proposals = extract_frustums(
        points,
        cameras,
        detections,
        candidates,
        enlargement=enlargement,
        min_points=min_points,
        mask_mode=mask_mode,
    )
    if not len(proposals):
        return table
    boxes = _localize(localizer, proposals)
    # proposals keep the order of the candidates: camera after camera, then detection
    key = table.camera * (1 << 32) + table.detection
    rows = np.searchsorted(key, proposals.camera_index * (1 << 32) + proposals.detection_index)
    overlap = confirmation_iou(proposals, boxes)
    table.boxes[rows], table.iou[rows] = boxes, overlap
    table.scores[rows] = proposals.scores * overlap
    table.reason[rows] = np.where(
        np.isnan(overlap),
        Reason.NOT_LOCALIZED,
        np.where(overlap > confirm_iou, Reason.LOCALIZED, Reason.DISAGREES),
    )
    _mark_duplicates(table, confirmed, duplicate_iou)
    return table


def _candidate_table(detections: Sequence[Detections2D], candidates: Sequence[IntArray]) -> Recovery:
    """All candidates, sorted by camera and detection, as if none had enough points."""
    chosen = [np.sort(c) for c in candidates]
    count = sum(len(c) for c in chosen)
    return Recovery(
        camera=np.repeat(np.arange(len(chosen)), [len(c) for c in chosen]).astype(np.int64),
        detection=np.concatenate([np.zeros(0, np.int64), *chosen]).astype(np.int64),
        reason=np.full(count, Reason.FEW_POINTS, dtype=np.int64),
        boxes=np.full((count, 7), np.nan),
        iou=np.full(count, np.nan),
        scores=np.full(count, np.nan),
        labels=np.concatenate([np.zeros(0, np.int64), *(d.labels[c] for d, c in zip(detections, chosen, strict=True))]),
    )


def _localize(localizer: Localizer, proposals: FrustumProposals) -> FloatArray:
    """(K, 7) boxes in the LiDAR frame, NaN where there is none."""
    boxes, _ = localizer(proposals)
    if boxes.shape != (len(proposals), 7):
        raise DetectorError(
            f"localizer {type(localizer).__name__} must return boxes of shape ({len(proposals)}, 7), got {boxes.shape}"
        )
    placed = proposals.lidar_from_frustum(boxes)
    placed[~(np.isfinite(placed).all(axis=1) & (placed[:, 3:6] > 0).all(axis=1))] = np.nan
    return placed


def confirmation_iou(proposals: FrustumProposals, boxes: FloatArray) -> FloatArray:
    """(K,) image IoU of each (K, 7) LiDAR-frame box with the 2D box it came from, NaN for boxes of NaN."""
    overlap = np.full(len(boxes), np.nan)
    there = ~np.isnan(boxes[:, 0])
    for c, camera in enumerate(proposals.cameras):
        rows = np.flatnonzero(there & (proposals.camera_index == c))
        projected, _ = project_boxes(boxes[rows], camera)
        # paired, not crossed: few enough that the diagonal of the matrix is the simplest
        overlap[rows] = np.diag(image_iou(projected, proposals.boxes2d[rows]))
    return overlap


def _mark_duplicates(table: Recovery, confirmed: FloatArray, duplicate_iou: float) -> None:
    """Turn ``LOCALIZED`` into ``DUPLICATE`` where a box overlaps a confirmed or a better recovered one."""
    rows = table.found[np.argsort(-table.scores[table.found], kind="stable")]
    with_confirmed = np.asarray((bev_iou(table.boxes[rows], confirmed) > duplicate_iou).any(axis=1))
    among = bev_iou(table.boxes[rows], table.boxes[rows]) > duplicate_iou
    kept: list[int] = []
    for i in range(len(rows)):
        if with_confirmed[i] or among[i, kept].any():
            table.reason[rows[i]] = Reason.DUPLICATE
        else:
            kept.append(i)

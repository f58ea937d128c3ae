"""Detection recovery: camera detections without a LiDAR match become 3D boxes (paper sections 4.1.4 and 4.2.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DetectorError
from lcf3d.fusion.frustum import FrustumProposals, MaskMode, extract_frustums
from lcf3d.fusion.localizer import Localizer
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import bev_iou, image_iou
from lcf3d.reasons import Reason
from lcf3d.structures import Camera, Detections2D, FloatArray, IntArray


class Recovery(NamedTuple):
    """One row a candidate, recovered or not; a stereo pair is one candidate.

    Attributes:
        camera: (K,) its camera.
        detection: (K,) its index among that camera's detections.
        reason: (K,) `Reason` codes; ``LOCALIZED`` for those recovered.
        boxes: (K, 7) localized boxes in the LiDAR frame, NaN where there is none.
        iou: (K,) image IoU of the projected box and the 2D box, NaN where there is no box.
        scores: (K,) ``s2d * IoU``, of a pair ``s2d * IoU * second_iou``; NaN where there is no box.
        labels: (K,) labels of the 2D detections.
        second_camera: (K,) camera of a pair's second detection, -1 for a single view.
        second_detection: (K,) its index among that camera's detections, or -1.
        second_iou: (K,) image IoU with the second detection, NaN where there is none.
        quality: (K,) how good the localizer believes its fit to be, NaN where there was no frustum.
    """

    camera: IntArray
    detection: IntArray
    reason: IntArray
    boxes: FloatArray
    iou: FloatArray
    scores: FloatArray
    labels: IntArray
    second_camera: IntArray
    second_detection: IntArray
    second_iou: FloatArray
    quality: FloatArray

    @property
    def found(self) -> IntArray:
        """Rows of the candidates that were recovered."""
        if not len(self.reason):
            return self.detection
        return np.flatnonzero(self.reason == Reason.LOCALIZED.value)


NOTHING = Recovery(
    *(np.zeros(0, np.int64),) * 3,
    np.zeros((0, 7)),
    *(np.zeros(0),) * 2,
    *(np.zeros(0, np.int64),) * 3,
    *(np.zeros(0),) * 2,
)
"""Where there is no candidate."""


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
    min_quality: float = 0.0,
    pairs: IntArray | None = None,
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
        confirm_iou: ``tau_d``; a box is confirmed when the IoU of its projection and the 2D box is higher, that of a
            pair when both IoUs are at least as high (the two sections of the paper differ in that).
        duplicate_iou: BEV IoU above which two boxes are one object; of two recovered boxes the higher score stays.
        min_quality: least quality that the localizer gives a box that is confirmed.
        pairs: see `extract_frustums`; the first detection of a pair, the more confident one, is a candidate, the
            second is not.

    Raises:
        DetectorError: the localizer's answer does not have one box a proposal.
    """
    if not any(len(chosen) for chosen in candidates):
        return NOTHING
    table = _candidate_table(detections, candidates, pairs)
    proposals = extract_frustums(
        points,
        cameras,
        detections,
        candidates,
        enlargement=enlargement,
        min_points=min_points,
        mask_mode=mask_mode,
        pairs=pairs,
    )
    if not len(proposals):
        return table
    boxes, quality = _localize(localizer, proposals)
    # proposals keep the order of the candidates: camera after camera, then detection
    rows = np.searchsorted(_key(table.camera, table.detection), _key(proposals.camera_index, proposals.detection_index))
    table.quality[rows] = quality
    _confirm(table, rows, proposals, boxes, confirm_iou)
    table.reason[rows[(table.reason[rows] == Reason.LOCALIZED.value) & (quality < min_quality)]] = Reason.POOR_FIT.value
    _mark_duplicates(table, confirmed, duplicate_iou)
    return table


def _confirm(
    table: Recovery, rows: IntArray, proposals: FrustumProposals, boxes: FloatArray, confirm_iou: float
) -> None:
    """Fill the rows of the proposals: boxes, overlaps with the 2D boxes, scores, and whether they are confirmed."""
    overlap = confirmation_iou(boxes, proposals.cameras, proposals.camera_index, proposals.boxes2d)
    table.boxes[rows], table.iou[rows] = boxes, overlap
    table.scores[rows], confirmed = proposals.scores * overlap, overlap > confirm_iou
    if proposals.second is not None:
        second = proposals.second
        paired = second.camera >= 0
        table.second_iou[rows] = confirmation_iou(boxes, proposals.cameras, second.camera, second.boxes2d)
        table.scores[rows[paired]] *= table.second_iou[rows[paired]]
        both = np.minimum(overlap, table.second_iou[rows]) >= confirm_iou
        confirmed = np.where(paired, both, confirmed)
    table.reason[rows] = np.where(
        np.isnan(overlap),
        Reason.NOT_LOCALIZED.value,
        np.where(confirmed, Reason.LOCALIZED.value, Reason.DISAGREES.value),
    )


def _key(camera: IntArray, detection: IntArray) -> IntArray:
    """One number for a camera and its detection, ascending in both."""
    return camera * (1 << 32) + detection


def _candidate_table(
    detections: Sequence[Detections2D], candidates: Sequence[IntArray], pairs: IntArray | None
) -> Recovery:
    """All candidates, sorted by camera and detection, as if none had enough points."""
    chosen = [np.sort(c) for c in candidates]
    count = sum(len(c) for c in chosen)
    table = Recovery(
        camera=np.repeat(np.arange(len(chosen)), [len(c) for c in chosen]).astype(np.int64),
        detection=np.concatenate([np.zeros(0, np.int64), *chosen]).astype(np.int64),
        reason=np.full(count, Reason.FEW_POINTS.value, dtype=np.int64),
        boxes=np.full((count, 7), np.nan),
        iou=np.full(count, np.nan),
        scores=np.full(count, np.nan),
        quality=np.full(count, np.nan),
        labels=np.concatenate([np.zeros(0, np.int64), *(d.labels[c] for d, c in zip(detections, chosen, strict=True))]),
        second_camera=np.full(count, -1, dtype=np.int64),
        second_detection=np.full(count, -1, dtype=np.int64),
        second_iou=np.full(count, np.nan),
    )
    if pairs is not None and len(pairs):
        rows = np.searchsorted(_key(table.camera, table.detection), _key(pairs[:, 0], pairs[:, 1]))
        table.second_camera[rows], table.second_detection[rows] = pairs[:, 2], pairs[:, 3]
    return table


def _localize(localizer: Localizer, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
    """(K, 7) boxes in the LiDAR frame, NaN where there is none, and (K,) their qualities."""
    boxes, quality = localizer(proposals)
    expected = (len(proposals), 7)
    if boxes.shape != expected or quality.shape != expected[:1]:
        raise DetectorError(
            f"localizer {type(localizer).__name__} must return boxes of shape {expected} and as many qualities, "
            f"got {boxes.shape} and {quality.shape}"
        )
    placed = proposals.lidar_from_frustum(boxes)
    placed[~(np.isfinite(placed).all(axis=1) & (placed[:, 3:6] > 0).all(axis=1))] = np.nan
    return placed, quality


def confirmation_iou(
    boxes: FloatArray, cameras: Sequence[Camera], camera_index: IntArray, boxes2d: FloatArray
) -> FloatArray:
    """(K,) image IoU of each (K, 7) LiDAR-frame box with the 2D box it came from.

    Args:
        boxes: (K, 7), NaN where there is none.
        cameras: the cameras.
        camera_index: (K,) camera of each 2D box, -1 where there is none.
        boxes2d: (K, 4) pixels.

    Returns:
        NaN where the 3D or the 2D box is missing.
    """
    overlap = np.full(len(boxes), np.nan)
    there = ~np.isnan(boxes[:, 0])
    for c, camera in enumerate(cameras):
        rows = np.flatnonzero(there & (camera_index == c))
        projected, _ = project_boxes(boxes[rows], camera)
        # paired, not crossed: few enough that the diagonal of the matrix is the simplest
        overlap[rows] = np.diag(image_iou(projected, boxes2d[rows]))
    return overlap


def _mark_duplicates(table: Recovery, confirmed: FloatArray, duplicate_iou: float) -> None:
    """Turn ``LOCALIZED`` into ``DUPLICATE`` where a box overlaps a confirmed or a better recovered one."""
    rows = table.found[np.argsort(-table.scores[table.found], kind="stable")]
    with_confirmed = np.asarray((bev_iou(table.boxes[rows], confirmed) > duplicate_iou).any(axis=1))
    among = bev_iou(table.boxes[rows], table.boxes[rows]) > duplicate_iou
    kept: list[int] = []
    for i in range(len(rows)):
        if with_confirmed[i] or among[i, kept].any():
            table.reason[rows[i]] = Reason.DUPLICATE.value
        else:
            kept.append(i)

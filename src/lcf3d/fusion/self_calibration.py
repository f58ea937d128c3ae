"""Calibration without labels: the camera branch teaches what the scores of the LiDAR branch mean.

``lcf3d run --calibration auto`` uses it. It puts scores of any scale into (0, 1) and finds out which classes the camera
branch detects and where the ground is; the evidence weights stay those of the settings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from lcf3d.frame import Frame
from lcf3d.fusion.branches import by_camera_name
from lcf3d.fusion.calibration import (
    Calibration,
    ScoreMap,
    Transform,
    ground_height,
    natural_transform,
    transform_scores,
)
from lcf3d.fusion.calibration_fit import fit_platt
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.evidence import Evidence
from lcf3d.fusion.matching import assign
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray, IntArray

# 2D detections above this score teach
TEACHER_SCORE = 0.5
# weight of the prior line, in detections
PRIOR_STRENGTH = 20.0
# a camera that confirms this share of the best LiDAR boxes is believed as the settings say, a worse one less
FULL_RECALL = 0.9
# share of the boxes of a class that count as the best; even where the LiDAR detector is poor most of them are right
BEST_SHARE = 0.02
# before any box is seen the camera is taken to confirm 0.95 of this many
RECALL_PRIOR = 20.0
# the ground is flat where half of the trusted boxes lie within this slope of one height
FLAT_SLOPE = 0.012

FrameDetections = tuple[Frame, Detections3D, Mapping[str, Detections2D] | Detections2D]


class _Observed(NamedTuple):
    """LiDAR boxes of many frames.

    Label, score, underside, distance, seen by a camera, confirmed by a 2D detection of the class, and of any class.
    """

    labels: IntArray
    scores: FloatArray
    bottoms: FloatArray
    distances: FloatArray
    visible: BoolArray
    confirmed: BoolArray
    found: BoolArray


def self_calibrate(frames: Iterable[FrameDetections], config: FusionConfig) -> Calibration:
    """A calibration fitted without labels on the frames of a run.

    A box's probability of being right is taken to be its probability of being confirmed: of having a 2D detection of
    its class with a score above ``TEACHER_SCORE`` and an image IoU above ``match_iou``, one to one. That is a Platt
    line by class, pulled towards a logistic of robustly standardised scores, which is what remains when there are few
    boxes or when the camera does not detect the class. Scores of a class that lie in [0, 1] are left as they are.

    A camera that leaves many of the best LiDAR boxes unconfirmed misses much: its weight is then lowered by the ratio
    of the log-odds that a miss is worth, ``log(1 - recall)``, to the same at ``FULL_RECALL``.

    Args:
        frames: each frame with its LiDAR detections and the 2D detections of the cameras that were looked through.
        config: settings.

    Returns:
        A `Calibration`, with evidence weights only where the camera is believed less than the settings say; the same
        for the same frames, whatever their order.
    """
    parts, camera_labels = [], np.zeros(len(config.class_names), dtype=bool)
    for frame, lidar, camera in frames:
        found = {name: d.with_classes(config.class_names) for name, d in by_camera_name(frame, camera).items()}
        for detections in found.values():
            camera_labels[detections.labels] = True
        parts.append(_observe(frame, lidar.with_classes(config.class_names), found, config))
    if not parts:
        return Calibration(source=_SOURCE)
    seen = _Observed(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    maps: dict[str, ScoreMap] = {}
    evidence: dict[str, Evidence] = {}
    probability = seen.scores.copy()
    for label, name in enumerate(config.class_names):
        own = seen.labels == label
        taught = seen.visible[own] & camera_labels[label]
        # a box of another class found there is the LiDAR branch's mistake, not a miss of the camera
        share = camera_share(seen.scores[own][taught], seen.found[own][taught])
        if share < 1:
            evidence[name] = config.evidence_of(name).with_camera_share(share)
        if not own.any() or natural_transform(seen.scores[own]) == "logit":
            continue
        maps[name] = _taught_map(seen.scores[own], seen.confirmed[own], taught)
        probability[own] = maps[name](seen.scores[own])
    trusted = probability > TEACHER_SCORE
    return Calibration(
        source=_SOURCE,
        lidar=maps,
        evidence=evidence,
        camera_classes=tuple(name for name, there in zip(config.class_names, camera_labels, strict=True) if there),
        ground_z=flat_ground(seen.bottoms[trusted], seen.distances[trusted]),
    )


_SOURCE = "the frames of a run, without labels, with the camera as teacher"


def _observe(frame: Frame, lidar: Detections3D, found: Mapping[str, Detections2D], config: FusionConfig) -> _Observed:
    """The boxes of one frame."""
    confirmed, visible, any_class = (np.zeros(len(lidar), dtype=bool) for _ in range(3))
    for camera in frame.cameras if len(lidar) else ():
        if camera.name not in found:
            continue
        projected, seen = project_boxes(lidar.boxes, camera)
        teachers = found[camera.name][found[camera.name].scores > TEACHER_SCORE]
        overlap = image_iou(projected, teachers.boxes)
        any_class |= assign(overlap, config.match_iou) >= 0
        overlap[lidar.labels[:, None] != teachers.labels[None]] = 0
        confirmed |= assign(overlap, config.match_iou) >= 0
        visible |= seen
    bottoms = lidar.boxes[:, 2] - lidar.boxes[:, 5] / 2
    distances = np.hypot(lidar.boxes[:, 0], lidar.boxes[:, 1])
    return _Observed(lidar.labels, lidar.scores, bottoms, distances, visible, confirmed, any_class | confirmed)


def flat_ground(bottoms: FloatArray, distances: FloatArray) -> float | None:
    """Height of the ground under the sensor, where trusted boxes show that it is flat; None where they do not.

    A tilted sensor or a hilly road puts right boxes off any one height: their height then says nothing against them.

    Args:
        bottoms: (N,) undersides of boxes that are believed, metres.
        distances: (N,) their horizontal distances, metres.
    """
    height = ground_height(bottoms)
    if height is None:
        return None
    slope = np.abs(bottoms - height) / np.maximum(distances, 1.0)
    return height if np.median(slope) < FLAT_SLOPE else None


def camera_share(scores: FloatArray, confirmed: BoolArray) -> float:
    """How much of its weight the camera deserves, 0 to 1, judged by the LiDAR boxes of highest score.

    Args:
        scores: (N,) of LiDAR boxes of one class that the camera looks at.
        confirmed: (N,) which of them it confirms.
    """
    best = np.lexsort((confirmed, -scores))[: int(np.ceil(BEST_SHARE * len(scores)))]
    recall = (confirmed[best].sum() + 0.95 * RECALL_PRIOR) / (len(best) + RECALL_PRIOR)
    return float(np.round(min(np.log1p(-recall) / np.log1p(-FULL_RECALL), 1.0), 4))


def _taught_map(scores: FloatArray, confirmed: BoolArray, taught: BoolArray) -> ScoreMap:
    """The Platt line of confirmation on score; scores in any order give the same."""
    order = np.lexsort((confirmed, taught, scores))
    scores, confirmed, taught = scores[order], confirmed[order], taught[order]
    transform: Transform = natural_transform(scores)
    x = transform_scores(scores, transform)
    low, middle, high = np.quantile(x, (0.25, 0.5, 0.75))
    # the median at even odds, the quartiles one unit of log-odds away; never steeper than a logit, for lone boxes
    prior = 1 / max(float(high - low) / 2, 1.0)
    slope, intercept = fit_platt(
        x[taught], confirmed[taught].astype(np.float64), prior=(prior, -prior * float(middle)), strength=PRIOR_STRENGTH
    )
    return ScoreMap(transform=transform, slope=slope, intercept=intercept)

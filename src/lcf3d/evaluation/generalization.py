"""NDS^: the nuScenes detection score without velocity and attributes, for data of any origin (paper section 5.8).

``NDS^ = (3 mAP + sum over mATE, mASE, mAOE of (1 - min(1, error))) / 6`` (paper, equation nds_hat). Matching, AP and
errors are those of nuScenes; boxes are compared in each frame's LiDAR frame, so that KITTI and nuScenes can be set side
by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.evaluation.center_distance import Curve, EvaluationBoxes, class_curves
from lcf3d.evaluation.nuscenes import OFFICIAL
from lcf3d.geometry.camera import project_points
from lcf3d.structures import Camera, Detections3D, FloatArray

ERRORS = ("trans_err", "scale_err", "orient_err")
"""The errors of NDS^: metres, 1 - aligned IoU, radians."""

CLASS_RANGES = {**OFFICIAL.class_range, "Car": 50, "Pedestrian": 40, "Cyclist": 40}
"""Largest horizontal distance in metres at which a class is evaluated; `DEFAULT_RANGE` for other classes."""

DEFAULT_RANGE = 50.0


@dataclass(frozen=True, eq=False)
class GeneralizationMetrics:
    """Results that NDS^ is made of.

    Attributes:
        class_names: evaluated classes.
        distances: matching distances in metres.
        aps: (C, T) average precision by class and matching distance.
        class_errors: (C, 3) errors (`ERRORS`) by class at 2 m, NaN where a class has none.
        ground_truth_counts: (C,) annotated boxes evaluated.
        curves: curves by class and matching distance.
    """

    class_names: tuple[str, ...]
    distances: tuple[float, ...]
    aps: FloatArray
    class_errors: FloatArray
    ground_truth_counts: tuple[int, ...]
    curves: list[list[Curve]] = field(repr=False)

    @property
    def mean_ap(self) -> float:
        """mAP over classes and matching distances."""
        return float(self.aps.mean())

    @property
    def errors(self) -> dict[str, float]:
        """mATE, mASE and mAOE by their names in `ERRORS`: means over the classes that have them."""
        return {name: float(np.nanmean(self.class_errors[:, i])) for i, name in enumerate(ERRORS)}

    @property
    def nds_hat(self) -> float:
        """NDS^."""
        return nds_hat(self.mean_ap, tuple(self.errors.values()))

    def to_json(self) -> dict[str, Any]:
        """The numbers by name, with the keys of the nuScenes summary."""
        return {
            "nds_hat": self.nds_hat,
            "mean_ap": self.mean_ap,
            "tp_errors": self.errors,
            "label_aps": {
                name: {str(th): float(ap) for th, ap in zip(self.distances, row, strict=True)}
                for name, row in zip(self.class_names, self.aps, strict=True)
            },
            "mean_dist_aps": {name: float(row.mean()) for name, row in zip(self.class_names, self.aps, strict=True)},
            "label_tp_errors": {
                name: dict(zip(ERRORS, row.tolist(), strict=True))
                for name, row in zip(self.class_names, self.class_errors, strict=True)
            },
            "ground_truth_counts": dict(zip(self.class_names, self.ground_truth_counts, strict=True)),
        }


def nds_hat(mean_ap: float, mean_errors: Sequence[float]) -> float:
    """NDS^ of mAP and the means (mATE, mASE, mAOE) (paper, equation nds_hat)."""
    return (3 * mean_ap + sum(1 - min(1.0, error) for error in mean_errors)) / 6


def evaluate_generalization(
    ground_truth: Sequence[Detections3D],
    predictions: Sequence[Detections3D],
    *,
    class_names: Sequence[str] | None = None,
    cameras: Sequence[Camera] | None = None,
    class_range: Mapping[str, float] = CLASS_RANGES,
) -> GeneralizationMetrics:
    """NDS^ and its parts over frames of any dataset.

    A class without ground truth counts with AP 0 and errors 1, as in nuScenes: give ``class_names`` to leave it out.

    Args:
        ground_truth: annotated boxes of each frame, canonical LiDAR frame.
        predictions: detected boxes of the same frames in the same order; classes are matched by name.
        class_names: classes to evaluate; None for those of the ground truth.
        cameras: front camera of each frame: boxes whose centre it does not see are left out, annotated and detected
            alike (paper section 5.8); None for all around.
        class_range: largest horizontal distance from the LiDAR in metres by class.

    Raises:
        ConfigError: the lists differ in length or are empty, or a score is NaN.
    """
    lengths = {len(ground_truth), len(predictions), len(ground_truth if cameras is None else cameras)}
    if len(lengths) != 1 or not ground_truth:
        raise ConfigError(
            "evaluation needs ground truth, predictions and (if given) a camera for the same frames, at least one; got "
            f"{len(ground_truth)}, {len(predictions)} and {'no' if cameras is None else len(cameras)}"
        )
    names = tuple(ground_truth[0].class_names if class_names is None else class_names)
    limits = np.array([class_range.get(name, DEFAULT_RANGE) for name in names], dtype=np.float64)
    truth = join_frames(ground_truth, names, limits, cameras)
    found = join_frames(predictions, names, limits, cameras)
    if np.isnan(found.scores).any():
        raise ConfigError(f"{int(np.isnan(found.scores).sum())} predictions have the score NaN; expected numbers")
    half_turn = frozenset(names.index(name) for name in OFFICIAL.half_turn if name in names)
    curves = class_curves(truth, found, len(names), OFFICIAL.dist_ths, half_turn)
    aps = np.array([[c.average_precision(OFFICIAL.min_recall, OFFICIAL.min_precision) for c in row] for row in curves])
    tp = OFFICIAL.dist_ths.index(OFFICIAL.dist_th_tp)
    errors = np.stack([row[tp].mean_errors(OFFICIAL.min_recall)[: len(ERRORS)] for row in curves])
    for name, undefined in OFFICIAL.undefined.items():
        if name in names:
            errors[names.index(name), [ERRORS.index(error) for error in undefined if error in ERRORS]] = np.nan
    counts = tuple(np.bincount(truth.labels, minlength=len(names)).tolist())
    return GeneralizationMetrics(names, OFFICIAL.dist_ths, aps, errors, counts, curves)


def in_camera_view(detections: Detections3D, camera: Camera) -> Detections3D:
    """Those detections whose centre projects into the camera's image."""
    pixels, _ = project_points(detections.boxes[:, :3], camera)
    # behind the camera, pixels are NaN and every comparison is false
    return detections[((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)]


def join_frames(
    frames: Sequence[Detections3D], names: tuple[str, ...], limits: FloatArray, cameras: Sequence[Camera] | None
) -> EvaluationBoxes:
    """All frames' detections of the given classes, within range and view."""
    kept = []
    for i, frame in enumerate(frames):
        detections = frame.with_classes(names)
        detections = detections[np.hypot(detections.boxes[:, 0], detections.boxes[:, 1]) < limits[detections.labels]]
        kept.append(detections if cameras is None else in_camera_view(detections, cameras[i]))
    numbers = np.repeat(np.arange(len(kept)), [len(detections) for detections in kept])
    boxes = np.concatenate([detections.boxes for detections in kept])
    return EvaluationBoxes(
        numbers,
        np.concatenate([detections.labels for detections in kept]),
        boxes[:, :2],
        boxes[:, 3:6],
        boxes[:, 6],
        np.concatenate([detections.scores for detections in kept]),
        np.full((len(boxes), 2), np.nan),
        np.full(len(boxes), -1, dtype=np.int64),
    )

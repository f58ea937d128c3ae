"""The detection metrics of Argoverse 2: AP by centre distance, ATE, ASE, AOE and the composite detection score CDS.

Wilson et al., "Argoverse 2: Next Generation Datasets for Self-Driving Perception and Forecasting" (2021), section on 3D
object detection. They differ from nuScenes' in how boxes are matched: each detection belongs to the annotation nearest
to it, whoever else is there, and of the detections of one annotation only that of the highest score can be right.
Without the official restriction to a region of interest, which needs the city's map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lcf3d.errors import DatasetError, FormatError
from lcf3d.evaluation.center_distance import RECALLS, heading_errors
from lcf3d.formats.argoverse import Cuboids
from lcf3d.structures import ARGOVERSE_CLASSES, BoolArray, FloatArray, IntArray

ERRORS = ("ATE", "ASE", "AOE")
"""True-positive errors: metres, 1 - IoU of the sides laid into one another, radians."""

_GROUP_DISTANCE_M = 1e5


@dataclass(frozen=True)
class ArgoverseMetricsConfig:
    """The official numbers.

    Attributes:
        thresholds_m: matching distances over which AP is averaged.
        tp_threshold_m: matching distance of the true-positive errors; one of ``thresholds_m``.
        max_range_m: boxes at this distance from the egovehicle's origin or farther are not evaluated.
        max_detections: so many detections of the highest score count, of a class in a sweep.
    """

    thresholds_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    tp_threshold_m: float = 2.0
    max_range_m: float = 150.0
    max_detections: int = 100

    @property
    def worst_errors(self) -> FloatArray:
        """(3,) what `ERRORS` count at most, and where there is no true positive."""
        return np.array([self.tp_threshold_m, 1.0, np.pi])


OFFICIAL = ArgoverseMetricsConfig()


@dataclass(frozen=True, eq=False)
class ArgoverseMetrics:
    """Results of the Argoverse 2 detection metrics.

    Attributes:
        class_names: evaluated classes.
        config: the numbers used.
        aps: (C, T) average precision by class and matching distance, 0 without ground truth.
        errors: (C, 3) `ERRORS` by class, the worst values without true positives.
        ground_truth_counts: (C,) annotations that count.
        detection_counts: (C,) detections that count.
        sweeps: how many annotated sweeps there are.
        other_sweeps: how many sweeps hold detections but no annotation; those detections are false positives.
    """

    class_names: tuple[str, ...]
    config: ArgoverseMetricsConfig
    aps: FloatArray
    errors: FloatArray
    ground_truth_counts: IntArray
    detection_counts: IntArray
    sweeps: int
    other_sweeps: int

    @property
    def ap(self) -> FloatArray:
        """(C,) AP, the mean over the matching distances."""
        means: FloatArray = self.aps.mean(axis=1)
        return means

    @property
    def cds(self) -> FloatArray:
        """(C,) composite detection score: AP times the mean of the errors turned into scores."""
        scores: FloatArray = self.ap * (1 - self.errors / self.config.worst_errors).mean(axis=1)
        return scores

    def table(self, classes: BoolArray | None = None) -> dict[str, float]:
        """Means of AP, ATE, ASE, AOE and CDS over all classes, or over those of a (C,) mask."""
        chosen = np.ones(len(self.class_names), dtype=bool) if classes is None else classes
        values = np.column_stack([self.ap, self.errors, self.cds])[chosen].mean(axis=0)
        return dict(zip(("AP", *ERRORS, "CDS"), values.tolist(), strict=True))

    def to_json(self) -> dict[str, Any]:
        """Metrics by class, in the names of the official table, with ``AVERAGE_METRICS`` over all 26 classes."""
        rows: dict[str, Any] = {}
        for c, name in enumerate(self.class_names):
            only = np.arange(len(self.class_names)) == c
            rows[name] = {
                **self.table(only),
                "AP_by_distance": {
                    f"{t:g}": float(v) for t, v in zip(self.config.thresholds_m, self.aps[c], strict=True)
                },
                "ground_truth": int(self.ground_truth_counts[c]),
                "detections": int(self.detection_counts[c]),
            }
        rows["AVERAGE_METRICS"] = self.table()
        annotated = self.ground_truth_counts > 0
        rows["AVERAGE_OF_ANNOTATED"] = self.table(annotated) if annotated.any() else self.table()
        return rows


def evaluate_argoverse(
    ground_truth: Cuboids, predictions: Cuboids, config: ArgoverseMetricsConfig = OFFICIAL
) -> ArgoverseMetrics:
    """Metrics of detections against annotations, both in the egovehicle frame of their sweep.

    Args:
        ground_truth: annotations; those without a point inside them are left out.
        predictions: detections of the same logs.
        config: the official numbers.

    Raises:
        DatasetError: there are no annotations.
        FormatError: detections of a log that is not annotated, or none in any annotated sweep.
    """
    if not len(ground_truth):
        raise DatasetError("there are no annotations, so that nothing can be evaluated")
    truth_groups, found_groups, sweeps, other_sweeps = _groups(ground_truth, predictions)
    keep = _in_range(ground_truth, config) & (ground_truth.point_counts != 0)
    truth, truth_groups = ground_truth[keep], truth_groups[keep]
    order = np.argsort(-predictions.scores, kind="stable")
    order = order[_in_range(predictions, config)[order]]
    order = order[_rank_in_group(found_groups[order]) < config.max_detections]
    found = predictions[order]
    nearest, distances = _nearest(truth.boxes[:, :3], truth_groups, found.boxes[:, :3], found_groups[order])
    # in falling order of score, the first detection that belongs to an annotation is the one that can be right
    first = np.zeros(len(found), dtype=bool)
    first[np.unique(nearest, return_index=True)[1]] = True
    first &= nearest >= 0
    errors = np.zeros((len(found), len(ERRORS)))
    errors[first] = _errors(found.boxes[first], truth.boxes[nearest[first]])
    classes = len(ARGOVERSE_CLASSES)
    annotated = np.bincount(truth.labels, minlength=classes)
    aps = np.zeros((classes, len(config.thresholds_m)))
    class_errors = np.tile(config.worst_errors, (classes, 1))
    for c in np.flatnonzero(annotated):
        rows = found.labels == c
        for t, threshold in enumerate(config.thresholds_m):
            aps[c, t] = _average_precision(first[rows] & (distances[rows] < threshold), int(annotated[c]))
        hits = rows & first & (distances < config.tp_threshold_m)
        if hits.any():
            class_errors[c] = errors[hits].mean(axis=0)
    counted = np.bincount(found.labels, minlength=classes)
    return ArgoverseMetrics(ARGOVERSE_CLASSES, config, aps, class_errors, annotated, counted, sweeps, other_sweeps)


def _groups(ground_truth: Cuboids, predictions: Cuboids) -> tuple[IntArray, IntArray, int, int]:
    """(M,) and (N,) number of each box's sweep and class, and how many sweeps are annotated and not annotated."""
    position = {log: i for i, log in enumerate(ground_truth.log_ids)}
    used = [predictions.log_ids[i] for i in np.unique(predictions.logs)]
    unknown = [log for log in used if log not in position]
    if unknown:
        raise FormatError(
            f"the results hold {len(unknown)} logs that are not annotated here, the first is {unknown[0]}; "
            f"the annotated ones are {', '.join(ground_truth.log_ids[:3])}{' ...' if len(position) > 3 else ''}"
        )
    logs = np.array([position.get(log, -1) for log in predictions.log_ids] or [0], dtype=np.int64)[predictions.logs]
    times, moments = np.unique(
        np.concatenate([ground_truth.timestamps_ns, predictions.timestamps_ns]), return_inverse=True
    )
    keys = np.concatenate([ground_truth.logs, logs]) * len(times) + moments.reshape(-1)
    sweeps, numbers = np.unique(keys, return_inverse=True)
    numbers = numbers.reshape(-1)
    m = len(ground_truth)
    annotated = np.unique(numbers[:m])
    if len(predictions) and not np.isin(numbers[m:], annotated).any():
        raise FormatError(
            f"none of the {len(predictions)} detections is of an annotated sweep; the first annotated one is "
            f"{ground_truth.timestamps_ns.min()} ns, the first detected one {predictions.timestamps_ns.min()} ns"
        )
    classes = len(ARGOVERSE_CLASSES)
    return (
        numbers[:m] * classes + ground_truth.labels,
        numbers[m:] * classes + predictions.labels,
        len(annotated),
        len(sweeps) - len(annotated),
    )


def _in_range(cuboids: Cuboids, config: ArgoverseMetricsConfig) -> BoolArray:
    inside: BoolArray = np.linalg.norm(cuboids.boxes[:, :3], axis=1) < config.max_range_m
    return inside


def _rank_in_group(groups: IntArray) -> IntArray:
    """(N,) how many earlier entries have the same value."""
    order = np.argsort(groups, kind="stable")
    starts = np.searchsorted(groups[order], groups[order], side="left")
    ranks = np.empty(len(groups), dtype=np.int64)
    ranks[order] = np.arange(len(groups)) - starts
    return ranks


def _nearest(
    annotated: FloatArray, annotated_groups: IntArray, detected: FloatArray, detected_groups: IntArray
) -> tuple[IntArray, FloatArray]:
    """(N,) row of the nearest annotation (M, 3) in the same group, -1 without one, and (N,) its distance in metres."""
    from scipy.spatial import cKDTree

    if not len(annotated) or not len(detected):
        return np.full(len(detected), -1), np.full(len(detected), np.inf)
    # one tree for all groups: a fourth coordinate keeps them farther apart than any range
    tree = cKDTree(np.column_stack([annotated, annotated_groups * _GROUP_DISTANCE_M]))
    distances, rows = tree.query(np.column_stack([detected, detected_groups * _GROUP_DISTANCE_M]))
    same = annotated_groups[rows] == detected_groups
    return np.where(same, rows, -1), np.where(same, distances, np.inf)


def _errors(detected: FloatArray, annotated: FloatArray) -> FloatArray:
    """(K, 3) `ERRORS` of K pairs of (K, 7) boxes."""
    # the protocol's aligned IoU: the shared box over the box around both, which is more than their union
    sizes, other_sizes = detected[:, 3:6], annotated[:, 3:6]
    iou = np.minimum(sizes, other_sizes).prod(axis=1) / np.maximum(sizes, other_sizes).prod(axis=1)
    return np.column_stack(
        [
            np.linalg.norm(detected[:, :3] - annotated[:, :3], axis=1),
            1 - iou,
            heading_errors(detected[:, 6], annotated[:, 6]),
        ]
    )


def _average_precision(hits: BoolArray, annotated: int) -> float:
    """Mean over 101 recall values of the best precision at that recall or a higher one; hits in falling score."""
    if not hits.any():
        return 0.0
    found = np.cumsum(hits)
    precision = found / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.interp(RECALLS, found / annotated, best, right=0).mean())

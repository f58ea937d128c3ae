"""Matching by centre distance, precision-recall curves and true-positive errors: the core of the nuScenes metrics.

Pure functions on arrays, for any class list. Caesar et al., "nuScenes: A multimodal dataset for autonomous driving"
(2020), section "Detection metrics"; digits and tie order follow the official devkit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, FloatArray, IntArray

ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
"""True-positive errors: metres, 1 - aligned IoU, radians, m/s, 1 - accuracy."""

RECALLS = np.linspace(0, 1, 101)
"""Recall values at which curves are sampled."""


@dataclass(frozen=True, eq=False)
class EvaluationBoxes:
    """What the metrics read of boxes in many frames, as parallel arrays.

    Attributes:
        frames: (N,) frame numbers from 0.
        labels: (N,) class numbers from 0.
        centers: (N, 2) horizontal centres in metres.
        sizes: (N, 3) side lengths in metres, in one order for ground truth and predictions.
        yaws: (N,) radians about the vertical axis.
        scores: (N,) confidences; not read of ground truth.
        velocities: (N, 2) m/s, NaN where unknown.
        attributes: (N,) attribute numbers, -1 for none.
    """

    frames: IntArray
    labels: IntArray
    centers: FloatArray
    sizes: FloatArray
    yaws: FloatArray
    scores: FloatArray
    velocities: FloatArray
    attributes: IntArray

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(frozen=True, eq=False)
class Curve:
    """Precision, confidence and mean errors of one class at one matching distance, over `RECALLS`.

    Attributes:
        precision: (101,) precision, 0 beyond the highest recall reached.
        confidence: (101,) score threshold that gives the recall, 0 beyond the highest reached.
        errors: (5, 101) mean of each of `ERRORS` over the true positives of that score or higher.
    """

    precision: FloatArray
    confidence: FloatArray
    errors: FloatArray

    @classmethod
    def empty(cls) -> Curve:
        """The curve of a class without ground truth or true positives: no precision, errors of 1."""
        return cls(np.zeros(101), np.zeros(101), np.ones((len(ERRORS), 101)))

    def average_precision(self, min_recall: float, min_precision: float) -> float:
        """Area of the curve above ``min_precision`` and beyond ``min_recall``, normalised to [0, 1]."""
        beyond = self.precision[round(100 * min_recall) + 1 :] - min_precision
        return float(np.mean(np.maximum(beyond, 0))) / (1.0 - min_precision)

    def mean_errors(self, min_recall: float) -> FloatArray:
        """(5,) means of `ERRORS` from ``min_recall`` to the highest recall reached; ones when that is never reached."""
        first = round(100 * min_recall) + 1
        reached = np.flatnonzero(self.confidence)
        last = int(reached[-1]) if len(reached) else 0
        if last < first:
            return np.ones(len(ERRORS))
        means: FloatArray = self.errors[:, first : last + 1].mean(axis=1)
        return means


def class_curves(
    ground_truth: EvaluationBoxes,
    predictions: EvaluationBoxes,
    class_count: int,
    thresholds: tuple[float, ...],
    half_turn_classes: frozenset[int] = frozenset(),
) -> list[list[Curve]]:
    """Curves by class and matching distance.

    Each prediction, from the highest score down (of equal scores the later one first, as in the devkit), takes the
    nearest ground truth of its frame and class that is still free, when nearer than the threshold.

    Args:
        ground_truth: annotated boxes.
        predictions: detected boxes.
        class_count: number of classes that labels count.
        thresholds: matching distances in metres.
        half_turn_classes: classes whose front and rear look alike: their heading counts modulo half a turn.
    """
    order = np.lexsort((-np.arange(len(predictions)), -predictions.scores))
    matches = _match(ground_truth, predictions, order, class_count, thresholds)
    labels = predictions.labels[order]
    scores = predictions.scores[order]
    half_turn = np.zeros(class_count, dtype=bool)
    half_turn[list(half_turn_classes)] = True
    annotated = np.bincount(ground_truth.labels, minlength=class_count)
    by_class = [np.flatnonzero(labels == c) for c in range(class_count)]
    curves: list[list[Curve]] = [[] for _ in range(class_count)]
    for matched in matches:
        hits = matched >= 0
        errors = np.full((len(ERRORS), len(order)), np.nan)
        errors[:, hits] = _pair_errors(ground_truth, matched[hits], predictions, order[hits], half_turn)
        for c, rows in enumerate(by_class):
            curves[c].append(_curve(hits[rows], scores[rows], errors[:, rows], int(annotated[c])))
    return curves


def _match(
    ground_truth: EvaluationBoxes,
    predictions: EvaluationBoxes,
    order: IntArray,
    class_count: int,
    thresholds: tuple[float, ...],
) -> IntArray:
    """(T, N) ground truth that each prediction, in ``order``, takes at each threshold, or -1."""
    frames = int(max(ground_truth.frames.max(initial=-1), predictions.frames.max(initial=-1))) + 1
    groups = ground_truth.frames * class_count + ground_truth.labels
    members = np.argsort(groups, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(groups, minlength=frames * class_count))]).astype(np.int64)
    wanted = (predictions.frames * class_count + predictions.labels)[order]
    matches: IntArray = _greedy_matches(
        np.ascontiguousarray(ground_truth.centers[members], dtype=np.float64),
        starts,
        np.ascontiguousarray(predictions.centers[order], dtype=np.float64),
        wanted.astype(np.int64),
        np.array(thresholds, dtype=np.float64),
    )
    found = matches >= 0
    matches[found] = members[matches[found]]
    return matches


def matched_objects(
    ground_truth: EvaluationBoxes, predictions: EvaluationBoxes, class_count: int, threshold: float
) -> IntArray:
    """(N,) row of the ground truth that each prediction takes within ``threshold`` metres, -1 for none."""
    order = np.lexsort((-np.arange(len(predictions)), -predictions.scores))
    matches = np.full(len(predictions), -1, dtype=np.int64)
    matches[order] = _match(ground_truth, predictions, order, class_count, (threshold,))[0]
    return matches


def resampled_aps(
    ground_truth: EvaluationBoxes,
    predictions: EvaluationBoxes,
    class_count: int,
    thresholds: tuple[float, ...],
    weights: IntArray,
    min_recall: float,
    min_precision: float,
) -> FloatArray:
    """(B, C, T) average precision of B data sets in which frame ``f`` appears ``weights[b, f]`` times.

    A frame that is drawn twice counts twice: its objects and detections do not meet those of its copy.
    """
    order = np.lexsort((-np.arange(len(predictions)), -predictions.scores))
    matches = _match(ground_truth, predictions, order, class_count, thresholds)
    labels, frames = predictions.labels[order], predictions.frames[order]
    aps = np.zeros((len(weights), class_count, len(thresholds)))
    for c in range(class_count):
        own = np.flatnonzero(labels == c)
        objects = np.bincount(ground_truth.frames[ground_truth.labels == c], minlength=weights.shape[1])
        for t in range(len(thresholds)):
            hits = matches[t][own] >= 0
            drawn, first = weights[:, frames[own]], round(100 * min_recall) + 1
            aps[:, c, t] = _weighted_aps(hits, drawn, weights @ objects, first, min_precision)
    return aps


def _weighted_aps(hits: BoolArray, drawn: IntArray, objects: IntArray, first: int, min_precision: float) -> FloatArray:
    """(B,) average precision of detections in descending score, each counted (B, N) ``drawn`` times.

    NaN where no object was drawn.
    """
    aps = np.where(objects > 0, 0.0, np.nan)
    if not len(hits):
        return aps
    true = np.cumsum(drawn * hits, axis=1)
    reported = np.cumsum(drawn, axis=1)
    for b in np.flatnonzero((objects > 0) & (true[:, -1] > 0)):
        there = drawn[b] > 0
        recall = true[b, there] / objects[b]
        precision = np.interp(RECALLS, recall, true[b, there] / reported[b, there], right=0)
        aps[b] = np.maximum(precision[first:] - min_precision, 0).mean() / (1 - min_precision)
    return aps


@kernel
def _greedy_matches(annotated, starts, predicted, groups, thresholds):  # type: ignore[no-untyped-def]
    """(T, N) row of ``annotated`` that each of ``predicted`` takes in turn; group g has rows starts[g]:starts[g+1]."""
    matches = np.full((len(thresholds), len(predicted)), -1, dtype=np.int64)
    for t in range(len(thresholds)):
        free = np.ones(len(annotated), dtype=np.bool_)
        for n in range(len(predicted)):
            nearest, best = np.inf, -1
            for row in range(starts[groups[n]], starts[groups[n] + 1]):
                if free[row]:
                    dx = predicted[n, 0] - annotated[row, 0]
                    dy = predicted[n, 1] - annotated[row, 1]
                    distance = np.sqrt(dx * dx + dy * dy)
                    if distance < nearest:
                        nearest, best = distance, row
            if nearest < thresholds[t]:
                free[best] = False
                matches[t, n] = best
    return matches


def heading_errors(yaws: FloatArray, other_yaws: FloatArray, period: FloatArray | float = 2 * np.pi) -> FloatArray:
    """(K,) angles in radians between (K,) headings that look alike after a turn by ``period``."""
    errors: FloatArray = np.abs((yaws - other_yaws + period / 2) % period - period / 2)
    return errors


def _pair_errors(
    ground_truth: EvaluationBoxes, g: IntArray, predictions: EvaluationBoxes, p: IntArray, half_turn: FloatArray
) -> FloatArray:
    """(5, K) errors of the K pairs of ground truth rows ``g`` and prediction rows ``p``; NaN where undefined."""
    offset = predictions.centers[p] - ground_truth.centers[g]
    sizes, truth_sizes = predictions.sizes[p], ground_truth.sizes[g]
    shared = np.minimum(sizes, truth_sizes).prod(axis=1)
    union = sizes.prod(axis=1) + truth_sizes.prod(axis=1) - shared
    period = np.where(half_turn[ground_truth.labels[g]], np.pi, 2 * np.pi)
    velocity = predictions.velocities[p] - ground_truth.velocities[g]
    attribute = np.where(
        ground_truth.attributes[g] < 0, np.nan, ground_truth.attributes[g] != predictions.attributes[p]
    )
    return np.stack(
        [
            np.hypot(offset[:, 0], offset[:, 1]),
            1 - shared / union,
            heading_errors(ground_truth.yaws[g], predictions.yaws[p], period),
            np.hypot(velocity[:, 0], velocity[:, 1]),
            attribute,
        ]
    )


def _curve(hits: FloatArray, scores: FloatArray, errors: FloatArray, annotated: int) -> Curve:
    """The curve of one class from its predictions in descending score; ``errors`` (5, N) matter where ``hits``."""
    if annotated == 0 or not hits.any():
        return Curve.empty()
    true_positives = np.cumsum(hits)
    recall = true_positives / annotated
    precision = np.interp(RECALLS, recall, true_positives / np.arange(1, len(hits) + 1), right=0)
    confidence = np.interp(RECALLS, recall, scores, right=0)
    hit_scores = scores[hits][::-1]
    sampled = np.empty((len(errors), 101))
    for row, means in zip(sampled, _running_means(errors[:, hits]), strict=True):
        row[:] = np.interp(confidence[::-1], hit_scores, means[::-1])[::-1]
    return Curve(precision, confidence, sampled)


def _running_means(errors: FloatArray) -> FloatArray:
    """(5, K) mean of each row up to each column without its NaNs; 0 before the first number, ones in rows of NaN."""
    known = ~np.isnan(errors)
    counts = np.cumsum(known, axis=1)
    sums = np.cumsum(np.where(known, errors, 0), axis=1)
    means: FloatArray = np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0)
    means[~known.any(axis=1)] = 1
    return means

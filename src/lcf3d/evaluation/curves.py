"""From matched detections to precision curves and average precision, for whole data sets and for resampled ones.

Lowering the score threshold changes a frame's true and false positives only where one of its detections comes in. A
`ScoreEvents` table holds those changes, sorted by score, once a class, measure and difficulty. Precision at any
threshold, over any weighting of frames, is then a running sum: the plain evaluation weighs each frame once, the
bootstrap as often as the frame was drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lcf3d.errors import ShapeError
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, IntArray

# the official KITTI program samples precision at 41 recall positions, 0, 1/40, ..., 1
SAMPLES = 41

Sampling = Literal["R11", "R40"]


@dataclass(frozen=True, eq=False)
class ScoreEvents:
    """What happens in each frame as the score threshold falls; both groups of rows are sorted by falling score.

    Attributes:
        objects: (F,) number of ground-truth objects that count, by frame.
        hit_scores: (H,) scores of the detections found for them when nothing is cut, one an object found.
        hit_frames: (H,) frame of each hit.
        scores: (E,) scores at which a frame's counts change.
        frames: (E,) frame of each change.
        true_positives: (E,) change of the number of true positives (may be negative where an assignment moves).
        false_positives: (E,) change of the number of false positives.
        similarity: (E,) change of the summed orientation similarity ``(1 + cos(angle error)) / 2``.
    """

    objects: IntArray
    hit_scores: FloatArray
    hit_frames: IntArray
    scores: FloatArray
    frames: IntArray
    true_positives: IntArray
    false_positives: IntArray
    similarity: FloatArray

    @property
    def object_count(self) -> int:
        """Number of ground-truth objects that count."""
        return int(self.objects.sum())


@dataclass(frozen=True, eq=False)
class PrecisionCurve:
    """Precision (or orientation similarity) at the 41 official recall positions.

    Attributes:
        precision: (41,) best precision at this or a higher recall, 0 where the recall is not reached.
        object_count: number of ground-truth objects that count.
    """

    precision: FloatArray
    object_count: int

    def average_precision(self, sampling: Sampling = "R40") -> float:
        """Average precision in percent, see `average_precision`."""
        return float(average_precision(self.precision, sampling))


def average_precision(precision: FloatArray, sampling: Sampling = "R40") -> FloatArray:
    """Average precision in percent from (..., 41) curves: 11 positions with recall 0, or the 40 above 0."""
    if precision.shape[-1] != SAMPLES:
        raise ShapeError(f"a precision curve must have {SAMPLES} values, got {precision.shape[-1]}")
    sampled = precision[..., ::4] if sampling == "R11" else precision[..., 1:]
    return np.asarray(sampled.mean(axis=-1) * 100)


def precision_curve(events: ScoreEvents) -> tuple[PrecisionCurve, PrecisionCurve]:
    """The official 41-point precision and orientation-similarity curves."""
    weights = np.ones((1, len(events.objects)), dtype=np.int64)
    precision, similarity = resampled_curves(events, weights)
    return PrecisionCurve(precision[0], events.object_count), PrecisionCurve(similarity[0], events.object_count)


def resampled_curves(events: ScoreEvents, weights: IntArray) -> tuple[FloatArray, FloatArray]:
    """The 41-point curves of B data sets in which frame ``f`` appears ``weights[b, f]`` times.

    Args:
        events: of the original data set of F frames.
        weights: (B, F) whole numbers.

    Returns:
        (B, 41) precision and (B, 41) orientation similarity, each made monotonic as the official program does.
    """
    if weights.ndim != 2 or weights.shape[1] != len(events.objects):
        raise ShapeError(f"weights must have shape (B, {len(events.objects)}), got {weights.shape}")
    precision, similarity = _sample_curves(
        np.ascontiguousarray(weights, dtype=np.int64),
        weights @ events.objects,
        events.hit_scores,
        events.hit_frames,
        events.scores,
        events.frames,
        events.true_positives,
        events.false_positives,
        events.similarity,
    )
    return _best_at_higher_recall(precision), _best_at_higher_recall(similarity)


def precision_recall(events: ScoreEvents) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The unsampled curve: (K,) recall, precision and score, one point a distinct score, from high to low."""
    last = np.flatnonzero(np.diff(events.scores, append=-np.inf))
    hits = np.cumsum(events.true_positives)[last]
    reported = hits + np.cumsum(events.false_positives)[last]
    recall = hits / max(events.object_count, 1)
    return recall, np.divide(hits, reported, out=np.zeros(len(hits)), where=reported > 0), events.scores[last]


def exact_average_precision(events: ScoreEvents) -> float:
    """Area in percent under the unsampled curve, precision being the best at this or a higher recall.

    The official 40 positions have as many thresholds as there are objects found, so that of a class with 10 objects
    even a perfect result has 22.5; this one has 100. With many objects the two agree. NaN without objects.
    """
    if not events.object_count:
        return float("nan")
    recall, precision, _ = precision_recall(events)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return 100 * float((np.diff(recall, prepend=0.0) * best).sum())


def best_f1_score(events: ScoreEvents) -> float:
    """The score threshold with the best F1 (harmonic mean of precision and recall); infinite without detections."""
    recall, precision, scores = precision_recall(events)
    if not len(scores):
        return np.inf
    total = recall + precision
    f1 = np.divide(2 * recall * precision, total, out=np.zeros(len(total)), where=total > 0)
    return float(scores[int(np.argmax(f1))])


def _best_at_higher_recall(curves: FloatArray) -> FloatArray:
    return np.maximum.accumulate(curves[:, ::-1], axis=1)[:, ::-1]


@kernel
def _sample_curves(  # type: ignore[no-untyped-def]
    weights, object_counts, hit_scores, hit_frames, scores, frames, true_positives, false_positives, similarity
):
    """(B, 41) raw precision and similarity: for each weighting, sample the thresholds, then run down the events."""
    n_sets = len(weights)
    precision = np.zeros((n_sets, SAMPLES))
    orientation = np.zeros((n_sets, SAMPLES))
    thresholds = np.empty(SAMPLES)
    for b in range(n_sets):
        weight = weights[b]
        total_hits = 0
        for i in range(len(hit_scores)):
            total_hits += weight[hit_frames[i]]
        # the official sampling: take a hit's score where its recall is nearest to the next position
        n_thresholds, rank, recall = 0, 0, 0.0
        for i in range(len(hit_scores)):
            for _ in range(weight[hit_frames[i]]):
                left = (rank + 1) / object_counts[b]
                last = rank == total_hits - 1
                right = left if last else (rank + 2) / object_counts[b]
                rank += 1
                if (right - recall < recall - left and not last) or n_thresholds == SAMPLES:
                    continue
                thresholds[n_thresholds] = hit_scores[i]
                n_thresholds += 1
                recall += 1.0 / (SAMPLES - 1.0)
        event, hits, reported, similar = 0, 0, 0, 0.0
        for k in range(n_thresholds):
            while event < len(scores) and scores[event] >= thresholds[k]:
                times = weight[frames[event]]
                hits += times * true_positives[event]
                reported += times * (true_positives[event] + false_positives[event])
                similar += times * similarity[event]
                event += 1
            if reported > 0:
                precision[b, k] = hits / reported
                orientation[b, k] = similar / reported
    return precision, orientation

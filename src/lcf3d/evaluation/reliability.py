"""Whether scores mean what they say: detections by score, and the share of them that is right."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lcf3d.structures import BoolArray, FloatArray

BINS = 10
"""Equal parts of the scores from 0 to 1."""


class ReliabilityBin(NamedTuple):
    """Detections whose scores lie in one range.

    Attributes:
        score: their mean score.
        right: the share of them that is right, 0 to 1.
        detections: how many they are.
    """

    score: float
    right: float
    detections: int


def reliability(scores: FloatArray, right: FloatArray | BoolArray, bins: int = BINS) -> tuple[ReliabilityBin, ...]:
    """The reliability diagram of some detections, without its empty ranges.

    Args:
        scores: (N,) of the detections that the protocol counts.
        right: (N,) 1 for a true positive, else 0.
        bins: equal ranges of the scores from 0 to 1.

    Returns:
        One row a range that holds detections; nothing where the scores are no probabilities.
    """
    if not len(scores) or scores.min() < 0 or scores.max() > 1:
        return ()
    number = np.minimum((scores * bins).astype(np.int64), bins - 1)
    rows = []
    for index in np.unique(number):
        own = number == index
        rows.append(ReliabilityBin(float(scores[own].mean()), float(np.mean(right[own])), int(own.sum())))
    return tuple(rows)


def calibration_error(rows: tuple[ReliabilityBin, ...]) -> float:
    """Expected calibration error: mean distance between score and share of right ones, by detections; NaN for none."""
    count = sum(row.detections for row in rows)
    return sum(row.detections * abs(row.score - row.right) for row in rows) / count if count else float("nan")

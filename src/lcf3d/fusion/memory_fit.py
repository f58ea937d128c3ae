"""Weights of the memory fitted on labelled drives, by penalised maximum likelihood.

Tracks do not depend on the weights: one pass over the drives gives, for every box, what the past says of it, and the
weights are those under which the boxes that are right are likeliest right.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.fusion.calibration_fit import minimise_log_loss
from lcf3d.fusion.evidence import to_log_odds
from lcf3d.fusion.memory_config import ClassMemory, MemoryConfig
from lcf3d.provenance import FusedDetections
from lcf3d.structures import BoolArray, FloatArray, IntArray

# pull of the weights towards the defaults, in boxes; those of a track are far from independent
MEMORY_STRENGTH = 50.0
# a class with fewer boxes that are right, or wrong, than this keeps the defaults
FEWEST = 20
# weight of the past in the pass that gathers: so low that no score comes near 0 or 1, where it would be cut off
SMALL = 0.01
# least slope of the present's log-odds: scores that mean nothing at all are not the memory's to mend
LEAST_SLOPE = 0.5
# log-odds of the least likely predicted box that is looked at
LOWEST = -60.0


class Remembered(NamedTuple):
    """Boxes of many frames and what the memory knows of them.

    Attributes:
        labels: (N,) class.
        predicted: (N,) whether the frame misses them.
        present: (N,) log-odds from the frame alone; for predicted boxes, without the base.
        past: (N,) what the class's weight is multiplied by.
    """

    labels: IntArray
    predicted: BoolArray
    present: FloatArray
    past: FloatArray


def gathering(class_names: Sequence[str]) -> MemoryConfig:
    """Settings under which the memory tells all that `remembered_boxes` needs: predicted boxes however unlikely."""
    likely = MemoryConfig(min_log_odds=LOWEST)
    return likely.with_classes(class_names, seen_weight=SMALL, missed_weight=SMALL, base=0.0, standing_doubt=0.0)


def remembered_boxes(results: Sequence[FusedDetections]) -> Remembered:
    """All boxes of frames that the memory has seen with the settings of `gathering`.

    Raises:
        ConfigError: a frame that no memory has seen.
    """
    columns = []
    for result in results:
        if result.tracks is None:
            raise ConfigError("a frame without tracks: weights of the memory are fitted on frames with a time")
        tracks, found = result.tracks, result.detections
        predicted = tracks.predicted
        # what is added to a seen box is its past; without its support a predicted one has the present
        past = np.where(predicted, tracks.support, tracks.log_odds / SMALL)
        present = np.where(predicted, tracks.log_odds, to_log_odds(found.scores)) - SMALL * past
        columns.append((found.labels, predicted, present, past))
    return Remembered(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def fit_memory(
    boxes: Remembered, judged: BoolArray, right: FloatArray, class_names: Sequence[str]
) -> dict[str, ClassMemory]:
    """Settings of the classes that have boxes enough.

    Args:
        boxes: of the labelled drives.
        judged: (N,) whether the protocol judges them.
        right: (N,) 1 for a true positive, else 0.
        class_names: the classes.
    """
    fitted = {}
    for label, name in enumerate(class_names):
        own = judged & (boxes.labels == label)
        settings = _fit_class(MemoryConfig().of(name), boxes, own, right)
        if settings is not None:
            fitted[name] = settings
    return fitted


def _fit_class(default: ClassMemory, boxes: Remembered, own: BoolArray, right: FloatArray) -> ClassMemory | None:
    """Settings of one class; None where it has too few boxes that are seen. Predicted boxes may be too few alone."""
    rows = np.flatnonzero(own & ~boxes.predicted & (boxes.past != 0))
    if not _enough(right[rows]):
        return None
    # the present's own slope and level are fitted beside, so that what the score map gets wrong is not put on the past
    columns = np.column_stack([boxes.past[rows], boxes.present[rows], np.ones(len(rows))])
    start = np.array([default.seen_weight, 1.0, 0.0])
    weight, slope, level = _fit(columns, right[rows], start, np.array([0.0, LEAST_SLOPE, -np.inf]))
    update = {"seen_weight": round(weight / slope, 4)}
    rows = np.flatnonzero(own & boxes.predicted)
    if _enough(right[rows]):
        columns = np.column_stack([boxes.past[rows], -np.ones(len(rows))])
        start = np.array([default.missed_weight, default.base])
        weight, base = _fit(columns, right[rows], start, np.array([0.0, -np.inf]), boxes.present[rows])
        # on the scale of the boxes that are seen, whose scores keep their level
        update |= {"missed_weight": round(weight / slope, 4), "base": round((base + level) / slope, 4)}
    return default.model_copy(update=update)


def _enough(right: FloatArray) -> bool:
    return bool(min(right.sum(), len(right) - right.sum()) >= FEWEST)


def _fit(
    columns: FloatArray, right: FloatArray, start: FloatArray, lowest: FloatArray, offset: FloatArray | float = 0.0
) -> list[float]:
    """Weights of the columns; constant columns are free, others are pulled to ``start``."""
    scale = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-9)
    pull = np.where(np.ptp(columns, axis=0) > 0, MEMORY_STRENGTH, 0.01)
    found = minimise_log_loss(columns / scale, right, start * scale, pull, lowest * scale, offset)
    return [float(value) for value in found / scale]

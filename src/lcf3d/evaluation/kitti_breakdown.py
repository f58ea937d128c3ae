"""Closer looks at a KITTI evaluation: over IoU thresholds, by distance, and two result sets side by side."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.evaluation.bootstrap import DEFAULT_SAMPLES, Interval, frame_weights, resampled_ap
from lcf3d.evaluation.curves import Sampling, precision_curve
from lcf3d.evaluation.kitti import MEASURE_NAMES, MEASURES, KittiEvaluator, Selection
from lcf3d.evaluation.protocol import ComparisonRow
from lcf3d.evaluation.study import DISTANCE_RANGES, DistanceRow
from lcf3d.structures import FloatArray

IOU_THRESHOLDS = tuple(i / 10 for i in range(1, 10))


def ap_over_iou(
    evaluator: KittiEvaluator, selection: Selection, thresholds: Sequence[float] = IOU_THRESHOLDS
) -> list[float]:
    """AP (R40, percent) at each of the IoU thresholds."""
    return [
        precision_curve(evaluator.events(selection, min_overlap=threshold))[0].average_precision()
        for threshold in thresholds
    ]


def ap_by_distance(
    evaluator: KittiEvaluator, selection: Selection, ranges: Sequence[tuple[float, float]] = DISTANCE_RANGES
) -> list[DistanceRow]:
    """AP for each range; objects and detections outside a range are ignored there, neither right nor wrong."""
    rows = []
    for near, far in ranges:
        curve, _ = precision_curve(evaluator.events(replace(selection, distance_range=(near, far))))
        rows.append(DistanceRow(near, far, curve.average_precision(), curve.object_count))
    return rows


def compare(
    first: KittiEvaluator,
    second: KittiEvaluator,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
    sampling: Sampling = "R40",
) -> list[ComparisonRow]:
    """Every class, measure and difficulty that both result sets cover, with bootstrap intervals over frames.

    Raises:
        DatasetError: the two were evaluated on different frames.
    """
    if first.truth.frame_ids != second.truth.frame_ids:
        raise DatasetError(
            f"results to compare must be of the same frames, got {len(first.truth)} and {len(second.truth)} frames"
        )
    if not len(first.truth):
        return []
    weights = frame_weights(len(first.truth), samples, seed)
    once = np.ones((1, len(first.truth)), dtype=np.int64)

    def values(evaluator: KittiEvaluator, selection: Selection) -> list[FloatArray]:
        """For AP and AOS: the value itself, then its resamples."""
        events = evaluator.events(selection)
        plain, drawn = resampled_ap(events, once, sampling), resampled_ap(events, weights, sampling)
        return [np.concatenate(pair) for pair in zip(plain, drawn, strict=True)]

    def rows(selection: Selection) -> list[ComparisonRow]:
        pairs = zip(values(first, selection), values(second, selection), strict=True)
        result = []
        for measure, (a, b) in zip((selection.measure, "aos"), pairs, strict=True):
            if measure == "aos" and not (selection.measure == "bbox" and _both_cover(first, second, selection, "aos")):
                continue
            intervals = [Interval.of(v[0], v[1:]) for v in (a, b, b - a)]
            result.append(ComparisonRow(selection.class_name, MEASURE_NAMES[measure], selection.difficulty, *intervals))
        return result

    common = [s for s in first.selections() if _both_cover(first, second, s, s.measure)]
    _ = first.overlap, second.overlap  # computed once, before the threads start
    with ThreadPoolExecutor(2) as pool:
        found = [row for part in pool.map(rows, common) for row in part]
    classes, names = list(first.covered), [MEASURE_NAMES[measure] for measure in MEASURES]
    return sorted(found, key=lambda row: (classes.index(row.class_name), names.index(row.measure)))


def _both_cover(first: KittiEvaluator, second: KittiEvaluator, selection: Selection, measure: str) -> bool:
    return all(measure in evaluator.covered.get(selection.class_name, ()) for evaluator in (first, second))

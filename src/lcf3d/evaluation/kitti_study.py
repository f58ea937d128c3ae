"""A KITTI result set looked at closely, for metrics.json and the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from lcf3d.evaluation.curves import precision_recall
from lcf3d.evaluation.kitti import MEASURE_NAMES, KittiEvaluator, Selection
from lcf3d.evaluation.kitti_breakdown import IOU_THRESHOLDS, ap_by_distance, ap_over_iou
from lcf3d.evaluation.kitti_matching import BELOW, COUNTS, FALSE_POSITIVE, IGNORED, TRUE_POSITIVE
from lcf3d.evaluation.kitti_outcomes import WorkingPoint, fusion_outcomes, same_detections, working_point
from lcf3d.evaluation.reliability import ReliabilityBin, reliability
from lcf3d.evaluation.study import ClassStudy, ShownBox, Study
from lcf3d.formats.kitti import KittiObjects
from lcf3d.geometry.boxes import lidar_from_kitti
from lcf3d.provenance import FusedDetections
from lcf3d.structures import FloatArray, IntArray


def study(
    evaluator: KittiEvaluator,
    name: str,
    metrics: Mapping[str, Any],
    provenance: Mapping[str, FusedDetections],
    camera_from_lidar: Callable[[str], FloatArray],
) -> Study:
    """Measure a result set and look at it closely: at moderate difficulty, in 3D where the results have 3D boxes.

    Args:
        evaluator: ground truth and results.
        name: what to call the result set.
        metrics: the official numbers.
        provenance: by frame; with it, outcomes are split by what the fusion did.
        camera_from_lidar: (4, 4) rectified reference camera from LiDAR, of a frame.
    """
    calibrations = {frame_id: camera_from_lidar(frame_id) for frame_id in provenance}
    classes, points = [], []
    for class_name, measures in evaluator.covered.items():
        if not measures:
            continue
        in_3d = "3d" in measures
        selection = Selection(class_name, "3d" if in_3d else "bbox", "moderate")
        recall, precision, scores = precision_recall(evaluator.events(selection))
        point = working_point(evaluator, selection)
        points.append(point)
        overlaps = ap_over_iou(evaluator, selection)
        classes.append(
            ClassStudy(
                class_name,
                f"{MEASURE_NAMES[selection.measure]}, moderate",
                "IoU",
                dict(zip(IOU_THRESHOLDS, overlaps, strict=True)),
                ap_by_distance(evaluator, selection) if in_3d else [],
                recall,
                precision,
                scores,
                point.threshold,
                point.counts,
                fusion_outcomes(evaluator, provenance, calibrations, selection) if in_3d and calibrations else None,
                _reliability(evaluator, selection),
            )
        )
    wrong, missed = _errors(evaluator, points)
    return Study(
        name,
        "KITTI",
        evaluator.truth.frame_ids,
        metrics,
        tuple(classes),
        wrong,
        missed,
        partial(_boxes, evaluator, tuple(points), camera_from_lidar, provenance),
        lambda number: provenance.get(evaluator.truth.frame_ids[number]),
    )


def _reliability(evaluator: KittiEvaluator, selection: Selection) -> tuple[ReliabilityBin, ...]:
    """Of the scores of all detections that count, at whatever score."""
    scores = evaluator.results.objects.scores
    if scores is None:
        return ()
    _, outcomes = evaluator.match_at(selection, -np.inf)
    judged = np.isin(outcomes, [TRUE_POSITIVE, FALSE_POSITIVE])
    return reliability(scores[judged], outcomes[judged] == TRUE_POSITIVE)


def _errors(evaluator: KittiEvaluator, points: list[WorkingPoint]) -> tuple[IntArray, IntArray]:
    """(F,) false positives and (F,) misses in each frame."""
    wrong = np.zeros(len(evaluator.truth), dtype=np.int64)
    missed = wrong.copy()
    for point in points:
        false = evaluator.results.frame_of_object[point.outcomes == FALSE_POSITIVE]
        wrong += np.bincount(false, minlength=len(wrong))
        missed += np.bincount(evaluator.truth.frame_of_object[point.missed], minlength=len(wrong))
    return wrong, missed


def _boxes(
    evaluator: KittiEvaluator,
    points: tuple[WorkingPoint, ...],
    camera_from_lidar: Callable[[str], FloatArray],
    provenance: Mapping[str, FusedDetections],
    frame: int,
) -> list[ShownBox]:
    """What there is to draw of a frame."""
    truth, results = evaluator.truth, evaluator.results
    transform = camera_from_lidar(truth.frame_ids[frame])
    fused = provenance.get(truth.frame_ids[frame])
    output_of = None if fused is None else dict(same_detections(results[frame], fused))
    shown = []
    for point in points:
        codes, _ = evaluator.codes(point.selection)
        for row in range(*truth.starts[frame : frame + 2]):
            outcome = {COUNTS: "missed" if point.missed[row] else "found", IGNORED: "ignored"}.get(int(codes[row]))
            if outcome is not None:
                shown.append(_shown(truth.objects, row, outcome, None, transform))
        first, last = results.starts[frame : frame + 2]
        for row in range(first, last):
            verdict = int(point.outcomes[row])
            if verdict == BELOW or results.objects.class_names[row].lower() != point.selection.class_name.lower():
                continue
            outcome = {TRUE_POSITIVE: "right", FALSE_POSITIVE: "wrong"}.get(verdict, "ignored")
            own = int(row - first)
            output = own if output_of is None else output_of.get(own, -1)
            shown.append(_shown(results.objects, row, outcome, output, transform))
    return shown


def _shown(objects: KittiObjects, row: int, outcome: str, output: int | None, transform: FloatArray) -> ShownBox:
    one = objects[row : row + 1]
    box = lidar_from_kitti(one.locations, one.dimensions, one.rotation_y, transform)[0] if one.has_box3d[0] else None
    score = None if output is None or one.scores is None else float(one.scores[0])
    return ShownBox(str(one.class_names[0]), outcome, score, box, one.boxes2d[0], output)

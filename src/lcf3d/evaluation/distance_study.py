"""A result set looked at closely where boxes are matched by centre distance: nuScenes, and datasets of one's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lcf3d.evaluation.center_distance import EvaluationBoxes, class_curves, matched_objects
from lcf3d.evaluation.reliability import reliability
from lcf3d.evaluation.study import DISTANCE_RANGES, ClassStudy, DistanceRow, FusionOutcomes, ShownBox, Study
from lcf3d.geometry.camera import project_boxes
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Reason
from lcf3d.structures import BoolArray, Camera, Detections3D, FloatArray, IntArray

MATCH_M = 2.0
"""Centre distance at which detections are right in the closer look."""
THRESHOLDS_M = (0.5, 1.0, 2.0, 4.0)
MIN_RECALL = MIN_PRECISION = 0.1


@dataclass(frozen=True, eq=False)
class DistanceResults:
    """Labels and detections of the same frames in one class list, LiDAR frames.

    Attributes:
        class_names: evaluated classes.
        ranges_m: (C,) largest horizontal distance at which a class is evaluated.
        truth: labels by frame.
        found: detections by frame.
    """

    class_names: tuple[str, ...]
    ranges_m: FloatArray
    truth: Sequence[Detections3D]
    found: Sequence[Detections3D]

    def joined(self, frames: Sequence[Detections3D]) -> tuple[EvaluationBoxes, BoolArray]:
        """Boxes of all frames, and (N,) which of them lie within the range of their class."""
        boxes = np.concatenate([f.boxes for f in frames]) if frames else np.zeros((0, 7))
        labels = np.concatenate([f.labels for f in frames]) if frames else np.zeros(0, dtype=np.int64)
        numbers = np.repeat(np.arange(len(frames)), [len(f) for f in frames])
        near = np.hypot(boxes[:, 0], boxes[:, 1]) < self.ranges_m[labels]
        scores = np.concatenate([f.scores for f in frames]) if frames else np.zeros(0)
        unknown = np.full((len(boxes), 2), np.nan), np.full(len(boxes), -1, dtype=np.int64)
        joined = EvaluationBoxes(numbers, labels, boxes[:, :2], boxes[:, 3:6], boxes[:, 6], scores, *unknown)
        return joined, near


def select(boxes: EvaluationBoxes, rows: BoolArray | IntArray) -> EvaluationBoxes:
    """Some of the boxes."""
    return EvaluationBoxes(*(getattr(boxes, name)[rows] for name in EvaluationBoxes.__dataclass_fields__))


def distance_study(
    results: DistanceResults,
    *,
    name: str,
    heading: str,
    frame_ids: tuple[str, ...],
    metrics: Mapping[str, Any],
    provenance: Mapping[str, FusedDetections],
    camera_of: Callable[[int], Camera | None],
) -> Study:
    """A closer look at a result set.

    Args:
        results: labels and detections.
        name: what to call the result set.
        heading: the protocol.
        frame_ids: the frames.
        metrics: the official numbers.
        provenance: by frame; with it, outcomes are split by what the fusion did.
        camera_of: the first camera of a frame, by its number, for pictures.
    """
    (truth, truth_near), (found, found_near) = results.joined(results.truth), results.joined(results.found)
    count = len(results.class_names)
    matches = np.full(len(found), -1, dtype=np.int64)
    t_rows, f_rows = np.flatnonzero(truth_near), np.flatnonzero(found_near)
    matched = matched_objects(select(truth, t_rows), select(found, f_rows), count, MATCH_M)
    matches[f_rows[matched >= 0]] = t_rows[matched[matched >= 0]]
    above = np.zeros(len(found), dtype=bool)
    missed = np.zeros(len(truth), dtype=bool)
    classes = []
    for label in range(count):
        objects = np.flatnonzero((truth.labels == label) & truth_near)
        own = np.flatnonzero((found.labels == label) & found_near)
        if not len(objects) and not len(own):
            continue
        curve = _curve(found.scores[own], matches[own] >= 0, len(objects))
        threshold = _best_score(*curve)
        kept = own[found.scores[own] >= threshold]
        above[kept] = True
        hit = np.zeros(len(truth), dtype=bool)
        hit[matches[kept][matches[kept] >= 0]] = True
        missed[objects] = ~hit[objects]
        point = _Point(label, threshold, kept, objects, matches, missed)
        outcomes = _fusion_outcomes(results, point, frame_ids, provenance, found) if provenance else None
        classes.append(_class_study(results.class_names[label], truth, found, own, point, curve, outcomes))
    wrong = np.bincount(found.frames[above & (matches < 0)], minlength=len(frame_ids))
    lost = np.bincount(truth.frames[missed], minlength=len(frame_ids))
    state = _Drawn(results, above, missed, matches, truth_near)
    return Study(
        name,
        heading,
        frame_ids,
        metrics,
        tuple(classes),
        wrong,
        lost,
        lambda f: state.boxes(f, camera_of(f)),
        lambda f: provenance.get(frame_ids[f]),
    )


@dataclass(frozen=True, eq=False)
class _Point:
    """The working point of a class: rows of all frames' detections and objects."""

    label: int
    threshold: float
    kept: IntArray
    objects: IntArray
    matches: IntArray
    missed: BoolArray


def _class_study(
    class_name: str,
    truth: EvaluationBoxes,
    found: EvaluationBoxes,
    own: IntArray,
    point: _Point,
    curve: tuple[FloatArray, FloatArray, FloatArray],
    outcomes: FusionOutcomes | None,
) -> ClassStudy:
    """The closer look at one class: ``own`` are the rows of its detections."""
    right = point.matches[point.kept] >= 0
    counts = {
        "true_positives": int(right.sum()),
        "false_positives": int((~right).sum()),
        "misses": int(point.missed[point.objects].sum()),
    }
    objects, detections = select(truth, point.objects), select(found, own)
    return ClassStudy(
        class_name,
        f"centre within {MATCH_M:g} m",
        "centre distance in metres",
        _aps(objects, detections),
        _by_distance(objects, detections),
        *curve,
        point.threshold,
        counts,
        outcomes,
        reliability(found.scores[own], point.matches[own] >= 0),
    )


def _curve(scores: FloatArray, hits: BoolArray, objects: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(K,) recall, precision and score, from high to low."""
    order = np.argsort(-scores, kind="stable")
    true = np.cumsum(hits[order])
    return true / max(objects, 1), true / np.arange(1, len(true) + 1), scores[order]


def _best_score(recall: FloatArray, precision: FloatArray, scores: FloatArray) -> float:
    if not len(scores):
        return float("inf")
    total = recall + precision
    f1 = np.divide(2 * recall * precision, total, out=np.zeros(len(total)), where=total > 0)
    return float(scores[int(np.argmax(f1))])


def _aps(truth: EvaluationBoxes, found: EvaluationBoxes) -> dict[float, float]:
    """AP of one class, percent, by matching distance."""
    one = [replace(boxes, labels=np.zeros(len(boxes), dtype=np.int64)) for boxes in (truth, found)]
    curves = class_curves(one[0], one[1], 1, THRESHOLDS_M)[0]
    aps = (100 * curve.average_precision(MIN_RECALL, MIN_PRECISION) for curve in curves)
    return dict(zip(THRESHOLDS_M, aps, strict=True))


def _by_distance(truth: EvaluationBoxes, found: EvaluationBoxes) -> list[DistanceRow]:
    rows = []
    away_truth, away_found = (np.hypot(*boxes.centers.T) for boxes in (truth, found))
    for near, far in DISTANCE_RANGES:
        inside = select(truth, (away_truth >= near) & (away_truth < far))
        # detections just beyond the edge may belong to objects inside
        reported = select(found, (away_found >= near - MATCH_M) & (away_found < far + MATCH_M))
        ap = float(np.mean(list(_aps(inside, reported).values()))) if len(inside) else float("nan")
        rows.append(DistanceRow(near, far, ap, len(inside)))
    return rows


def _fusion_outcomes(
    results: DistanceResults,
    point: _Point,
    frame_ids: tuple[str, ...],
    provenance: Mapping[str, FusedDetections],
    found: EvaluationBoxes,
) -> FusionOutcomes:
    """Outcomes at the working point, split by what the fusion did."""
    starts = np.concatenate([[0], np.cumsum([len(f) for f in results.found])])
    (truth, _), name = results.joined(results.truth), results.class_names[point.label]
    outcomes: dict[str, dict[str, int]] = {"right": {}, "wrong": {}, "dropped_right": {}, "dropped_wrong": {}}
    was_dropped = np.zeros(len(truth), dtype=bool)
    for f, frame_id in enumerate(frame_ids):
        fused = provenance.get(frame_id)
        if fused is None:
            continue
        origin = fused.origins
        for row in point.kept[(point.kept >= starts[f]) & (point.kept < starts[f + 1])]:
            _count(outcomes["right" if point.matches[row] >= 0 else "wrong"], origin[row - starts[f]])
        lost = point.objects[(truth.frames[point.objects] == f) & point.missed[point.objects]]
        for i in fused.dropped_lidar:
            if fused.lidar_inputs.class_names[fused.lidar_inputs.labels[i]] != name:
                continue
            away = np.hypot(*(truth.centers[lost] - fused.lidar_inputs.boxes[i, :2]).T)
            hit = lost[away < MATCH_M]
            was_dropped[hit] = True
            reason = Reason(int(fused.lidar.reason[i])).name.lower()
            _count(outcomes["dropped_wrong" if len(hit) else "dropped_right"], reason)
    missed = point.objects[point.missed[point.objects]]
    below = np.zeros(len(truth), dtype=bool)
    low = np.flatnonzero((found.labels == point.label) & (point.matches >= 0) & (found.scores < point.threshold))
    below[point.matches[low]] = True
    misses = {
        "dropped": int(was_dropped[missed].sum()),
        "below_threshold": int((below & ~was_dropped)[missed].sum()),
        "not_proposed": int((~below & ~was_dropped)[missed].sum()),
    }
    return FusionOutcomes(
        outcomes["right"], outcomes["wrong"], outcomes["dropped_wrong"], outcomes["dropped_right"], misses
    )


def _count(counts: dict[str, int], name: str) -> None:
    counts[name] = counts.get(name, 0) + 1


@dataclass(frozen=True, eq=False)
class _Drawn:
    """What is needed to draw single frames."""

    results: DistanceResults
    above: BoolArray
    missed: BoolArray
    matches: IntArray
    near: BoolArray

    @cached_property
    def truth_starts(self) -> IntArray:
        """(F + 1,) first row of each frame's labels."""
        return _starts(self.results.truth)

    @cached_property
    def found_starts(self) -> IntArray:
        """(F + 1,) first row of each frame's detections."""
        return _starts(self.results.found)

    def boxes(self, frame: int, camera: Camera | None) -> list[ShownBox]:
        """What there is to draw of a frame."""
        shown = []
        truth, found = self.results.truth[frame], self.results.found[frame]
        first = int(self.truth_starts[frame])
        for i, flat in enumerate(_projected(truth, camera)):
            row = first + i
            outcome = "missed" if self.missed[row] else "found" if self.near[row] else "ignored"
            shown.append(ShownBox(truth.class_names[truth.labels[i]], outcome, None, truth.boxes[i], flat))
        first = int(self.found_starts[frame])
        for i, flat in enumerate(_projected(found, camera)):
            if self.above[first + i]:
                outcome = "right" if self.matches[first + i] >= 0 else "wrong"
                name, score = found.class_names[found.labels[i]], float(found.scores[i])
                shown.append(ShownBox(name, outcome, score, found.boxes[i], flat, i))
        return shown


def _starts(frames: Sequence[Detections3D]) -> IntArray:
    return np.concatenate([[0], np.cumsum([len(f) for f in frames])]).astype(np.int64)


def _projected(detections: Detections3D, camera: Camera | None) -> list[FloatArray | None]:
    if camera is None:
        return [None] * len(detections)
    boxes, visible = project_boxes(detections.boxes, camera)
    return [box if seen else None for box, seen in zip(boxes, visible, strict=True)]

"""What became of every object and detection at a working point, and what the fusion had to do with it: KITTI."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.evaluation.curves import best_f1_score
from lcf3d.evaluation.kitti import KittiEvaluator, Selection
from lcf3d.evaluation.kitti_matching import COUNTS, FALSE_POSITIVE, TRUE_POSITIVE
from lcf3d.evaluation.study import FusionOutcomes
from lcf3d.formats.kitti import KittiFrames, KittiObjects
from lcf3d.geometry.boxes import kitti_from_lidar
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Reason
from lcf3d.run.table_folder import open_run_folder
from lcf3d.structures import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class WorkingPoint:
    """One class at one score threshold.

    Attributes:
        selection: what was matched.
        threshold: detections with a lower score are left out.
        matches: (N,) row of the detection found for each object, -1 for none.
        missed: (N,) whether the object counts and none was found.
        outcomes: (M,) `TRUE_POSITIVE`, `FALSE_POSITIVE`, ... of each detection.
    """

    selection: Selection
    threshold: float
    matches: IntArray
    missed: NDArray[np.bool_]
    outcomes: IntArray

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of true positives, false positives and misses."""
        return {
            "true_positives": int((self.outcomes == TRUE_POSITIVE).sum()),
            "false_positives": int((self.outcomes == FALSE_POSITIVE).sum()),
            "misses": int(self.missed.sum()),
        }


def working_point(evaluator: KittiEvaluator, selection: Selection, threshold: float | None = None) -> WorkingPoint:
    """The outcomes at a score threshold, by default the one with the best F1."""
    if threshold is None:
        threshold = best_f1_score(evaluator.events(selection))
    matches, outcomes = evaluator.match_at(selection, threshold)
    missed = (evaluator.codes(selection)[0] == COUNTS) & (matches == -1)
    return WorkingPoint(selection, threshold, matches, missed, outcomes)


def read_provenance(results: Path, frame_ids: tuple[str, ...]) -> dict[str, FusedDetections]:
    """What the fusion wrote in ``results/provenance``, by frame; empty where there is no such folder.

    Raises:
        FormatError: a file is not readable.
    """
    if not (Path(results) / "provenance").is_dir():
        return {}
    folder = open_run_folder(results)
    return {frame_id: folder.read(frame_id) for frame_id in frame_ids if folder.is_done(frame_id)}


def fusion_outcomes(
    evaluator: KittiEvaluator,
    provenance: Mapping[str, FusedDetections],
    camera_from_lidar: Mapping[str, FloatArray],
    selection: Selection,
) -> FusionOutcomes:
    """Split the outcomes at the best-F1 working point by what the fusion did.

    Args:
        evaluator: of the fused results.
        provenance: by frame, see `read_provenance`.
        camera_from_lidar: (4, 4) rectified reference camera from LiDAR, by frame.
        selection: class, measure and difficulty.
    """
    found = working_point(evaluator, selection)
    origins = _origins(evaluator, provenance)
    dropped, reasons = _dropped_boxes(evaluator, provenance, camera_from_lidar)
    judge = KittiEvaluator(evaluator.truth, dropped, evaluator.config)
    of_object, verdict = judge.match_at(selection, -np.inf)
    hit = np.flatnonzero((of_object >= 0) & found.missed)
    wrongly = np.zeros(len(reasons), dtype=bool)
    wrongly[of_object[hit]] = verdict[of_object[hit]] == TRUE_POSITIVE
    rightly = np.isin(verdict, [TRUE_POSITIVE, FALSE_POSITIVE]) & ~wrongly
    at_any_score, _ = evaluator.match_at(selection, -np.inf)
    was_dropped = np.zeros(len(found.missed), dtype=bool)
    was_dropped[hit] = True
    below = found.missed & ~was_dropped & (at_any_score >= 0)
    return FusionOutcomes(
        _tally(origins[found.outcomes == TRUE_POSITIVE]),
        _tally(origins[found.outcomes == FALSE_POSITIVE]),
        _tally(reasons[wrongly]),
        _tally(reasons[rightly]),
        {
            "dropped": int(was_dropped.sum()),
            "below_threshold": int(below.sum()),
            "not_proposed": int((found.missed & ~was_dropped & ~below).sum()),
        },
    )


def _tally(names: NDArray[np.str_]) -> dict[str, int]:
    values, counts = np.unique(names, return_counts=True)
    return {str(value): int(count) for value, count in zip(values, counts, strict=True)}


def _origins(evaluator: KittiEvaluator, provenance: Mapping[str, FusedDetections]) -> NDArray[np.str_]:
    """(M,) what the fusion did to each detection of the results; ``unknown`` without provenance."""
    results = evaluator.results
    origins = np.full(len(results.objects), "unknown", dtype="<U16")
    for f, frame_id in enumerate(results.frame_ids):
        fused = provenance.get(frame_id)
        if fused is None:
            continue
        names = fused.origins
        for row, output in same_detections(results[f], fused):
            origins[results.starts[f] + row] = names[output]
    return origins


def same_detections(objects: KittiObjects, fused: FusedDetections) -> list[tuple[int, int]]:
    """Pairs (result line, fused output): the writer may leave outputs out and rounds scores, but keeps their order."""
    pairs: list[tuple[int, int]] = []
    first = 0
    detections = fused.detections
    scores = objects.scores if objects.scores is not None else np.zeros(len(objects))
    for row in range(len(objects)):
        for candidate in range(first, len(detections)):
            same_class = detections.class_names[detections.labels[candidate]] == str(objects.class_names[row])
            if same_class and abs(detections.scores[candidate] - scores[row]) < 1e-5:
                pairs.append((row, candidate))
                first = candidate + 1
                break
    return pairs


def _dropped_boxes(
    evaluator: KittiEvaluator, provenance: Mapping[str, FusedDetections], camera_from_lidar: Mapping[str, FloatArray]
) -> tuple[KittiFrames, NDArray[np.str_]]:
    """The LiDAR detections that the fusion dropped, as results of the same frames, and the (K,) reasons."""
    frames, reasons = [], []
    known = {name.lower() for name in evaluator.config.classes}
    for frame_id in evaluator.truth.frame_ids:
        fused = provenance.get(frame_id)
        if fused is None:
            frames.append(KittiObjects.empty(results=True))
            continue
        rows = fused.dropped_lidar
        finite = np.isfinite(fused.lidar_inputs.boxes[rows]).all(axis=1)
        names = np.array(fused.lidar_inputs.class_names, dtype=np.str_)[fused.lidar_inputs.labels[rows]]
        keep = finite & np.isin(np.char.lower(names), list(known))
        rows, names, n = rows[keep], names[keep], int(keep.sum())
        locations, dimensions, rotation_y = kitti_from_lidar(
            fused.lidar_inputs.boxes[rows], camera_from_lidar[frame_id]
        )
        frames.append(
            KittiObjects(
                names,
                np.full(n, -1.0),
                np.full(n, -1, dtype=np.int64),
                np.zeros(n),
                # no image box is known: one that passes the minimum height, so that 3D overlap alone decides
                np.tile([0.0, 0.0, 1e4, 1e4], (n, 1)),
                dimensions,
                locations,
                rotation_y,
                np.nan_to_num(fused.lidar_inputs.scores[rows]),
            )
        )
        reasons += [Reason(code).name.lower() for code in fused.lidar.reason[rows]]
    return KittiFrames.from_frames(evaluator.truth.frame_ids, frames), np.array(reasons, dtype=np.str_)

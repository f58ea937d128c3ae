"""Everything that ``lcf3d eval`` says about one KITTI result set, gathered for metrics.json and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.evaluation.curves import precision_recall
from lcf3d.evaluation.kitti import KittiEvaluator, KittiMetrics, Selection
from lcf3d.evaluation.kitti_breakdown import IOU_THRESHOLDS, ComparisonRow, DistanceRow, ap_by_distance, ap_over_iou
from lcf3d.evaluation.kitti_fates import Fates, FusionFates, fates, fusion_fates, read_provenance
from lcf3d.evaluation.kitti_matching import FALSE_POSITIVE
from lcf3d.structures import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class ClassStudy:
    """One class at moderate difficulty, in 3D where the results have 3D boxes, else in the image.

    Attributes:
        selection: class, measure and difficulty.
        ap_over_iou: AP (R40) at the IoU thresholds 0.1 to 0.9.
        distance: AP by distance; empty for results without 3D boxes.
        recall: (K,) of the unsampled curve.
        precision: (K,) of the unsampled curve.
        fates: at the score threshold of the best F1.
        fusion: the fates split by what the fusion did, or None without provenance.
    """

    selection: Selection
    ap_over_iou: list[float]
    distance: list[DistanceRow]
    recall: FloatArray
    precision: FloatArray
    fates: Fates
    fusion: FusionFates | None


@dataclass(frozen=True, eq=False)
class KittiStudy:
    """One result set, measured and looked at closely.

    Attributes:
        name: what to call it.
        evaluator: ground truth and results.
        metrics: the official curves.
        classes: the closer look, for every class that the results cover.
    """

    name: str
    evaluator: KittiEvaluator
    metrics: KittiMetrics
    classes: tuple[ClassStudy, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values, without infinities."""
        return {
            "results": self.name,
            "frames": self.metrics.frame_count,
            "min_overlap": {name: dict(self.metrics.config.min_overlap[name]) for name in self.metrics.config.classes},
            "metrics": self.metrics.to_json(),
            "closer_look": {study.selection.class_name: _class_json(study) for study in self.classes},
        }


def study(evaluator: KittiEvaluator, name: str, results: Path | None = None, root: Path | None = None) -> KittiStudy:
    """Measure a result set and look at it closely.

    Args:
        evaluator: ground truth and results.
        name: what to call the result set.
        results: folder of a fusion run; where it holds ``provenance``, fates are split by what the fusion did.
        root: KITTI tree, for the calibration that dropped LiDAR boxes need.
    """
    provenance = read_provenance(results, evaluator.truth.frame_ids) if results is not None else {}
    calibrations = _calibrations(root, list(provenance)) if root is not None and provenance else {}
    classes = []
    for class_name, measures in evaluator.covered.items():
        if not measures:
            continue
        selection = Selection(class_name, "3d" if "3d" in measures else "bbox", "moderate")
        recall, precision, _ = precision_recall(evaluator.events(selection))
        in_3d = selection.measure == "3d"
        classes.append(
            ClassStudy(
                selection,
                ap_over_iou(evaluator, selection),
                ap_by_distance(evaluator, selection) if in_3d else [],
                recall,
                precision,
                fates(evaluator, selection),
                fusion_fates(evaluator, provenance, calibrations, selection) if in_3d and calibrations else None,
            )
        )
    return KittiStudy(name, evaluator, evaluator.metrics(), tuple(classes))


def comparison_json(rows: Sequence[ComparisonRow]) -> list[dict[str, Any]]:
    """Plain JSON values of a comparison."""
    return [asdict(row) for row in rows]


def worst_frames(study: KittiStudy, count: int) -> list[tuple[int, int, int]]:
    """(frame index, false positives, misses) of the ``count`` frames with most errors over all classes, worst first."""
    evaluator = study.evaluator
    wrong = np.zeros(len(evaluator.truth), dtype=np.int64)
    missed = wrong.copy()
    for part in study.classes:
        wrong += _by_frame(evaluator.results.frame_of_object[part.fates.outcomes == FALSE_POSITIVE], len(wrong))
        missed += _by_frame(evaluator.truth.frame_of_object[part.fates.missed], len(wrong))
    order = np.argsort(-(wrong + missed), kind="stable")[:count]
    return [(int(f), int(wrong[f]), int(missed[f])) for f in order if wrong[f] + missed[f]]


def _by_frame(frames: IntArray, n_frames: int) -> IntArray:
    return np.bincount(frames, minlength=n_frames)


def _calibrations(root: Path, frame_ids: Sequence[str]) -> Mapping[str, FloatArray]:
    from lcf3d.datasets.kitti import read_calibration

    folder = Path(root) / "training" / "calib"
    return {frame_id: read_calibration(folder / f"{frame_id}.txt").camera_from_lidar for frame_id in frame_ids}


def _class_json(part: ClassStudy) -> dict[str, Any]:
    return {
        "measure": part.selection.measure,
        "difficulty": part.selection.difficulty,
        "ap_over_iou": {f"{iou:.1f}": ap for iou, ap in zip(IOU_THRESHOLDS, part.ap_over_iou, strict=True)},
        "ap_by_distance": [
            {
                "near_m": row.near,
                "far_m": row.far if np.isfinite(row.far) else None,
                "AP_R40": row.ap,
                "objects": row.objects,
            }
            for row in part.distance
        ],
        "best_f1": {
            "score_threshold": part.fates.threshold if np.isfinite(part.fates.threshold) else None,
            **part.fates.counts,
        },
        **({"fusion": part.fusion.to_json()} if part.fusion else {}),
    }

"""A result set looked at closely, in a form that does not depend on the dataset: what the report draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from lcf3d.evaluation.reliability import ReliabilityBin, calibration_error
from lcf3d.provenance import FusedDetections
from lcf3d.structures import FloatArray, IntArray

DISTANCE_RANGES = ((0.0, 20.0), (20.0, 40.0), (40.0, float("inf")))
"""Ranges in metres that results are split into."""


class DistanceRow(NamedTuple):
    """AP within one range of distances on the ground.

    Attributes:
        near: metres, included.
        far: metres, not included.
        ap: percent.
        objects: labelled objects in the range.
    """

    near: float
    far: float
    ap: float
    objects: int


@dataclass(frozen=True)
class FusionOutcomes:
    """The outcomes of one class at its working point, split by what the fusion did.

    Attributes:
        true_positives: right detections, by what the fusion did to them: ``matched`` (confirmed by a camera),
            ``recovered`` (found from a camera detection), ``downweighted`` or ``kept`` (without a camera's word).
        false_positives: wrong detections, in the same way.
        dropped_wrongly: dropped LiDAR detections of an object that is now missed, by the fusion's reason.
        dropped_rightly: dropped LiDAR detections of no object, or of one that is reported anyway, by reason.
        misses: missed objects: ``dropped`` by the fusion, ``below_threshold`` (reported with a lower score), or
            ``not_proposed`` (no LiDAR detection and no output overlaps it enough).
    """

    true_positives: dict[str, int] = field(default_factory=dict)
    false_positives: dict[str, int] = field(default_factory=dict)
    dropped_wrongly: dict[str, int] = field(default_factory=dict)
    dropped_rightly: dict[str, int] = field(default_factory=dict)
    misses: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        names = ("true_positives", "false_positives", "dropped_wrongly", "dropped_rightly", "misses")
        return {name: dict(getattr(self, name)) for name in names}


@dataclass(frozen=True, eq=False)
class ClassStudy:
    """One class.

    Attributes:
        class_name: the class.
        measure: what was measured, in words, for example ``3D, moderate``.
        threshold_name: what the thresholds are: ``IoU`` or ``centre distance in metres``.
        ap_over_threshold: AP, percent, by threshold.
        distance: AP by distance; empty for results without 3D boxes.
        recall: (K,) of the unsampled curve.
        precision: (K,) of the unsampled curve.
        scores: (K,) score of each point of the curve.
        score_threshold: score of the best F1; infinite without any true positive.
        counts: ``true_positives``, ``false_positives`` and ``misses`` there.
        fusion: the outcomes split by what the fusion did, or None without provenance.
        reliability: of the scores of all detections that count; empty where they are no probabilities.
    """

    class_name: str
    measure: str
    threshold_name: str
    ap_over_threshold: Mapping[float, float]
    distance: list[DistanceRow]
    recall: FloatArray
    precision: FloatArray
    scores: FloatArray
    score_threshold: float
    counts: Mapping[str, int]
    fusion: FusionOutcomes | None
    reliability: tuple[ReliabilityBin, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values, None for what is infinite or not a number."""
        values: dict[str, Any] = {
            "measure": self.measure,
            "threshold": self.threshold_name,
            "ap_over_threshold": {f"{threshold:g}": ap for threshold, ap in self.ap_over_threshold.items()},
            "ap_by_distance": [
                {
                    "near_m": row.near,
                    "far_m": row.far if np.isfinite(row.far) else None,
                    "AP": row.ap if np.isfinite(row.ap) else None,
                    "objects": row.objects,
                }
                for row in self.distance
            ],
            "best_f1": {
                "score_threshold": self.score_threshold if np.isfinite(self.score_threshold) else None,
                **self.counts,
            },
        }
        if self.reliability:
            values["calibration"] = {
                "expected_error": calibration_error(self.reliability),
                "bins": [row._asdict() for row in self.reliability],
            }
        if self.fusion is not None:
            values["fusion"] = self.fusion.to_json()
        return values


class ShownBox(NamedTuple):
    """A labelled object or a detection of one frame, as it is drawn.

    Attributes:
        class_name: its class.
        outcome: ``right``, ``wrong`` or ``ignored`` for detections; ``found``, ``missed`` or ``ignored`` for objects.
        score: of a detection, None for a labelled object.
        box3d: (7,) in the LiDAR frame, or None without a 3D box.
        box2d: (4,) pixels of the first camera, or None where it is not in view.
        output: index of the detection among those of its frame (of the fusion's, where its provenance is there), None
            for a labelled object.
    """

    class_name: str
    outcome: str
    score: float | None
    box3d: FloatArray | None
    box2d: FloatArray | None
    output: int | None = None


@dataclass(frozen=True, eq=False)
class Study:
    """One result set, measured and looked at closely.

    Attributes:
        name: what to call it.
        heading: the protocol, for example ``KITTI``.
        frame_ids: the frames.
        metrics: what `lcf3d.evaluation.protocol.ResultSet.to_json` gives.
        classes: the closer look, for every class that the results cover.
        wrong: (F,) false positives in each frame, over all classes at their working points.
        missed: (F,) missed objects in each frame.
        boxes: what there is to draw of a frame, by its number.
        fused: the provenance of a frame, by its number; None where there is none.
    """

    name: str
    heading: str
    frame_ids: tuple[str, ...]
    metrics: Mapping[str, Any]
    classes: tuple[ClassStudy, ...]
    wrong: IntArray
    missed: IntArray
    boxes: Callable[[int], list[ShownBox]]
    fused: Callable[[int], FusedDetections | None] = lambda number: None

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "results": self.name,
            "frames": len(self.frame_ids),
            "metrics": dict(self.metrics),
            "closer_look": {part.class_name: part.to_json() for part in self.classes},
        }

    def worst_frames(self, count: int) -> list[int]:
        """Numbers of the ``count`` frames with most errors over all classes, worst first."""
        errors = self.wrong + self.missed
        order = np.argsort(-errors, kind="stable")[:count]
        return [int(f) for f in order if errors[f]]

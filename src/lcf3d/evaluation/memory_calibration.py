"""Weights of the memory fitted on labelled drives, and what they bring, cross-validated by drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.evaluation.calibration_study import CalibrationStudy
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.memory import remember_sequence
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_fit import fit_memory, gathering, remembered_boxes
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.provenance import FusedDetections
from lcf3d.run.sequences import places_in_order
from lcf3d.structures import BoolArray, Detections3D


@dataclass(frozen=True)
class MemoryReport:
    """What the memory brings to one class, cross-validated; see `lcf3d.evaluation.protocol.Evaluation.figures`.

    Attributes:
        class_name: the class.
        alone: every frame alone, scores and evidence fitted.
        default: with memory, default weights.
        fitted: with memory, fitted weights.
    """

    class_name: str
    alone: tuple[float, ...]
    default: tuple[float, ...]
    fitted: tuple[float, ...]


class MemoryStudy:
    """The drives of a calibration study.

    Args:
        study: whose frames and detections.

    Raises:
        DatasetError: no frame tells its sequence and time.
    """

    def __init__(self, study: CalibrationStudy) -> None:
        self.study = study
        self.sequences = places_in_order(study.frames)

    def fit(self, calibration: Calibration, training: BoolArray | None = None) -> Calibration:
        """The calibration with weights of the memory fitted on some frames (whole drives; all by default)."""
        chosen = self._sequences(training)
        alone = self._fused(calibration, chosen)
        results = self._remembered(alone, chosen, gathering(self.study.config.class_names))
        verdict = self.study.evaluation.judge_lidar(_by_frame(results, len(self.study.frames), self._none()))
        boxes = remembered_boxes([results[i] for i in sorted(results)])
        memory = fit_memory(boxes, verdict.judged, verdict.right, self.study.config.class_names)
        return calibration.model_copy(update={"memory": memory})

    def cross_validate(self, final: Calibration) -> list[MemoryReport]:
        """Fit scores, evidence and memory on all folds but one, fuse and remember the one, for each.

        Raises:
            DatasetError: a drive lies in two folds.
        """
        for places in self.sequences:
            if len(set(self.study.folds[places].tolist())) > 1:
                raise DatasetError(
                    f"drive {self.study.frames[places[0]].sequence} lies in more than one part of the "
                    "cross-validation, and memory needs whole drives: give several drives, or --folds 0"
                )
        alone: dict[int, FusedDetections] = {}
        default: dict[int, FusedDetections] = {}
        fitted: dict[int, FusedDetections] = {}
        for fold in np.unique(self.study.folds):
            training = self.study.folds != fold
            model = self.fit(self.study.fit(training, like=final), training)
            chosen = self._sequences(~training)
            own = self._fused(model, chosen)
            alone |= own
            default |= self._remembered(own, chosen, MemoryConfig())
            fitted |= self._remembered(own, chosen, MemoryConfig(classes=model.memory))
        figures = [
            self.study.evaluation.figures(_by_frame(results, len(self.study.frames), self._none()))
            for results in (alone, default, fitted)
        ]
        return [MemoryReport(name, *(f[name] for f in figures)) for name in final.memory]

    def _sequences(self, training: BoolArray | None) -> list[list[int]]:
        return [places for places in self.sequences if training is None or training[places[0]]]

    def _none(self) -> Detections3D:
        return Detections3D.empty(self.study.config.class_names)

    def _fused(self, calibration: Calibration, sequences: Sequence[Sequence[int]]) -> dict[int, FusedDetections]:
        """Every frame of some drives, fused alone, by place."""
        study = self.study
        fusion = LateCascadeFusion(study.config.updated(recovery=False), calibration=calibration)
        return {
            i: fusion(study.frames[i], study.lidar_inputs[i], study.camera_inputs[i])
            for i in study.progress([i for places in sequences for i in places])
        }

    def _remembered(
        self, fused: dict[int, FusedDetections], sequences: Sequence[Sequence[int]], config: MemoryConfig
    ) -> dict[int, FusedDetections]:
        """The same with what the frames before add."""
        results: dict[int, FusedDetections] = {}
        for places in sequences:
            pairs = ((self.study.frames[i], fused[i]) for i in places)
            results |= dict(zip(places, remember_sequence(pairs, config), strict=True))
        return results


def _by_frame(results: dict[int, FusedDetections], n: int, none: Detections3D) -> list[Detections3D]:
    """The detections of all ``n`` frames, none where there is no result."""
    return [results[i].detections if i in results else none for i in range(n)]

"""Fitting a calibration on labelled KITTI frames, and measuring by cross-validation what it brings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.evaluation.kitti import DIFFICULTIES, KittiEvaluator, KittiMetrics, Selection, evaluate
from lcf3d.evaluation.kitti_matching import FALSE_POSITIVE, TRUE_POSITIVE
from lcf3d.formats.kitti import KittiFrames, KittiObjects, detections_2d, detections_3d, objects_from_detections
from lcf3d.fusion.calibration import Calibration, ScoreMap, ground_height
from lcf3d.fusion.calibration_fit import choose_map, fit_evidence, fit_map, log_loss
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.evidence import Evidence, to_probability
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.fusion.weighing import Weighed
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray, Frame, IntArray

# a class with fewer judged detections than this, or fewer right or wrong ones than a quarter of it, gets no map
FEWEST = 20

Progress = Callable[[Sequence[int]], Iterable[int]]


class Judged(NamedTuple):
    """Detections of one branch over all frames, class after class judged by the official protocol.

    Attributes:
        frames: (N,) frame of each detection.
        labels: (N,) its class.
        scores: (N,) as the detector wrote them.
        judged: (N,) whether the protocol judges it (not DontCare, ignored objects or too small).
        right: (N,) 1 for a true positive, else 0.
    """

    frames: IntArray
    labels: IntArray
    scores: FloatArray
    judged: BoolArray
    right: FloatArray


@dataclass(frozen=True)
class ClassReport:
    """What calibration did to one class.

    Attributes:
        class_name: the class.
        lidar_count: LiDAR detections judged.
        camera_count: camera detections judged.
        log_loss_before: of the LiDAR scores as they are, NaN where they are no probabilities.
        log_loss_lidar: cross-validated, of the calibrated LiDAR scores.
        log_loss_fused: cross-validated, of the fused scores of the boxes that the camera judges; NaN if none.
        before: 3D AP R40 of the LiDAR branch alone, by difficulty.
        after: the same of the fusion, cross-validated.
    """

    class_name: str
    lidar_count: int
    camera_count: int
    log_loss_before: float
    log_loss_lidar: float
    log_loss_fused: float
    before: tuple[float, float, float]
    after: tuple[float, float, float]


class CalibrationStudy:
    """Detections of two branches and the ground truth of the same frames.

    Args:
        frames: with their cameras; the first camera is the one that the 2D detections are of.
        truth: labels.
        lidar: results with 3D boxes.
        camera: results with 2D boxes.
        config: settings of the fusion.
        folds: (F,) fold of each frame, see `block_folds`.
        progress: wraps loops over frames, for a progress bar.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        truth: KittiFrames,
        lidar: KittiFrames,
        camera: KittiFrames,
        config: FusionConfig,
        folds: IntArray,
        progress: Progress = lambda indices: indices,
    ) -> None:
        self.frames, self.truth, self.config, self.folds = list(frames), truth, config, folds
        self.lidar_results, self.camera_results = lidar, camera
        self._progress = progress
        names = config.class_names
        views = [frame.cameras[0] for frame in self.frames]
        self.lidar_inputs = [detections_3d(lidar[i], view.camera_from_lidar, names) for i, view in enumerate(views)]
        self.camera_inputs = [_clipped(detections_2d(camera[i], names), frame) for i, frame in enumerate(self.frames)]
        if not any(len(found) for found in self.lidar_inputs):
            raise DatasetError(f"the LiDAR results hold no 3D boxes of {', '.join(names)}: nothing to calibrate")

    @cached_property
    def lidar(self) -> Judged:
        """LiDAR detections judged in 3D at the official IoU, ``hard``."""
        taken = [np.isin(o.class_names, self.config.class_names) & o.has_box3d for o in self.lidar_results]
        return self._judge(self.lidar_results, "3d", np.concatenate(taken), self.lidar_inputs)

    @cached_property
    def camera(self) -> Judged:
        """Camera detections judged in 2D at the official IoU, ``hard``."""
        taken = np.isin(self.camera_results.objects.class_names, self.config.class_names)
        return self._judge(self.camera_results, "bbox", taken, self.camera_inputs)

    @property
    def camera_classes(self) -> tuple[str, ...]:
        """The classes that the camera branch detects anywhere."""
        found = np.unique(self.camera.labels)
        return tuple(self.config.class_names[i] for i in found)

    def fit(self, training: BoolArray | None = None, like: Calibration | None = None) -> Calibration:
        """A calibration fitted on some frames (all by default).

        Args:
            training: (F,) which frames to fit on.
            like: take the kind and transform of each score map from this calibration instead of choosing anew.
        """
        chosen = np.ones(len(self.frames), dtype=bool) if training is None else training
        maps = {
            branch: self._fit_maps(judged, chosen, None if like is None else getattr(like, branch))
            for branch, judged in (("lidar", self.lidar), ("camera", self.camera))
        }
        rows = self.lidar.judged & (self.lidar.right > 0) & chosen[self.lidar.frames]
        bottoms = np.concatenate([found.boxes[:, 2] - found.boxes[:, 5] / 2 for found in self.lidar_inputs])
        calibration = Calibration(
            source=f"{int(chosen.sum())} labelled frames",
            lidar=maps["lidar"],
            camera=maps["camera"],
            camera_classes=self.camera_classes,
            ground_z=ground_height(bottoms[rows]),
        )
        weighed, places = self.weigh(calibration, np.flatnonzero(chosen))
        return calibration.model_copy(update={"evidence": self._fit_evidence(weighed, places)})

    def weigh(self, calibration: Calibration, frames: IntArray) -> tuple[Weighed, IntArray]:
        """Evidence of the clusters of some frames, and the row in `lidar` of each cluster's box."""
        fusion = LateCascadeFusion(self.config, _no_localizer, calibration)
        starts = np.concatenate([[0], np.cumsum([len(found) for found in self.lidar_inputs])])
        parts, places = [], []
        for i in self._progress([int(f) for f in frames]):
            frame = self.frames[i]
            part = fusion.weigh(frame, self.lidar_inputs[i], {frame.cameras[0].name: self.camera_inputs[i]})
            parts.append(part)
            places.append(starts[i] + part.box)
        joined = Weighed(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        return joined, np.concatenate(places).astype(np.int64)

    def cross_validate(self, final: Calibration) -> list[ClassReport]:
        """Fit on all folds but one, fuse the one, for each; then judge all frames together.

        Each fold's model is only defined up to a rising map, so fused log-odds are written in the LiDAR detector's own
        score before folds are put together: within a fold the order is the model's.
        """
        probabilities, equivalents = np.full(len(self.lidar.scores), np.nan), np.full(len(self.lidar.scores), np.nan)
        alone = np.full(len(self.lidar.scores), np.nan)
        for fold in np.unique(self.folds):
            test = self.folds == fold
            model = self.fit(~test, like=final)
            weighed, places = self.weigh(model, np.flatnonzero(test))
            for label, name in enumerate(self.config.class_names):
                own = weighed.labels == label
                rows = places[own]
                judged = weighed.agreed[own]
                log_odds = weighed.table[own, 0]
                evidence = model.evidence.get(name, Evidence.lidar_alone())
                fused = weighed.table[own] @ evidence.weights
                alone[rows] = to_probability(log_odds)
                probabilities[rows] = np.where(judged, to_probability(fused), alone[rows])
                level = np.where(judged, (fused - evidence.base) / evidence.trust, log_odds)
                score_map = model.lidar.get(name)
                equivalents[rows] = score_map.transformed_at(level) if score_map else level
        return [self._report(name, equivalents, probabilities, alone) for name in self._present_classes()]

    def fused_objects(self, scores: FloatArray) -> KittiFrames:
        """The LiDAR boxes with other scores, NaN for none, as results with projected 2D boxes."""
        out, start = [], 0
        for frame, found in zip(self.frames, self.lidar_inputs, strict=True):
            own = scores[start : start + len(found)]
            start += len(found)
            kept = ~np.isnan(own)
            out.append(result_objects(frame, replace(found, scores=own)[kept]))
        return KittiFrames.from_frames(self.truth.frame_ids, out)

    def _present_classes(self) -> list[str]:
        return [self.config.class_names[i] for i in np.unique(self.lidar.labels)]

    def _report(self, name: str, equivalents: FloatArray, probabilities: FloatArray, alone: FloatArray) -> ClassReport:
        lidar, label = self.lidar, self.config.class_names.index(name)
        rows = (lidar.labels == label) & lidar.judged & ~np.isnan(alone)
        scores, right = lidar.scores[rows], lidar.right[rows]
        bounded = len(scores) > 0 and scores.min() >= 0 and scores.max() <= 1
        return ClassReport(
            name,
            int(rows.sum()),
            int(((self.camera.labels == label) & self.camera.judged).sum()),
            log_loss(scores, right) if bounded else float("nan"),
            log_loss(alone[rows], right),
            log_loss(probabilities[rows], right) if name in self.camera_classes else float("nan"),
            average_precisions(self._metrics_before, name),
            average_precisions(evaluate(self.truth, self.fused_objects(equivalents)), name),
        )

    @cached_property
    def _metrics_before(self) -> KittiMetrics:
        return evaluate(self.truth, self.lidar_results)

    def _judge(
        self,
        results: KittiFrames,
        measure: str,
        taken: BoolArray,
        inputs: Sequence[Detections2D] | Sequence[Detections3D],
    ) -> Judged:
        evaluator = KittiEvaluator(self.truth, results)
        labels = np.concatenate([found.labels for found in inputs])
        judged, right = np.zeros(len(labels), dtype=bool), np.zeros(len(labels))
        for label, name in enumerate(self.config.class_names):
            if name not in evaluator.config.classes or not (labels == label).any():
                continue
            _, outcomes = evaluator.match_at(Selection(name, measure, "hard"), -np.inf)  # type: ignore[arg-type]
            own = labels == label
            outcomes = outcomes[taken]
            judged[own] = np.isin(outcomes[own], [TRUE_POSITIVE, FALSE_POSITIVE])
            right[own] = outcomes[own] == TRUE_POSITIVE
        scores = np.concatenate([found.scores for found in inputs])
        frames = np.repeat(np.arange(len(inputs)), [len(found) for found in inputs])
        return Judged(frames, labels, scores, judged, right)

    def _fit_maps(self, judged: Judged, training: BoolArray, like: dict[str, ScoreMap] | None) -> dict[str, ScoreMap]:
        maps = {}
        for label, name in enumerate(self.config.class_names):
            rows = (judged.labels == label) & judged.judged & training[judged.frames]
            scores, right = judged.scores[rows], judged.right[rows]
            if like is not None:
                if name in like:
                    maps[name] = fit_map(scores, right, like[name].kind, like[name].transform)
            elif len(right) >= FEWEST and FEWEST / 4 <= right.sum() <= len(right) - FEWEST / 4:
                maps[name], _ = choose_map(scores, right, self.folds[judged.frames[rows]])
        return maps

    def _fit_evidence(self, weighed: Weighed, places: IntArray) -> dict[str, Evidence]:
        found = {}
        for label, name in enumerate(self.config.class_names):
            rows = (weighed.labels == label) & weighed.agreed & self.lidar.judged[places]
            if name in self.camera_classes and rows.sum() >= FEWEST:
                recovered = self.config.evidence.get(name, Evidence()).recovered
                right = self.lidar.right[places[rows]]
                found[name] = fit_evidence(weighed.table[rows], right, recovered=recovered)
        return found


def average_precisions(metrics: KittiMetrics, name: str) -> tuple[float, float, float]:
    """3D AP R40, easy, moderate and hard."""
    easy, moderate, hard = (metrics.ap(name, "3d", d) for d in DIFFICULTIES)
    return easy, moderate, hard


def result_objects(frame: Frame, detections: Detections3D) -> KittiObjects:
    """KITTI result lines of 3D detections, 2D boxes projected into the frame's first camera."""
    view = frame.cameras[0]
    projected, visible = project_boxes(detections.boxes, view)
    return objects_from_detections(detections[visible], projected[visible], view.camera_from_lidar)


def _clipped(found: Detections2D, frame: Frame) -> Detections2D:
    view = frame.cameras[0]
    limits = np.array([view.width, view.height, view.width, view.height], dtype=np.float64)
    return replace(found, boxes=np.clip(found.boxes, 0, limits))


def _no_localizer(proposals: object) -> tuple[FloatArray, FloatArray]:
    raise AssertionError("calibration recovers nothing")

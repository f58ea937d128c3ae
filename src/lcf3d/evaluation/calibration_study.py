"""Fitting a calibration on labelled frames, and measuring by cross-validation what it brings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.evaluation.opening import open_evaluation, usual_frames
from lcf3d.evaluation.protocol import Evaluation, Verdict
from lcf3d.frame import Frame
from lcf3d.fusion.calibration import Calibration, ScoreMap, ground_height
from lcf3d.fusion.calibration_fit import block_folds, choose_map, fit_evidence, fit_map, log_loss
from lcf3d.fusion.cluster_evidence import ClusterEvidence
from lcf3d.fusion.clustering import cluster_boxes
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.evidence import Evidence, to_probability
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.run.setup import RunRequest, read_inputs
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray, IntArray

# a class with fewer judged detections than this, or fewer right or wrong ones than a quarter of it, gets no map
FEWEST = 20

Progress = Callable[[Sequence[int]], Iterable[int]]


class Assessed(NamedTuple):
    """Detections of one branch over all frames, judged by the dataset's protocol.

    Attributes:
        frames: (N,) frame of each detection.
        labels: (N,) its class.
        scores: (N,) as the detector wrote them.
        judged: (N,) whether the protocol judges it (not ignored objects, too small or too far).
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
        before: figures of the LiDAR branch alone, see `lcf3d.evaluation.protocol.Evaluation.figures`.
        after: the same of the fusion, cross-validated.
    """

    class_name: str
    lidar_count: int
    camera_count: int
    log_loss_before: float
    log_loss_lidar: float
    log_loss_fused: float
    before: tuple[float, ...]
    after: tuple[float, ...]


class FusedScores(NamedTuple):
    """Scores of all LiDAR detections, each fused by what was fitted on the other folds; NaN for those left out.

    Attributes:
        equivalents: (N,) on the scale of the LiDAR detector's own scores, comparable between folds.
        probabilities: (N,) that the box is right.
        alone: (N,) the same by the LiDAR score alone.
    """

    equivalents: FloatArray
    probabilities: FloatArray
    alone: FloatArray


class CalibrationStudy:
    """Detections of two branches and the ground truth of the same frames.

    A LiDAR branch without suppression reports an object many times over, and the protocol calls all but one of these
    boxes wrong. The fusion passes one box a cluster on: only that one is judged and fitted on.

    Args:
        frames: with their cameras.
        evaluation: judges detections of these frames.
        lidar: 3D detections by frame.
        camera: 2D detections by camera name, of each frame.
        config: settings of the fusion.
        folds: (F,) fold of each frame, see `block_folds`.
        progress: wraps loops over frames, for a progress bar.
        sources: where the detections of the two branches were read from, if the evaluation can use that.

    Raises:
        DatasetError: there are no 3D boxes.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        evaluation: Evaluation,
        lidar: Sequence[Detections3D],
        camera: Sequence[Mapping[str, Detections2D]],
        config: FusionConfig,
        folds: IntArray,
        progress: Progress = lambda indices: indices,
        sources: tuple[Any, Any] = (None, None),
    ) -> None:
        self.frames, self.evaluation, self.config, self.folds = list(frames), evaluation, config, folds
        self.lidar_inputs, self.camera_inputs, self.sources = list(lidar), list(camera), sources
        self.progress = progress
        if not any(len(found) for found in self.lidar_inputs):
            names = ", ".join(config.class_names)
            raise DatasetError(f"the LiDAR results hold no 3D boxes of {names}: nothing to calibrate")

    @cached_property
    def standing(self) -> list[BoolArray]:
        """(N,) by frame, which LiDAR detections stand for their cluster; the others are its doubles."""
        config, masks = self.config, []
        for found in self.lidar_inputs:
            clusters = cluster_boxes(
                found.boxes,
                found.scores,
                found.labels,
                method=config.clustering,
                iou_threshold=config.cluster_iou,
                class_aware=config.class_aware,
            )
            masks.append(np.isin(np.arange(len(found)), clusters.representative))
        return masks

    @property
    def doubles(self) -> int:
        """LiDAR detections that stand for no cluster."""
        return int(sum((~mask).sum() for mask in self.standing))

    @cached_property
    def lidar(self) -> Assessed:
        """LiDAR detections judged in 3D; those that do not stand for their cluster are not."""
        one_each, source = self._one_each(self.lidar_inputs), self.sources[0]
        if self.doubles and hasattr(source, "objects"):
            source = _StandingLines(source, dict(zip((f.id for f in self.frames), self.standing, strict=True)), self)
        verdict = self.evaluation.judge_lidar(one_each, source)
        rows = np.flatnonzero(np.concatenate(self.standing))
        judged, right = np.zeros((2, sum(map(len, self.lidar_inputs))))
        judged[rows], right[rows] = verdict.judged, verdict.right
        whole = Verdict(judged.astype(bool), right)
        return _assessed(self.lidar_inputs, range(len(self.lidar_inputs)), whole)

    def _one_each(self, found: Sequence[Detections3D]) -> list[Detections3D]:
        """The LiDAR detections without the doubles."""
        return [own[mask] for own, mask in zip(found, self.standing, strict=True)]

    @cached_property
    def camera(self) -> Assessed:
        """Camera detections judged in the images."""
        verdict = self.evaluation.judge_camera(self.camera_inputs, self.sources[1])
        found = [(f, detections) for f, seen in enumerate(self.camera_inputs) for detections in seen.values()]
        return _assessed([detections for _, detections in found], [f for f, _ in found], verdict)

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
        weighed, places = self.evidence(calibration, np.flatnonzero(chosen))
        return calibration.model_copy(update={"evidence": self._fit_evidence(weighed, places)})

    def evidence(self, calibration: Calibration, frames: IntArray) -> tuple[ClusterEvidence, IntArray]:
        """Evidence of the clusters of some frames, and the row in `lidar` of each cluster's box."""
        fusion = LateCascadeFusion(self.config, _no_localizer, calibration)
        starts = np.concatenate([[0], np.cumsum([len(found) for found in self.lidar_inputs])])
        parts, places = [], []
        for i in self.progress([int(f) for f in frames]):
            frame = self.frames[i]
            part = fusion.evidence(frame, self.lidar_inputs[i], self.camera_inputs[i])
            parts.append(part)
            places.append(starts[i] + part.box)
        joined = ClusterEvidence(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        return joined, np.concatenate(places).astype(np.int64)

    def cross_validate(self, final: Calibration) -> list[ClassReport]:
        """Fit on all folds but one, fuse the one, for each; then judge all frames together."""
        scores = self.fuse_folds(final)
        return [self._report(name, *scores) for name in self._present_classes()]

    def fuse_folds(self, final: Calibration) -> FusedScores:
        """The scores of every fold, fused by what was fitted on the others.

        Each fold's model is only defined up to a rising map, so fused log-odds are written in the LiDAR detector's own
        score before folds are put together: within a fold the order is the model's.
        """
        probabilities, equivalents = np.full(len(self.lidar.scores), np.nan), np.full(len(self.lidar.scores), np.nan)
        alone = np.full(len(self.lidar.scores), np.nan)
        for fold in np.unique(self.folds):
            test = self.folds == fold
            model = self.fit(~test, like=final)
            weighed, places = self.evidence(model, np.flatnonzero(test))
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
        return FusedScores(equivalents, probabilities, alone)

    def rescored(self, scores: FloatArray) -> list[Detections3D]:
        """The LiDAR boxes with other scores, those of NaN left out."""
        out, start = [], 0
        for found in self.lidar_inputs:
            own = scores[start : start + len(found)]
            start += len(found)
            out.append(replace(found, scores=own)[~np.isnan(own)])
        return out

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
            self._before[name],
            self.evaluation.figures(self.rescored(equivalents))[name],
        )

    @cached_property
    def _before(self) -> dict[str, tuple[float, ...]]:
        return self.evaluation.figures(self._one_each(self.lidar_inputs))

    def _fit_maps(self, judged: Assessed, training: BoolArray, like: dict[str, ScoreMap] | None) -> dict[str, ScoreMap]:
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

    def _fit_evidence(self, weighed: ClusterEvidence, places: IntArray) -> dict[str, Evidence]:
        found = {}
        for label, name in enumerate(self.config.class_names):
            rows = (weighed.labels == label) & weighed.agreed & self.lidar.judged[places]
            if name in self.camera_classes and rows.sum() >= FEWEST:
                recovered = self.config.evidence_of(name).recovered
                right = self.lidar.right[places[rows]]
                found[name] = fit_evidence(weighed.table[rows], right, recovered=recovered)
        return found


@dataclass(frozen=True)
class _StandingLines:
    """Lines of result files, of the boxes that stand for their cluster only."""

    source: Any
    standing: Mapping[str, BoolArray]
    study: CalibrationStudy

    def objects(self, frame: Frame) -> Any:
        """The lines of one frame."""
        lines = self.source.objects(frame)
        own = np.isin(lines.class_names, self.study.config.class_names) & lines.has_box3d
        return lines[np.flatnonzero(own)[self.standing[frame.id]]]


def _assessed(
    found: Sequence[Detections2D] | Sequence[Detections3D], frames: Sequence[int], verdict: Verdict
) -> Assessed:
    labels = np.concatenate([detections.labels for detections in found])
    scores = np.concatenate([detections.scores for detections in found])
    numbers = np.repeat(np.array(frames, dtype=np.int64), [len(detections) for detections in found])
    return Assessed(numbers, labels, scores, verdict.judged, verdict.right)


def _no_localizer(proposals: object) -> tuple[FloatArray, FloatArray]:
    raise AssertionError("calibration recovers nothing")


def open_study(request: RunRequest, folds: int = 5, progress: Progress = lambda indices: indices) -> CalibrationStudy:
    """Read frames, labels and the detections of both branches.

    Args:
        request: dataset, branches and settings, as for a run.
        folds: parts of the cross-validation.
        progress: wraps loops over frames, for a progress bar.

    Raises:
        Lcf3dError: something is absent, malformed or makes no sense; one sentence says what.
    """
    found = read_inputs(replace(request, recovery="off"), usual_frames)
    config = found.config.updated(ensemble="evidence", unmatched="downweight")
    evaluation = open_evaluation(found.dataset, found.frame_ids)
    frames = [found.dataset.frame(frame_id) for frame_id in found.frame_ids]
    lidar = [found.lidar.detect(frame) for frame in frames]
    camera = []
    for frame in frames:
        there = [c.name for c in frame.cameras if c.name in found.cameras and found.cameras[c.name].sees(frame, c.name)]
        camera.append({name: found.cameras[name].detect(frame, name) for name in there})
    drives = all(frame.sequence for frame in frames)
    names = tuple(f"{frame.sequence}_{frame.id}" if drives else frame.id for frame in frames)
    # the kind of each score map is chosen by cross-validation even where no report is asked for
    parts = block_folds(names, folds or 2)
    sources = (found.lidar, next(iter(found.cameras.values()), None))
    return CalibrationStudy(frames, evaluation, lidar, camera, config, parts, progress, sources)

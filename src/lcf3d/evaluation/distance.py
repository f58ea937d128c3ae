"""Evaluation by centre distance, for datasets without a protocol of their own: nuScenes' AP in the LiDAR frame.

AP is the mean over matching distances of 0.5, 1, 2 and 4 m; errors of position, size and heading are those of true
positives within 2 m; NDS^ sums them up (paper section 5.2). A 2D detection is right when its image IoU with the
projection of a labelled object of its class is above 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.datasets.base import Dataset
from lcf3d.errors import DatasetError
from lcf3d.evaluation.bootstrap import Interval, frame_weights
from lcf3d.evaluation.center_distance import matched_objects, resampled_aps
from lcf3d.evaluation.distance_study import (
    MIN_PRECISION,
    MIN_RECALL,
    THRESHOLDS_M,
    DistanceResults,
    distance_study,
    select,
)
from lcf3d.evaluation.generalization import (
    CLASS_RANGES,
    DEFAULT_RANGE,
    GeneralizationMetrics,
    evaluate_generalization,
    in_camera_view,
)
from lcf3d.evaluation.kitti_outcomes import read_provenance
from lcf3d.evaluation.protocol import ComparisonRow, EvaluationOptions, TableData, Verdict, refuse_options
from lcf3d.evaluation.study import Study
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.structures import Camera, Detections2D, Detections3D

RIGHT_M = 2.0
RIGHT_IOU = 0.5


class DistanceEvaluation:
    """AP by centre distance over frames of any dataset.

    Args:
        dataset: with labels.
        frame_ids: frames to evaluate, all without them.
        options: classes, and whether only the front camera's view counts.

    Raises:
        ConfigError: an option for other datasets.
        DatasetError: a frame has no labels.
    """

    heading = "AP by centre distance"
    columns: tuple[str, ...] = ("AP",)
    has_nds_hat = True

    def __init__(self, dataset: Dataset, frame_ids: Sequence[str] | None, options: EvaluationOptions) -> None:
        refuse_options("this dataset", options, "iou")
        self.dataset = dataset
        self.frame_ids = tuple(dataset.ids if frame_ids is None else frame_ids)
        self.class_names = options.classes or dataset.class_names
        self.front, self.nds_hat = options.front, options.nds_hat

    @cached_property
    def frames(self) -> list[Frame]:
        """The frames."""
        return [self.dataset.frame(frame_id) for frame_id in self.frame_ids]

    @cached_property
    def truth(self) -> list[Detections3D]:
        """Labels of the evaluated classes, of every frame."""
        labels = [(frame.id, frame.labels) for frame in self.frames]
        absent = [frame_id for frame_id, found in labels if found is None]
        if absent:
            raise DatasetError(
                f"{len(absent)} of {len(labels)} frames have no labels, first {absent[0]}: evaluation needs them"
            )
        known = [found.with_classes(self.class_names) for _, found in labels if found is not None]
        return [self._seen(found, f) for f, found in enumerate(known)]

    def _seen(self, found: Detections3D, frame: int) -> Detections3D:
        return in_camera_view(found, self._camera(frame)) if self.front else found

    def _camera(self, frame: int) -> Camera:
        return self.frames[frame].camera(self.dataset.used_cameras[0])

    def results(self, found: Sequence[Detections3D]) -> DistanceResults:
        """Labels and detections in the evaluated classes."""
        ranges = np.array([CLASS_RANGES.get(name, DEFAULT_RANGE) for name in self.class_names], dtype=np.float64)
        kept = [self._seen(own.with_classes(self.class_names), f) for f, own in enumerate(found)]
        return DistanceResults(tuple(self.class_names), ranges, self.truth, kept)

    def metrics(self, found: Sequence[Detections3D]) -> GeneralizationMetrics:
        """All numbers of detections by frame."""
        cameras = [self._camera(f) for f in range(len(self.frames))] if self.front else None
        return evaluate_generalization(self.truth, found, class_names=self.class_names, cameras=cameras)

    def figures(self, results: Sequence[Detections3D]) -> dict[str, tuple[float, ...]]:
        """AP of every class, percent; NaN for classes without labels."""
        metrics = self.metrics(results)
        rows = zip(metrics.class_names, metrics.aps, metrics.ground_truth_counts, strict=True)
        return {name: (100 * float(aps.mean()) if count else float("nan"),) for name, aps, count in rows}

    def judge_lidar(self, found: Sequence[Detections3D], source: Any = None) -> Verdict:
        """3D detections: right when they take a labelled object of their class within 2 m."""
        results = self.results(found)
        names = found[0].class_names if len(found) else ()
        if tuple(names) != results.class_names:
            found = [own.with_classes(results.class_names) for own in found]
        (truth, truth_near), (boxes, near) = results.joined(self.truth), results.joined(found)
        rows = np.flatnonzero(near)
        right = np.zeros(len(boxes))
        kept = select(truth, truth_near)
        right[rows] = matched_objects(kept, select(boxes, rows), len(results.class_names), RIGHT_M) >= 0
        return Verdict(near, right)

    def judge_camera(self, found: Sequence[Mapping[str, Detections2D]], source: Any = None) -> Verdict:
        """2D detections: right when they take the projection of a labelled object of their class."""
        right = []
        for frame, labels, seen in zip(self.frames, self.truth, found, strict=True):
            for name, detections in seen.items():
                right.append(_right_in_image(labels, detections, frame.camera(name)))
        joined = np.concatenate(right) if right else np.zeros(0)
        return Verdict(np.ones(len(joined), dtype=bool), joined)

    def read(self, path: Path, name: str, missing: str = "error") -> DistanceResultSet:
        """Result files in the form of the dataset.

        Raises:
            Lcf3dError: they are not there, or not in that form.
        """
        source = self.dataset.lidar_results(path, self.class_names, missing)
        if hasattr(source, "load"):
            source.load(self.frame_ids)
        return DistanceResultSet(name, path, self, [source.detect(frame) for frame in self.frames])

    def compare(
        self, first: DistanceResultSet, second: DistanceResultSet, samples: int, seed: int
    ) -> list[ComparisonRow]:
        """AP of every labelled class and their mean."""
        weights = frame_weights(len(self.frame_ids), samples, seed)
        once = np.ones((1, len(self.frame_ids)), dtype=np.int64)
        return compare_aps(*(self._drawn(one, np.concatenate([once, weights])) for one in (first, second)))

    def _drawn(self, results: DistanceResultSet, weights: Any) -> dict[str, Any]:
        """(1 + B,) AP of every class, percent: as it is, then of each resample."""
        one = self.results(results.found)
        (truth, truth_near), (boxes, near) = one.joined(one.truth), one.joined(one.found)
        kept, count = select(truth, truth_near), len(one.class_names)
        aps = resampled_aps(kept, select(boxes, near), count, THRESHOLDS_M, weights, MIN_RECALL, MIN_PRECISION)
        there = np.bincount(kept.labels, minlength=count)
        return {name: 100 * aps[:, c].mean(axis=1) for c, name in enumerate(one.class_names) if there[c]}


def compare_aps(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[ComparisonRow]:
    """Rows of two result sets: (1 + B,) AP by class, the value itself and then its resamples; and their mean."""
    columns = {name: (first[name], second[name]) for name in first if name in second}
    if columns:
        columns["mean"] = tuple(np.nanmean([pair[i] for pair in columns.values()], axis=0) for i in range(2))  # type: ignore[assignment]
    return [
        ComparisonRow(name, "AP", "", *(Interval.of(v[0], v[1:]) for v in (a, b, b - a)))
        for name, (a, b) in columns.items()
    ]


@dataclass(frozen=True, eq=False)
class DistanceResultSet:
    """Results measured by centre distance.

    Attributes:
        name: what to call them.
        path: where they were read from.
        evaluation: of the same frames.
        found: detections by frame.
    """

    name: str
    path: Path
    evaluation: DistanceEvaluation
    found: list[Detections3D]

    @cached_property
    def metrics(self) -> GeneralizationMetrics:
        """All numbers."""
        return self.evaluation.metrics(self.found)

    def to_json(self) -> dict[str, Any]:
        """The numbers by name."""
        return self.metrics.to_json()

    def tables(self) -> list[TableData]:
        """AP and errors by class, and NDS^."""
        metrics = self.metrics
        rows: list[tuple[str, ...] | None] = []
        for name, aps, errors, count in zip(
            metrics.class_names, metrics.aps, metrics.class_errors, metrics.ground_truth_counts, strict=True
        ):
            values = (f"{100 * v:.2f}" for v in (aps.mean(), *aps))
            rows.append((name, *values, *("-" if np.isnan(e) else f"{e:.3f}" for e in errors), str(count)))
        means = (f"{100 * metrics.mean_ap:.2f}", *(f"{100 * v:.2f}" for v in metrics.aps.mean(axis=0)))
        total = sum(metrics.ground_truth_counts)
        rows += [None, ("mean", *means, *(f"{v:.3f}" for v in metrics.errors.values()), str(total))]
        columns = ("class", "AP", *(f"{d:g}m" for d in metrics.distances), "ATE", "ASE", "AOE", "labels")
        title = f"{self.name}, {len(self.found)} frames"
        note = f"NDS^ {100 * metrics.nds_hat:.2f}; AP in percent by matching distance; errors in m, 1 - IoU, rad"
        return [TableData(title, columns, rows, (note,))]

    def study(self) -> Study:
        """A closer look, split by what the fusion did where its provenance lies beside the results."""
        evaluation = self.evaluation
        folder = self.path.parent if self.path.name == "data" else self.path
        return distance_study(
            evaluation.results(self.found),
            name=self.name,
            heading=evaluation.heading,
            frame_ids=evaluation.frame_ids,
            metrics=self.to_json(),
            provenance=read_provenance(folder, evaluation.frame_ids),
            camera_of=lambda f: next(iter(evaluation.frames[f].cameras), None),
        )


def _right_in_image(labels: Detections3D, found: Detections2D, camera: Camera) -> Any:
    """(N,) 1 for 2D detections that take a labelled object, best score first, else 0."""
    projected, visible = project_boxes(labels.boxes, camera)
    right = np.zeros(len(found))
    overlap = image_iou(found.boxes, projected[visible])
    same = np.array([[f == t for t in _names(labels)[visible]] for f in _names(found)], dtype=bool)
    overlap = np.where(same.reshape(overlap.shape), overlap, 0)
    for row in np.argsort(-found.scores, kind="stable"):
        if overlap.shape[1] and overlap[row].max() > RIGHT_IOU:
            overlap[:, int(overlap[row].argmax())] = 0
            right[row] = 1
    return right


def _names(detections: Detections2D | Detections3D) -> Any:
    return np.array(detections.class_names, dtype=np.str_)[detections.labels]

"""KITTI's official protocol as an evaluation of the verbs: see `lcf3d.evaluation.protocol`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lcf3d.errors import ConfigError, DatasetError
from lcf3d.evaluation.bootstrap import Interval, frame_weights, resampled_ap
from lcf3d.evaluation.curves import SAMPLES
from lcf3d.evaluation.kitti import (
    DIFFICULTIES,
    MEASURE_NAMES,
    KittiEvaluationConfig,
    KittiEvaluator,
    KittiMetrics,
    Selection,
    evaluate,
    result_folder,
    split_frame_ids,
)
from lcf3d.evaluation.kitti_breakdown import compare
from lcf3d.evaluation.kitti_matching import FALSE_POSITIVE, TRUE_POSITIVE
from lcf3d.evaluation.kitti_outcomes import read_provenance
from lcf3d.evaluation.kitti_study import study
from lcf3d.evaluation.protocol import ComparisonRow, EvaluationOptions, TableData, Verdict, refuse_options
from lcf3d.evaluation.study import Study
from lcf3d.files import list_files
from lcf3d.formats.kitti import (
    NO_ANGLE,
    KittiFrames,
    KittiObjects,
    objects_from_detections,
    objects_from_detections_2d,
    read_folder,
)
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Detections2D, Detections3D, FloatArray

Measure = Literal["3d", "bbox"]

# pixels; lower boxes are ignored at every difficulty
LEAST_HEIGHT = 25


class KittiEvaluation:
    """KITTI's metrics over frames of a KITTI layout.

    Args:
        dataset: a `KittiDataset`.
        frame_ids: frames to evaluate; those of the dataset's split without them, which is ``val`` where there is one.
        options: classes and IoU thresholds.

    Raises:
        ConfigError: an unknown class, measure or threshold, or an option for other datasets.
        DatasetError: labels are missing.
    """

    heading = "3D AP R40"
    columns = DIFFICULTIES

    def __init__(self, dataset: Any, frame_ids: Sequence[str] | None, options: EvaluationOptions) -> None:
        refuse_options("KITTI", options, "front")
        self.dataset: Any = dataset
        self.config = kitti_config(options.classes, options.iou)
        self.class_names = self.config.classes
        self.frame_ids = tuple(self._usual_frames() if frame_ids is None else frame_ids)
        self.truth = self._labels()

    def _usual_frames(self) -> Sequence[str]:
        """The frames that are evaluated unless others are asked for."""
        if self.dataset.split is None:
            return split_frame_ids(self.dataset.root)
        ids: tuple[str, ...] = self.dataset.ids
        return ids

    def _labels(self) -> KittiFrames:
        labels = self.dataset.folder / "label_2"
        if not labels.is_dir():
            raise DatasetError(f"{labels} is not a folder; expected a KITTI tree with label_2 in {labels.parent}")
        return read_folder(labels, self.frame_ids, results=False)

    @cached_property
    def _frames(self) -> list[Frame]:
        return [self.dataset.frame(frame_id) for frame_id in self.frame_ids]

    def figures(self, results: Sequence[Detections3D]) -> dict[str, tuple[float, ...]]:
        """3D AP R40 easy, moderate and hard by class."""
        objects = [result_objects(frame, found) for frame, found in zip(self._frames, results, strict=True)]
        metrics = evaluate(self.truth, KittiFrames.from_frames(self.frame_ids, objects), self.config)
        return {name: tuple(metrics.ap(name, "3d", d) for d in DIFFICULTIES) for name in self.class_names}

    def differences(
        self, first: Sequence[Detections3D], second: Sequence[Detections3D], samples: int, seed: int = 0
    ) -> dict[str, Interval]:
        """How much the moderate 3D AP of each class is higher in ``second``, with intervals over frames drawn again."""
        own, other = (self.resampled(results, samples, seed) for results in (first, second))
        return {
            name: Interval.of((other[name] - own[name])[0], (other[name] - own[name])[1:]) for name in self.class_names
        }

    def resampled(self, results: Sequence[Detections3D], samples: int, seed: int = 0) -> dict[str, FloatArray]:
        """(1 + samples,) moderate 3D AP of each class: on the frames as they are, then on frames drawn again."""
        once = np.ones((1, len(self.frame_ids)), dtype=np.int64)
        weights = np.concatenate([once, frame_weights(len(self.frame_ids), samples, seed)])
        objects = [result_objects(frame, found) for frame, found in zip(self._frames, results, strict=True)]
        evaluator = KittiEvaluator(self.truth, KittiFrames.from_frames(self.frame_ids, objects), self.config)
        events = {name: evaluator.events(Selection(name, "3d", "moderate")) for name in self.class_names}
        return {name: resampled_ap(one, weights)[0] for name, one in events.items()}

    def judge_lidar(self, found: Sequence[Detections3D], source: Any = None) -> Verdict:
        """3D detections at the official IoU, ``hard``; lines of result files are taken as they are."""
        lines = [
            _of_classes(source.objects(frame), own.class_names, in_3d=True)
            if hasattr(source, "objects")
            else result_objects(frame, own, everything=True)
            for frame, own in zip(self._frames, found, strict=True)
        ]
        return self._judge(lines, "3d", [(own.labels, own.class_names) for own in found])

    def judge_camera(self, found: Sequence[Mapping[str, Detections2D]], source: Any = None) -> Verdict:
        """2D detections of the left camera at the official IoU, ``hard``; KITTI labels no other camera."""
        left = self.dataset.used_cameras[0]
        own = [seen.get(left, Detections2D.empty(self.class_names)) for seen in found]
        lines = [
            _of_classes(source.objects(frame), seen.class_names, in_3d=False)
            if hasattr(source, "objects")
            else objects_from_detections_2d(seen)
            for frame, seen in zip(self._frames, own, strict=True)
        ]
        verdict = self._judge(lines, "bbox", [(seen.labels, seen.class_names) for seen in own])
        others = [np.zeros(len(d), dtype=bool) for seen in found for name, d in seen.items() if name != left]
        if not any(len(other) for other in others):
            return verdict
        parts, start = [], 0
        for seen in found:
            for name, detections in seen.items():
                n = len(detections)
                parts.append((verdict.judged[start : start + n], verdict.right[start : start + n]))
                if name != left:
                    parts[-1] = (np.zeros(n, dtype=bool), np.zeros(n))
                else:
                    start += n
        return Verdict(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _judge(
        self, lines: list[KittiObjects], measure: Measure, labels: Sequence[tuple[Any, tuple[str, ...]]]
    ) -> Verdict:
        results = KittiFrames.from_frames(self.frame_ids, lines)
        evaluator = KittiEvaluator(self.truth, results, self.config)
        names = np.array([n[label] for own, n in labels for label in own.tolist()], dtype=np.str_)
        judged, right = np.zeros(len(names), dtype=bool), np.zeros(len(names))
        for name in self.class_names:
            own = names == name
            if not own.any():
                continue
            _, outcomes = evaluator.match_at(Selection(name, measure, "hard"), -np.inf)
            judged[own] = np.isin(outcomes[own], [TRUE_POSITIVE, FALSE_POSITIVE])
            right[own] = outcomes[own] == TRUE_POSITIVE
        return Verdict(judged, right)

    def read(self, path: Path, name: str, missing: str = "error") -> KittiResultSet:
        """KITTI result files of the frames.

        Raises:
            DatasetError: a file or folder is absent; for frames, says how many and which first.
            FormatError: a file is malformed; names file and line.
        """
        folder = result_folder(path)
        kept: Literal["error", "empty"] = "empty" if missing == "empty" else "error"
        results = read_folder(folder, self.frame_ids, results=True, missing=kept)
        known = set(self.frame_ids)
        others = sorted(p.stem for p in list_files(folder, ".txt") if p.stem not in known)
        notes = []
        if others:
            notes.append(
                f"{len(others)} result files in {folder} are of frames outside the split, first {others[0]}.txt; "
                "they are left out"
            )
        notes += _why_nothing_counts(results.objects)
        evaluator = KittiEvaluator(self.truth, results, self.config)
        return KittiResultSet(name, path, evaluator, self.dataset, tuple(notes))

    def compare(self, first: KittiResultSet, second: KittiResultSet, samples: int, seed: int) -> list[ComparisonRow]:
        """Every class, measure and difficulty that both result sets cover."""
        return compare(first.evaluator, second.evaluator, samples, seed)


class KittiTrackingEvaluation(KittiEvaluation):
    """The object benchmark's metrics over the frames of a tracking layout, a `KittiTrackingDataset`."""

    def _usual_frames(self) -> Sequence[str]:
        """All frames of labelled sequences."""
        return [frame_id for frame_id in self.dataset.ids if self.dataset.place(frame_id)[0].has_labels]

    def _labels(self) -> KittiFrames:
        places = [self.dataset.place(frame_id) for frame_id in self.frame_ids]
        absent = [drive.name for drive, _ in places if not drive.has_labels]
        if absent or not places:
            first = f", first {absent[0]}" if absent else ""
            raise DatasetError(f"{len(absent)} frames of {self.dataset.root} are of sequences without labels{first}")
        return KittiFrames.from_frames(self.frame_ids, [drive.objects(number) for drive, number in places])


@dataclass(frozen=True, eq=False)
class KittiResultSet:
    """KITTI results, measured.

    Attributes:
        name: what to call them.
        path: where they were read from.
        evaluator: ground truth and results.
        dataset: the frames.
        notes: what was left out.
    """

    name: str
    path: Path
    evaluator: KittiEvaluator
    dataset: Any
    notes: tuple[str, ...]

    @cached_property
    def metrics(self) -> KittiMetrics:
        """The official curves."""
        return self.evaluator.metrics()

    def to_json(self) -> dict[str, Any]:
        """Every AP by class, measure and difficulty."""
        config = self.metrics.config
        return {
            "min_overlap": {name: dict(config.min_overlap[name]) for name in config.classes},
            **self.metrics.to_json(),
        }

    def tables(self) -> list[TableData]:
        """AP R40 and R11 by class, measure and difficulty."""
        metrics = self.metrics
        columns = ("class", "", "IoU", *(f"{d}\n{s}" for s in ("R40", "R11") for d in DIFFICULTIES))
        rows: list[tuple[str, ...] | None] = []
        for class_name in metrics.class_names:
            for number, measure in enumerate(metrics.measures(class_name)):
                threshold = metrics.config.min_overlap[class_name]["bbox" if measure == "aos" else measure]
                values = (
                    f"{metrics.ap(class_name, measure, d, s):.2f}"
                    for s in ("R40", "R11")  # type: ignore[arg-type]
                    for d in DIFFICULTIES
                )
                rows.append(("" if number else class_name, MEASURE_NAMES[measure], f"{threshold:g}", *values))
        title = f"KITTI, {metrics.frame_count} frames, AP in percent"
        return [TableData(title, columns, rows, (*_remarks(metrics), *self.notes))]

    def study(self) -> Study:
        """A closer look, split by what the fusion did where its provenance lies beside the results."""
        folder = self.path.parent if self.path.name == "data" else self.path
        provenance = read_provenance(folder, self.evaluator.truth.frame_ids)
        return study(
            self.evaluator,
            self.name,
            self.to_json(),
            provenance,
            self._camera_from_lidar,
        )

    def _camera_from_lidar(self, frame_id: str) -> FloatArray:
        """Of the calibration; without one, axes that point as KITTI's do."""
        try:
            transform: FloatArray = self.dataset.calibration(frame_id).camera_from_lidar
        except DatasetError:
            return np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
        return transform


def _remarks(metrics: KittiMetrics) -> list[str]:
    """What a reader of the table should know."""
    remarks = []
    absent = [name for name in metrics.config.classes if name not in metrics.class_names]
    if absent:
        remarks.append(f"no detections of {', '.join(absent)}: not evaluated, as in the official program")
    few = []
    for name in metrics.class_names:
        measure = metrics.measures(name)[0]
        counts = [metrics.curves[name, measure, difficulty].object_count for difficulty in DIFFICULTIES]
        if min(counts) < SAMPLES:
            few.append(f"{name} {' / '.join(map(str, counts))}")
    if few:
        remarks.append(
            f"objects, {' / '.join(DIFFICULTIES)}: {', '.join(few)}; with fewer than {SAMPLES} the official sampling "
            "cannot reach 100"
        )
    return remarks


def kitti_config(classes: Sequence[str], iou: Sequence[str]) -> KittiEvaluationConfig:
    """The benchmark's numbers, changed by ``--class`` and ``--iou`` values.

    Raises:
        ConfigError: an unknown class or measure, or a threshold that is no number in [0, 1).
    """
    config = KittiEvaluationConfig()
    if classes:
        config = replace(config, classes=tuple(dict.fromkeys(classes)))
    for item in iou:
        target, equals, text = item.partition("=")
        class_name, _, measure = target.partition(":")
        try:
            value = float(text)
        except ValueError:
            equals = ""
        if not equals:
            raise ConfigError(f"--iou takes CLASS=VALUE or CLASS:MEASURE=VALUE, for example Car=0.5, got {item!r}")
        config = config.with_min_overlap(class_name, value, measure or None)
    return config


def result_objects(frame: Frame, detections: Detections3D, everything: bool = False) -> KittiObjects:
    """KITTI result lines of 3D detections, 2D boxes projected into the frame's first camera.

    Detections out of its view are left out, unless ``everything`` is asked for: their 2D boxes are zeros.
    """
    view = frame.cameras[0]
    projected, visible = project_boxes(detections.boxes, view)
    if everything:
        visible = np.ones(len(visible), dtype=bool)
    return objects_from_detections(detections[visible], projected[visible], view.camera_from_lidar)


def _of_classes(lines: KittiObjects, class_names: Sequence[str], in_3d: bool) -> KittiObjects:
    """The lines that become detections: of these classes, and with a 3D box where that matters."""
    kept = np.isin(lines.class_names, list(class_names))
    return lines[kept & lines.has_box3d] if in_3d else lines[kept]


def _why_nothing_counts(found: KittiObjects) -> list[str]:
    """What makes the official program pass over all detections, one sentence each; nothing where some count."""
    if not len(found):
        return ["the result files hold no detections at all: every AP is 0"]
    notes = []
    heights = found.boxes2d[:, 3] - found.boxes2d[:, 1]
    if not heights.any():
        notes.append(
            "no detection has a 2D box: the official program takes all of them as too low to count, so every AP is 0; "
            "write the projections of the 3D boxes into columns 5 to 8"
        )
    elif (heights < LEAST_HEIGHT).all():
        notes.append(f"all 2D boxes are lower than {LEAST_HEIGHT} pixels, which the official program does not count")
    if not found.has_box3d.any():
        notes.append("no detection has a 3D box: BEV and 3D are not evaluated")
    elif (found.rotation_y == NO_ANGLE).all():
        notes.append("rotation_y of all detections is -10, which means unknown: BEV and 3D overlaps are wrong")
    if (found.alpha == NO_ANGLE).all():
        notes.append("alpha of all detections is -10, which means unknown: orientation (AOS) is not evaluated")
    return notes

"""Tracks on KITTI's tracking labels, by 3D overlap, with the benchmark's rules on what does not count.

Objects that are truncated or largely hidden, and neighbouring classes (vans for cars, sitting people), are neither
misses nor hits; outputs on them, in DontCare regions or less than 25 pixels high are no false alarms.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from lcf3d.datasets.kitti_sequences import sequence_of
from lcf3d.errors import DatasetError, FormatError
from lcf3d.evaluation.protocol import EvaluationOptions, TableData, frames_note, tracked_classes
from lcf3d.evaluation.tracking import Averaged, Clear, Hota, TrackedFrames, averaged, clear, hota, track_scores
from lcf3d.files import list_files
from lcf3d.formats.kitti import KittiObjects
from lcf3d.formats.kitti_tracking import TrackedObjects, read_tracks
from lcf3d.geometry.boxes import lidar_from_kitti
from lcf3d.geometry.iou import image_area, image_iou, iou_3d
from lcf3d.structures import FloatArray, IntArray

CLASSES = ("Car", "Pedestrian", "Cyclist")
NEIGHBOURS = {"Car": "Van", "Pedestrian": "Person_sitting"}
MIN_OVERLAP = 0.25
MIN_HEIGHT_PX = 25.0
MAX_OCCLUSION = 2
MAX_TRUNCATION = 0.0
# share of an output's image box within a DontCare region that excuses it
DONTCARE_SHARE = 0.5
# a frame of axes that turn as the LiDAR's, for overlaps
_CAMERA_FROM_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


class TrackingMetrics(NamedTuple):
    """Measures of one class.

    Attributes:
        averaged: over the recall, and at the best operating point.
        clear: CLEAR MOT at that point, with matches kept from frame to frame.
        hota: at that point.
    """

    averaged: Averaged
    clear: Clear
    hota: Hota

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values, percent and counts."""
        best = self.averaged.best
        return {
            "sAMOTA": self.averaged.samota,
            "AMOTA": self.averaged.amota,
            "AMOTP": self.averaged.amotp,
            "MOTA": best.mota,
            "MOTP": best.motp,
            "switches": best.switches,
            "fragments": best.fragments,
            "threshold": self.averaged.threshold,
            "objects": best.objects,
            "CLEAR": {"MOTA": self.clear.mota, "MOTP": self.clear.motp, **self.clear._asdict()},
            "HOTA": self.hota.hota,
            "DetA": self.hota.deta,
            "AssA": self.hota.assa,
            "LocA": self.hota.loca,
        }


class KittiTracking:
    """Tracks on KITTI's tracking labels, ``training/label_02/SEQUENCE.txt``.

    Args:
        dataset: a KITTI layout with these labels whose frame ids read ``SEQUENCE_FRAME``.
        frame_ids: frames that count; without them all of the sequences that have results.
        options: classes.

    Raises:
        ConfigError: an unknown class, or an option for other evaluations.
        DatasetError: there are no tracking labels.
    """

    def __init__(self, dataset: Any, frame_ids: Sequence[str] | None, options: EvaluationOptions) -> None:
        self.classes = tracked_classes(options, CLASSES, "it measures")
        self.labels = dataset.root / "training" / "label_02"
        if not self.labels.is_dir():
            raise DatasetError(
                "--tracking needs KITTI's tracking labels, ROOT/training/label_02/SEQUENCE.txt, and "
                f"{dataset.root} has none"
            )
        self.frames = None if frame_ids is None else _by_sequence(frame_ids)
        self._every = _every_frame(dataset)

    def read(self, path: Path, missing: str = "error") -> KittiTracks:
        """A folder of ``SEQUENCE.txt`` tracking results, or a run folder with ``tracks``, measured.

        Raises:
            DatasetError: a folder or file is missing, or results are of sequences or frames that are not there.
            FormatError: a line is malformed, or labels have no track numbers.
        """
        folder = path / "tracks" if (path / "tracks").is_dir() else path
        names = self._sequences(folder, missing)
        truths = {name: self._truth(name) for name in names}
        whole = {name: self._whole(name, truth) for name, truth in truths.items()}
        pairs = {name: (truths[name], self._found(folder, name, whole[name], missing)) for name in names}
        chosen = {name: None if self.frames is None else self.frames[name] for name in names}
        metrics = {}
        for own in self.classes:
            prepared = [prepare(*pairs[name], own, chosen[name]) for name in names]
            over_recall = averaged(prepared, MIN_OVERLAP)
            kept = [sequence.above(over_recall.threshold) for sequence in prepared]
            metrics[own] = TrackingMetrics(over_recall, clear(kept, MIN_OVERLAP), hota(kept))
        counted = {name: len(whole[name] if frames is None else frames) for name, frames in chosen.items()}
        return KittiTracks(metrics, counted, {name: len(frames) for name, frames in whole.items()})

    def _sequences(self, folder: Path, missing: str) -> tuple[str, ...]:
        """Names of the sequences to measure."""
        if not folder.is_dir():
            raise DatasetError(f"{folder} is not a folder; expected KITTI tracking files SEQUENCE.txt")
        there = [path.stem for path in list_files(folder, ".txt")]
        if not there:
            raise DatasetError(
                f"{folder} holds no tracking results SEQUENCE.txt; 'lcf3d run --memory' on sequences writes them"
            )
        wanted = sorted(there) if self.frames is None else sorted(self.frames)
        unlabelled = [name for name in wanted if not (self.labels / f"{name}.txt").is_file()]
        if unlabelled:
            raise DatasetError(
                f"{len(unlabelled)} of {len(wanted)} sequences have no labels in {self.labels}, the first is "
                f"{unlabelled[0]}; are these results of other sequences?"
            )
        absent = [name for name in wanted if name not in there]
        if absent and (missing == "error" or len(absent) == len(wanted)):
            raise DatasetError(
                f"{folder} lacks the tracks of {len(absent)} of {len(wanted)} sequences, the first is {absent[0]}"
                + ("; --missing empty takes them as sequences without tracks" if missing == "error" else "")
            )
        return tuple(wanted)

    def _truth(self, name: str) -> TrackedObjects:
        path = self.labels / f"{name}.txt"
        truth = read_tracks(path, False)
        of_class = np.isin(truth.objects.class_names, self.classes)
        if of_class.any() and (truth.ids[of_class] < 0).all():
            raise FormatError(
                f"{path} gives its objects no track numbers (all are below 0), so tracks cannot be measured"
            )
        return truth

    def _whole(self, name: str, truth: TrackedObjects) -> frozenset[int]:
        """Numbers of all frames of a sequence: those of the dataset, else as far as labels go."""
        labelled = frozenset(range(int(truth.frames.max(initial=-1)) + 1))
        return self._every.get(name, labelled)

    def _found(self, folder: Path, name: str, whole: frozenset[int], missing: str) -> TrackedObjects:
        path = folder / f"{name}.txt"
        if not path.is_file() and missing == "empty":
            none = np.zeros(0, dtype=np.int64)
            return TrackedObjects(none, none, KittiObjects.empty(results=True))
        found = read_tracks(path, True)
        strange = np.setdiff1d(found.frames, list(whole))
        if len(strange):
            raise DatasetError(
                f"{path} holds {len(strange)} frames that sequence {name} does not have, the first is {strange[0]}; is "
                "it of another sequence?"
            )
        nameless = np.isin(found.objects.class_names, self.classes) & (found.ids < 0)
        if nameless.any():
            raise FormatError(f"{path} holds {int(nameless.sum())} boxes without a track number (below 0)")
        return found


class KittiTracks(NamedTuple):
    """Tracks of KITTI's sequences, measured.

    Attributes:
        metrics: by class.
        counted: by sequence, how many frames count.
        frames: by sequence, how many there are.
    """

    metrics: dict[str, TrackingMetrics]
    counted: dict[str, int]
    frames: dict[str, int]

    def to_json(self) -> dict[str, Any]:
        """Measures by class, and the frames that count."""
        return {**{name: one.to_json() for name, one in self.metrics.items()}, "frames": self.counted}

    def table(self) -> TableData:
        """A row a class."""
        columns = ("class", "objects", "sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "switches", "HOTA", "DetA", "AssA")
        rows: list[tuple[str, ...] | None] = []
        for name, one in self.metrics.items():
            best, over = one.averaged.best, one.averaged
            values = (over.samota, over.amota, over.amotp, best.mota, best.motp)
            parts = (one.hota.hota, one.hota.deta, one.hota.assa)
            cells = [*(f"{v:.2f}" for v in values), str(best.switches), *(f"{v:.2f}" for v in parts)]
            rows.append((name, str(best.objects), *cells))
        where = "3D IoU 0.25; MOTA, MOTP, switches and HOTA at the threshold of the best MOTA on these very frames"
        covered = frames_note(sum(self.counted.values()), sum(self.frames.values()), len(self.counted), "sequence")
        return TableData("tracks, percent", columns, rows, (where, covered))


def _every_frame(dataset: Any) -> dict[str, frozenset[int]]:
    """Numbers of all frames by sequence, whatever the split; none where there are labels and nothing else."""
    try:
        return _by_sequence(dataset.ids if dataset.split is None else type(dataset)(dataset.root).ids)
    except DatasetError:
        return {}


def _by_sequence(frame_ids: Sequence[str]) -> dict[str, frozenset[int]]:
    """Numbers of frames by sequence.

    Raises:
        DatasetError: an id does not tell sequence and frame.
    """
    frames: dict[str, list[int]] = {}
    for frame_id in frame_ids:
        sequence, number = sequence_of(frame_id)
        if sequence is None:
            raise DatasetError(f"frame {frame_id} is of no sequence; tracks need ids that read SEQUENCE_FRAME")
        frames.setdefault(sequence, []).append(number)
    return {sequence: frozenset(numbers) for sequence, numbers in frames.items()}


def prepare(
    truth: TrackedObjects, found: TrackedObjects, class_name: str, only: Collection[int] | None = None
) -> TrackedFrames:
    """One class of one sequence, what does not count left out.

    Scores are those of whole tracks, the mean over their boxes.

    Args:
        truth: labels of the sequence.
        found: results.
        class_name: the class.
        only: numbers of the frames that count; all without them.
    """
    numbers = np.unique(np.concatenate([truth.frames, found.frames]))
    if only is not None:
        numbers = numbers[np.isin(numbers, list(only))]
    of_class = (found.objects.class_names == class_name) & np.isin(found.frames, numbers)
    frames = []
    for number in numbers:
        rows = np.flatnonzero(truth.frames == number)
        own = np.flatnonzero((found.frames == number) & of_class)
        frames.append(
            _prepare_frame(truth.ids[rows], truth.objects[rows], found.ids[own], found.objects[own], class_name)
        )
    ids = [frame[1] for frame in frames]
    # a track's score is that of all its boxes, those that do not count included
    every = found.ids[of_class]
    scores = found.objects.scores if found.objects.scores is not None else np.ones(len(found))
    mean = dict(zip(every.tolist(), track_scores([every], [scores[of_class]])[0].tolist(), strict=True))
    return TrackedFrames(
        [frame[0] for frame in frames],
        ids,
        [np.array([mean[int(track)] for track in own]) for own in ids],
        [frame[2] for frame in frames],
    )


def _prepare_frame(
    truth_ids: IntArray, truth: KittiObjects, ids: IntArray, found: KittiObjects, class_name: str
) -> tuple[IntArray, IntArray, FloatArray]:
    """Tracks of the objects and outputs of one frame that count, and their overlaps."""
    neighbour = truth.class_names == NEIGHBOURS.get(class_name, "")
    objects = np.flatnonzero(((truth.class_names == class_name) | neighbour) & (truth_ids >= 0))
    hard = (truth.occluded > MAX_OCCLUSION) | (truth.truncated > MAX_TRUNCATION) | neighbour
    overlaps = iou_3d(_boxes(truth[objects]), _boxes(found))
    gain = np.where(overlaps >= MIN_OVERLAP, overlaps, 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    good = gain[rows, columns] > 0
    taken = np.zeros(len(ids), dtype=bool)
    taken[columns[good]] = True
    excused = np.zeros(len(ids), dtype=bool)
    excused[columns[good]] = hard[objects[rows[good]]]
    height = found.boxes2d[:, 3] - found.boxes2d[:, 1]
    regions = truth.boxes2d[truth.class_names == "DontCare"]
    excused |= ~taken & ((height <= MIN_HEIGHT_PX) | (_share_within(found.boxes2d, regions) > DONTCARE_SHARE))
    counts = ~hard[objects]
    return truth_ids[objects[counts]], ids[~excused], overlaps[np.ix_(counts, ~excused)]


def _share_within(boxes: FloatArray, regions: FloatArray) -> FloatArray:
    """(N,) largest share of each image box that lies in one region."""
    if not len(regions):
        return np.zeros(len(boxes))
    iou, area, other = image_iou(boxes, regions), image_area(boxes)[:, None], image_area(regions)[None]
    shared = iou * (area + other) / (1 + iou)
    return np.asarray((shared / np.maximum(area, 1e-9)).max(axis=1))


def _boxes(objects: KittiObjects) -> FloatArray:
    """(N, 7) canonical boxes of KITTI objects, in axes that turn as the LiDAR's."""
    return lidar_from_kitti(objects.locations, objects.dimensions, objects.rotation_y, _CAMERA_FROM_AXES)

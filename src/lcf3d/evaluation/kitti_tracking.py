"""Tracks on KITTI's tracking labels, by 3D overlap, with the benchmark's rules on what does not count.

Objects that are truncated or largely hidden, and neighbouring classes (vans for cars, sitting people), are neither
misses nor hits; outputs on them, in DontCare regions or less than 25 pixels high are no false alarms.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from lcf3d.errors import DatasetError
from lcf3d.evaluation.tracking import Averaged, Clear, Hota, TrackedFrames, averaged, clear, hota, track_scores
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


def evaluate_tracks(
    labels: Path, results: Path, sequences: Sequence[str] = (), classes: Sequence[str] = CLASSES
) -> dict[str, TrackingMetrics]:
    """Measures of each class over the sequences.

    Args:
        labels: folder of ``SEQ.txt`` tracking labels.
        results: folder of ``SEQ.txt`` tracking results.
        sequences: those to evaluate; without, all that have results.
        classes: classes to evaluate.

    Raises:
        DatasetError: a folder or file is missing.
        FormatError: a line is malformed.
    """
    for folder in (labels, results):
        if not Path(folder).is_dir():
            raise DatasetError(f"{folder} is not a folder; expected KITTI tracking files SEQ.txt")
    names = tuple(sequences) or tuple(sorted(path.stem for path in Path(results).glob("*.txt")))
    if not names:
        raise DatasetError(f"{results} holds no tracking results SEQ.txt")
    pairs = [
        (read_tracks(Path(labels) / f"{name}.txt", False), read_tracks(Path(results) / f"{name}.txt", True))
        for name in names
    ]
    metrics = {}
    for name in classes:
        prepared = [prepare(truth, found, name) for truth, found in pairs]
        over_recall = averaged(prepared, MIN_OVERLAP)
        chosen = [sequence.above(over_recall.threshold) for sequence in prepared]
        metrics[name] = TrackingMetrics(over_recall, clear(chosen, MIN_OVERLAP), hota(chosen))
    return metrics


def prepare(truth: TrackedObjects, found: TrackedObjects, class_name: str) -> TrackedFrames:
    """One class of one sequence, what does not count left out.

    Scores are those of whole tracks, the mean over their boxes.
    """
    of_class = found.objects.class_names == class_name
    numbers = np.unique(np.concatenate([truth.frames, found.frames]))
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

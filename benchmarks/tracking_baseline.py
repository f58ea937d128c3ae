"""The AB3DMOT rule (Weng et al., IROS 2020) on LiDAR detections alone, to compare tracks with those of the memory.

    python benchmarks/tracking_baseline.py kitti:ROOT ROOT/results/pointrcnn OUT --sequences 0001 0006 0008 0010
    lcf3d eval kitti:ROOT OUT --tracking

Written from the paper: a Kalman filter with constant velocity in sensor coordinates, state (x, y, z, yaw, l, w, h) and
velocity, assigned by 3D IoU of at least 0.01, a track is reported from its third hit on and dropped after two misses.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_results import KittiLidarResults
from lcf3d.formats.kitti import objects_from_detections
from lcf3d.formats.kitti_tracking import write_tracks
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import iou_3d
from lcf3d.structures import KITTI_CLASSES, Detections3D, FloatArray

MIN_IOU, MIN_HITS, MAX_MISSES = 0.01, 3, 2
# the measurement (x y z yaw l w h) as columns of a canonical box
COLUMNS = [0, 1, 2, 6, 3, 4, 5]
MOTION = np.eye(10)
MOTION[:3, 7:] = np.eye(3)
PROCESS = np.diag([1.0] * 7 + [0.01] * 3)


class Track:
    """One object: a Kalman filter, its class, and how often it was hit and missed."""

    def __init__(self, number: int, label: int, box: FloatArray) -> None:
        self.number, self.label = number, label
        self.state = np.concatenate([box[COLUMNS], np.zeros(3)])
        self.cov = np.diag([10.0] * 7 + [10000.0] * 3)
        self.hits, self.misses, self.score = 1, 0, 0.0

    def predict(self) -> None:
        """One frame onward."""
        self.state, self.cov = MOTION @ self.state, MOTION @ self.cov @ MOTION.T + PROCESS
        self.misses += 1

    def update(self, box: FloatArray) -> None:
        """Correct by a detection."""
        turn = wrap_angle(box[6] - self.state[3])
        if np.abs(turn) > np.pi / 2:
            self.state[3] = wrap_angle(self.state[3] + np.pi)
        measured = box[COLUMNS]
        measured[3] = self.state[3] + wrap_angle(box[6] - self.state[3])
        gain = self.cov[:, :7] @ np.linalg.inv(self.cov[:7, :7] + np.eye(7))
        self.state = self.state + gain @ (measured - self.state[:7])
        self.cov = self.cov - gain @ self.cov[:7]
        self.hits, self.misses = self.hits + 1, 0

    @property
    def box(self) -> FloatArray:
        """(7,) canonical box."""
        return np.array(self.state[[0, 1, 2, 4, 5, 6, 3]])


def step(tracks: list[Track], found: Detections3D, first: int, frame: int) -> tuple[list[Track], list[Track], int]:
    """One frame: all tracks after it, those to report, and the next free number."""
    for track in tracks:
        track.predict()
    labels = np.array([track.label for track in tracks], dtype=np.int64)
    overlap = iou_3d(found.boxes, np.array([track.box for track in tracks]).reshape(-1, 7))
    overlap[found.labels[:, None] != labels[None]] = 0
    rows, columns = linear_sum_assignment(overlap, maximize=True)
    good = overlap[rows, columns] >= MIN_IOU
    for row, column in zip(rows[good], columns[good], strict=True):
        tracks[column].update(found.boxes[row])
        tracks[column].score = found.scores[row]
    for row in np.setdiff1d(np.arange(len(found)), rows[good]):
        tracks.append(Track(first, int(found.labels[row]), found.boxes[row]))
        tracks[-1].score = found.scores[row]
        first += 1
    tracks = [track for track in tracks if track.misses < MAX_MISSES]
    shown = [track for track in tracks if track.misses == 0 and (track.hits >= MIN_HITS or frame < MIN_HITS)]
    return tracks, shown, first


def main() -> None:
    """Write tracking results of some sequences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="kitti:ROOT")
    parser.add_argument("lidar", type=Path, help="folder of results")
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", default="val")
    parser.add_argument("--sequences", nargs="*")
    options = parser.parse_args()
    dataset = KittiDataset(options.dataset.partition(":")[2], options.split)
    source = KittiLidarResults(options.lidar, KITTI_CLASSES)
    names = options.sequences or sorted({i.rpartition("_")[0] for i in dataset.ids})
    for name in names:
        tracks: list[Track] = []
        first, numbers, ids, objects = 0, [], [], []
        for count, frame_id in enumerate(i for i in dataset.ids if i.startswith(f"{name}_")):
            frame = dataset.frame(frame_id)
            tracks, shown, first = step(tracks, source.detect(frame), first, count)
            boxes = np.array([track.box for track in shown]).reshape(-1, 7)
            scores, labels = [track.score for track in shown], [track.label for track in shown]
            found = Detections3D(boxes, scores, labels, KITTI_CLASSES)
            camera = frame.cameras[0]
            numbers.append(int(frame_id.rpartition("_")[2]))
            ids.append(np.array([track.number for track in shown], dtype=np.int64))
            objects.append(objects_from_detections(found, project_boxes(boxes, camera)[0], camera.camera_from_lidar))
        write_tracks(options.out / f"{name}.txt", numbers, ids, objects)


if __name__ == "__main__":
    main()

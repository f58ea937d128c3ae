"""Labelled scans to train a LiDAR detector on: from simulated samples or from a dataset, in the classes it learns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.opening import root_of
from lcf3d.detectors.classes import class_mapping
from lcf3d.detectors.fusion.images import image_of
from lcf3d.detectors.fusion.painters import Painter
from lcf3d.detectors.fusion.painting import painted_points
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.grounding import LEVEL_M, level_points
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_points
from lcf3d.geometry.ground import ground_field
from lcf3d.structures import KITTI_CLASSES, Detections3D, FloatArray, IntArray
from lcf3d.training.samples import ScanSample, read_scan

BACKGROUND, IGNORED = -1, -2
LABELLED_KITTI = (*KITTI_CLASSES, "Van", "Truck", "Tram", "Misc", "Person_sitting")
SEATED = "Person_sitting"
"""KITTI's class that is neither pedestrian nor background."""
LEAST_POINTS = 5
"""Objects with fewer returns are neither to be found nor to be left out."""
FRONT_TURN = math.pi / 4


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """A scan and what a detector is to find in it.

    Attributes:
        points: (N, 4 or more) float32 x, y, z, intensity and what the points are painted with, LiDAR frame; finite.
        boxes: (A, 7) LiDAR frame.
        labels: (A,) class, or `IGNORED` for objects that are neither to be found nor background.
        counts: (A,) returns in each box.
    """

    points: NDArray[np.float32]
    boxes: FloatArray
    labels: IntArray
    counts: IntArray


@dataclass(frozen=True)
class ScanSource:
    """Where labelled scans come from.

    Attributes:
        read: gives a scan by its number.
        count: number of scans.
        turn: largest angle in radians by which a scan may be turned: pi where there are boxes all around.
    """

    read: Callable[[int], LabelledScan]
    count: int
    turn: float

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ConfigError("there is no scan to train on; name a split that has some, or simulate more samples")

    def part(self, first: int, last: int) -> ScanSource:
        """The scans from ``first`` up to and without ``last``."""
        return ScanSource(lambda i: self.read(first + i), min(last, self.count) - first, self.turn)

    def hold_out(self, count: int) -> tuple[ScanSource, ScanSource]:
        """The scans to learn from, and the last ``count`` to measure with.

        Raises:
            ConfigError: nothing would be left to learn from.
        """
        if self.count <= count:
            raise ConfigError(f"there are {self.count} scans, too few to hold out {count}; hold out fewer")
        return self.part(0, self.count - count), self.part(self.count - count, self.count)


def simulated_scans(paths: Sequence[Path], class_names: Sequence[str]) -> ScanSource:
    """Scans of `lcf3d.training.samples`, which have boxes all around."""
    return ScanSource(lambda i: labelled_scan(read_scan(paths[i]), class_names), len(paths), math.pi)


def dataset_scans(
    dataset: str,
    split: str | None,
    class_names: Sequence[str],
    version: str | None = None,
    painter: Painter | None = None,
) -> ScanSource:
    """Scans of ``kitti:ROOT`` or ``nuscenes:ROOT``.

    KITTI labels only what the left camera sees: points outside its image are left out, and scans are turned by an
    eighth of a circle at most. A painter gives each point its scores of ``class_names`` from that image; what it says
    of a frame is kept, since camera networks take longer than all the rest.

    Raises:
        DatasetError: the dataset or the split does not exist.
        ConfigError: the kind of dataset is unknown, or nuScenes' points are to be painted.
    """
    kind, root = root_of(dataset, ("kitti", "nuscenes"), "the training")
    if kind == "kitti":
        from lcf3d.datasets.kitti import KittiDataset

        kitti = KittiDataset(root, split, class_names=LABELLED_KITTI)
        if painter is None:
            return ScanSource(partial(_from_kitti, kitti, tuple(class_names)), len(kitti), FRONT_TURN)
        return ScanSource(_PaintedKitti(kitti, tuple(class_names), painter).read, len(kitti), FRONT_TURN)
    if painter is not None:
        raise ConfigError("points are painted from KITTI's left camera; name a KITTI folder, kitti:ROOT")
    from lcf3d.datasets.nuscenes import NuscenesDataset

    nuscenes = NuscenesDataset(root, version, split)
    return ScanSource(lambda i: _from_frame(nuscenes[i], class_names), len(nuscenes), math.pi)


def levelled_scan(scan: LabelledScan, config: LidarConfig) -> LabelledScan:
    """The scan as a network of this configuration is shown it: on level ground, if it wants that."""
    if config.ground != "level":
        return scan
    x0, y0, _, x1, y1, _ = config.voxels.area
    reach = math.hypot(max(-x0, x1), max(-y0, y1))
    ground = ground_field(scan.points, (-reach, -reach, reach, reach), LEVEL_M)
    points = level_points(scan.points, ground).astype(np.float32)
    boxes = scan.boxes.copy()
    boxes[:, 2] -= ground.heights(boxes) - LEVEL_M
    return LabelledScan(points, boxes, scan.labels, scan.counts)


def labelled_scan(sample: ScanSample, class_names: Sequence[str]) -> LabelledScan:
    """The scan of a sample with labels of ``class_names``; objects of other classes are background.

    Vans are cars. Seated persons, and objects with fewer than `LEAST_POINTS` returns, are ignored.
    """
    mapping = class_mapping(tuple(sorted({*sample.names.tolist()})), class_names)
    index = {name: i for i, name in enumerate(class_names)}
    labels = np.full(len(sample.names), BACKGROUND, np.int64)
    for i, name in enumerate(sample.names.tolist()):
        labels[i] = IGNORED if name == SEATED else index.get(mapping.get(name, ""), BACKGROUND)
    kept = np.isfinite(sample.boxes).all(axis=1) & (sample.boxes[:, 3:6] > 0).all(axis=1) & (labels != BACKGROUND)
    labels = np.where(sample.points_on < LEAST_POINTS, IGNORED, labels)[kept]
    points = sample.points[np.isfinite(sample.points).all(axis=1)] if len(sample.points) else sample.points
    return LabelledScan(points, sample.boxes[kept], labels, sample.points_on[kept].astype(np.int64))


def _from_kitti(kitti: Sequence[Frame], class_names: tuple[str, ...], index: int) -> LabelledScan:
    frame = kitti[index]
    camera = frame.camera("left")
    points = _points(frame)
    pixels, _ = project_points(points, camera)
    # comparisons with NaN, the pixel of a point behind the camera, are false
    seen = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    return _labelled(points[seen], frame.labels, class_names)


class _PaintedKitti:
    """Scans whose points carry class scores."""

    def __init__(self, kitti: Sequence[Frame], class_names: tuple[str, ...], painter: Painter) -> None:
        self.kitti, self.class_names, self.painter = kitti, class_names, painter
        self.kept: dict[int, NDArray[np.float16]] = {}

    def read(self, index: int) -> LabelledScan:
        frame = self.kitti[index]
        camera, points = frame.camera("left"), _points(frame)
        points = points[np.isfinite(points).all(axis=1)]
        if index in self.kept:
            painted = painted_points(points, camera, None, self.painter, len(self.class_names))
            painted[:, 4:] = self.kept[index]
        else:
            painted = painted_points(points, camera, image_of(frame, camera), self.painter, len(self.class_names))
            self.kept[index] = painted[:, 4:].astype(np.float16)
        return _labelled(painted, frame.labels, self.class_names)


def _from_frame(frame: Frame, class_names: Sequence[str]) -> LabelledScan:
    return _labelled(_points(frame), frame.labels, class_names)


def _points(frame: Frame) -> NDArray[np.float32]:
    if frame.points is None or frame.labels is None:
        missing = "scan" if frame.points is None else "labels"
        raise DatasetError(f"frame {frame.id} has no {missing}; train on frames that have scan and labels")
    return np.ascontiguousarray(frame.points[:, :4], dtype=np.float32)


def _labelled(points: NDArray[np.float32], labels: Detections3D | None, class_names: Sequence[str]) -> LabelledScan:
    found = Detections3D.empty(class_names) if labels is None else labels
    names = np.array(found.class_names, dtype=np.str_)[found.labels]
    counts = points_in_boxes(points, found.boxes).sum(axis=1).astype(np.int64)
    return labelled_scan(ScanSample(points, found.boxes, names, counts), class_names)

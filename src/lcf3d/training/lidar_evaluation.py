"""How good a LiDAR detector is: KITTI's 3D AP and the centre-distance AP, on simulated and real scans alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.drive import read_drive
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.detectors.base import LidarDetector
from lcf3d.errors import DatasetError
from lcf3d.evaluation.curves import exact_average_precision
from lcf3d.evaluation.generalization import evaluate_generalization
from lcf3d.evaluation.kitti import KittiEvaluator, Selection
from lcf3d.formats.kitti import KittiFrames, KittiObjects, detections_3d, objects_from_detections, read_objects
from lcf3d.geometry.boxes import kitti_from_lidar, points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections3D, FloatArray, IntArray
from lcf3d.training.lidar_scans import LEAST_POINTS
from lcf3d.training.samples import read_scan

HIDDEN = 3
"""KITTI's occlusion level of objects that count at no difficulty."""


@dataclass(frozen=True, eq=False)
class EvaluationScan:
    """A scan, the camera that decides what counts, and what is there.

    Attributes:
        points: (N, 4) float32 LiDAR frame.
        camera: the left camera.
        objects: KITTI labels.
    """

    points: NDArray[np.float32]
    camera: Camera
    objects: KittiObjects


def drive_scans() -> Iterator[EvaluationScan]:
    """The frames of the shipped drive."""
    for frame in read_drive():
        o = frame.objects
        counts = points_in_boxes(frame.points, o.boxes).sum(axis=1)
        yield EvaluationScan(
            frame.points,
            frame.camera,
            _labels(
                o.boxes,
                o.class_names,
                o.boxes2d,
                o.truncated,
                np.where(counts < LEAST_POINTS, HIDDEN, o.occluded),
                frame.camera,
            ),
        )


def sample_scans(paths: Sequence[Path]) -> Iterator[EvaluationScan]:
    """Simulated samples as the left camera of the shipped drive would see them.

    Samples know no occlusion: every object with `LEAST_POINTS` returns counts as visible.
    """
    camera = read_drive(count=1)[0].camera
    for path in paths:
        sample = read_scan(path)
        clipped, seen = project_boxes(sample.boxes, camera)
        wide = Camera(camera.name, _shifted(camera), camera.camera_from_lidar, 3 * camera.width, 3 * camera.height)
        whole, _ = project_boxes(sample.boxes, wide)
        truncated = 1 - _areas(clipped) / np.maximum(_areas(whole), 1e-9)
        occluded = np.where(sample.points_on < LEAST_POINTS, HIDDEN, 0)
        labels = _labels(sample.boxes, sample.names, clipped, np.clip(truncated, 0, 1), occluded, camera)
        yield EvaluationScan(sample.points, camera, labels[seen])


def kitti_scans(root: Path, split: str) -> Iterator[EvaluationScan]:
    """The frames of a split of a KITTI folder.

    Raises:
        DatasetError: a frame has no scan or no labels.
    """
    dataset = KittiDataset(root, split)
    for frame_id in dataset.ids:
        frame = dataset.frame(frame_id)
        label = dataset.folder / "label_2" / f"{frame_id}.txt"
        if frame.points is None or not label.is_file():
            raise DatasetError(f"frame {frame_id} of {root} has no scan or no labels; choose a split that has both")
        yield EvaluationScan(frame.points, frame.camera("left"), read_objects(label, results=False))


def detector_figures(detector: LidarDetector, scans: Iterable[EvaluationScan]) -> dict[str, dict[str, float]]:
    """By class: KITTI's 3D and bird's-eye-view AP R40 (moderate, percent) and the mean centre-distance AP (percent).

    All count only what the camera sees. ``3d exact`` is the 3D AP at every recall instead of KITTI's 40, which cannot
    be reached with fewer than 41 objects (``counted`` are they). ``objects`` are those of the centre-distance AP.
    Classes without objects are absent.
    """
    truth, found, labels, results, cameras = [], [], [], [], []
    for scan in scans:
        detections = detector(scan.points).with_classes(KITTI_CLASSES)
        projected, seen = project_boxes(detections.boxes, scan.camera)
        detections = detections[seen]
        results.append(objects_from_detections(detections, projected[seen], scan.camera.camera_from_lidar))
        labels.append(scan.objects)
        truth.append(_enough(detections_3d(scan.objects, scan.camera.camera_from_lidar, KITTI_CLASSES), scan.points))
        found.append(detections)
        cameras.append(scan.camera)
    names = tuple(f"{i:06d}" for i in range(len(labels)))
    evaluator = KittiEvaluator(KittiFrames.from_frames(names, labels), KittiFrames.from_frames(names, results))
    official = evaluator.metrics()
    distance = evaluate_generalization(truth, found, class_names=KITTI_CLASSES, cameras=cameras)
    figures = {}
    for k, name in enumerate(distance.class_names):
        events = evaluator.events(Selection(name, "3d", "moderate"))
        # of a class that the scans do not have there is nothing to say
        if events.object_count or distance.ground_truth_counts[k]:
            figures[name] = {
                "3d": official.ap(name, "3d"),
                "3d exact": exact_average_precision(events),
                "counted": events.object_count,
                "bev": official.ap(name, "bev"),
                "distance": 100 * float(distance.aps[k].mean()),
                "objects": distance.ground_truth_counts[k],
            }
    return figures


def _enough(truth: Detections3D, points: NDArray[np.float32]) -> Detections3D:
    """The objects with enough returns to be found."""
    return truth[points_in_boxes(points, truth.boxes).sum(axis=1) >= LEAST_POINTS]


def _labels(
    boxes: FloatArray,
    names: NDArray[np.str_],
    boxes2d: FloatArray,
    truncated: FloatArray,
    occluded: IntArray,
    camera: Camera,
) -> KittiObjects:
    locations, dimensions, rotation_y = kitti_from_lidar(boxes, camera.camera_from_lidar)
    alpha = np.zeros(len(boxes))
    return KittiObjects(names, truncated, occluded, alpha, boxes2d, dimensions, locations, rotation_y)


def _shifted(camera: Camera) -> FloatArray:
    """The projection of the camera into an image three times as wide and high around its own."""
    shift = np.array([[1, 0, camera.width], [0, 1, camera.height], [0, 0, 1]], dtype=np.float64)
    shifted: FloatArray = shift @ camera.projection
    return shifted


def _areas(boxes2d: FloatArray) -> FloatArray:
    areas: FloatArray = (boxes2d[:, 2] - boxes2d[:, 0]) * (boxes2d[:, 3] - boxes2d[:, 1])
    return areas

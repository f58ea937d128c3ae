"""Detectors on another dataset than the one they were trained on: adaptation and metrics (paper section 5.8).

Everything is evaluated in KITTI's three classes and in the front camera's view, which is all that KITTI annotates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.convert import kitti_labels
from lcf3d.detectors.base import FrameDetector, LidarDetector
from lcf3d.errors import ConfigError, DatasetError, ShapeError
from lcf3d.evaluation.generalization import (
    CLASS_RANGES,
    GeneralizationMetrics,
    evaluate_generalization,
    in_camera_view,
)
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_points
from lcf3d.geometry.iou import iou_3d
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D, FloatArray

IOU_THRESHOLDS: FloatArray = np.round(np.arange(0.1, 0.901, 0.05), 2)
"""IoU thresholds at which `ap_over_iou` is usually drawn."""

IGNORED_RADIUS_M = 2.0
"""Detections nearer than this to an annotated object that is not evaluated are neither right nor wrong."""

LABEL_CLASSES = (*KITTI_CLASSES, "Van", "Person_sitting")
"""Classes of KITTI labels that are read: those evaluated, and those that look like them."""

_COUNTED_AS = {
    **{name: name for name in KITTI_CLASSES},
    "car": "Car",
    "pedestrian": "Pedestrian",
    "bicycle": "Cyclist",
    "motorcycle": "Cyclist",
}
_LOOKS_LIKE = {"Van": "Car", "Person_sitting": "Pedestrian"}
_CYCLES = ("bicycle", "motorcycle")


@dataclass(frozen=True)
class SensorDomain:
    """What a LiDAR detector has grown used to in its training data.

    Attributes:
        name: of the dataset.
        lidar_height_m: height of the LiDAR over the ground.
        max_intensity: largest value of the intensity channel.
        time_channel: points carry a fifth value, the age of their sweep in seconds.
        front_only: scans were cut to the front camera's view.
    """

    name: str
    lidar_height_m: float
    max_intensity: float
    time_channel: bool
    front_only: bool


DOMAINS = {
    # Geiger et al. (2013), figure 3: the Velodyne is 1.73 m above the ground
    "kitti": SensorDomain("kitti", 1.73, 1.0, time_channel=False, front_only=True),
    # calibrated_sensor.json: LIDAR_TOP is 1.84 m above the ego frame, whose origin lies on the ground
    "nuscenes": SensorDomain("nuscenes", 1.84, 255.0, time_channel=True, front_only=False),
}


def find_domain(name: str) -> SensorDomain:
    """The domain whose name ``name`` begins with: ``kitti64`` is of KITTI's kind, ``nuscenes32`` of nuScenes'.

    Raises:
        ConfigError: there is none.
    """
    for known, domain in DOMAINS.items():
        if name.lower().startswith(known):
            return domain
    raise ConfigError(f"domain {name!r} must begin with {' or '.join(DOMAINS)}, which says what its scans are like")


def adapt_points(
    points: NDArray[np.float32], tested: SensorDomain, trained: SensorDomain, camera: Camera | None = None
) -> NDArray[np.float32]:
    """Points of one dataset as a detector expects them that was trained on the other (paper section 5.8).

    The ground is moved to the height it had in training, intensities are scaled, the time channel is set to zero
    where the data has none and left out where the detector knows none, and the scan is cut to the front camera's view
    where training scans were. Equal domains leave everything but the missing time channel and the view as it is.

    Args:
        points: (N, 4 or more) ``x, y, z, intensity`` and, with sweeps, the age in seconds.
        tested: where the points are from.
        trained: what the detector was trained on.
        camera: the front camera; None for no cut.

    Returns:
        (M, 4) points, (M, 5) for a detector with a time channel; boxes found in them are higher by `height_shift_m`.
    """
    if points.ndim != 2 or points.shape[1] < 4:
        raise ShapeError(f"points must have shape (N, 4 or more), got {points.shape}")
    kept = points
    if camera is not None and trained.front_only:
        pixels, _ = project_points(points[:, :3].astype(np.float64), camera)
        # behind the camera, pixels are NaN and every comparison is false
        kept = points[((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)]
    adapted = np.zeros((len(kept), 5 if trained.time_channel else 4), dtype=np.float32)
    columns = min(adapted.shape[1], kept.shape[1] if tested.time_channel else 4)
    adapted[:, :columns] = kept[:, :columns]
    adapted[:, 2] += height_shift_m(tested, trained)
    adapted[:, 3] *= trained.max_intensity / tested.max_intensity
    return adapted


def height_shift_m(tested: SensorDomain, trained: SensorDomain) -> float:
    """What `adapt_points` adds to z: the difference of the LiDARs' heights over the ground."""
    return tested.lidar_height_m - trained.lidar_height_m


class _Adapted:
    """A detector of one domain run on frames of another; its boxes come back in the frame's own coordinates.

    Args:
        detector: the detector.
        tested: domain of the frames.
        trained: domain of the detector.
        camera: name of the front camera.
    """

    def __init__(
        self, detector: LidarDetector | FrameDetector, tested: SensorDomain, trained: SensorDomain, camera: str
    ) -> None:
        self.detector: Any = detector
        self.tested = tested
        self.trained = trained
        self.camera = camera
        self.shift_m = height_shift_m(tested, trained)

    def detect(self, frame: Frame) -> Detections3D:
        """Run the detector.

        Raises:
            DatasetError: the frame has no scan, or lacks the images that the detector needs.
        """
        if frame.points is None:
            raise DatasetError(f"frame {frame.id} has no scan for the detector; give lidar=results:PATH instead")
        points = adapt_points(frame.points, self.tested, self.trained, frame.camera(self.camera))
        found = self._found(frame, points)
        boxes = found.boxes.copy()
        boxes[:, 2] -= self.shift_m
        return replace(found, boxes=boxes)

    def _found(self, frame: Frame, points: NDArray[np.float32]) -> Detections3D:
        """What the detector finds in the adapted points."""
        raise NotImplementedError


class AdaptedLidar(_Adapted):
    """A LiDAR detector of one domain on frames of another, see `adapt_points`."""

    def _found(self, frame: Frame, points: NDArray[np.float32]) -> Detections3D:
        found: Detections3D = self.detector(points)
        return found


class AdaptedFrames(_Adapted):
    """A detector of points and images of one domain on frames of another, as `AdaptedLidar` does with points."""

    def _found(self, frame: Frame, points: NDArray[np.float32]) -> Detections3D:
        # the cameras stay where they are while the LiDAR frame moves
        frame_from_moved = np.eye(4)
        frame_from_moved[2, 3] = -self.shift_m
        cameras = [replace(c, camera_from_lidar=c.camera_from_lidar @ frame_from_moved) for c in frame.cameras]
        found: Detections3D = self.detector.detect_frame(Frame(frame.id, points, cameras, frame.images))
        return found


def in_kitti_classes(detections: Detections3D) -> Detections3D:
    """Detections of either dataset's classes in KITTI's three: bicycles and motorcycles count as Cyclist.

    Attributes are not looked at: by convention detectors call every cycle ``without_rider`` that they know nothing
    about. What stands for a cycle without a rider is found out by `without_ignored`.
    """
    return detections.with_classes(KITTI_CLASSES, _COUNTED_AS)


def camera_in_kitti_classes(detections: Detections2D) -> Detections2D:
    """The same for 2D detections."""
    return detections.with_classes(KITTI_CLASSES, _COUNTED_AS)


class Truth(NamedTuple):
    """Annotations of a frame in KITTI's three classes.

    Attributes:
        counted: objects to be found.
        ignored: objects that look like those and are not evaluated: vans, people sitting, cycles without a rider.
    """

    counted: Detections3D
    ignored: Detections3D


def split_truth(labels: Detections3D) -> Truth:
    """Annotations of either dataset (KITTI: with `LABEL_CLASSES`), split into those evaluated and those that are not.

    KITTI's Cyclist is the nuScenes bicycle or motorcycle that has a rider; KITTI does not annotate the others.
    """
    names = np.array(labels.class_names)[labels.labels] if len(labels) else np.zeros(0, dtype=np.str_)
    ridden = np.zeros(len(labels), dtype=bool)
    if labels.attributes is not None:
        ridden = labels.attributes == "cycle.with_rider"
    alike = np.isin(names, tuple(_LOOKS_LIKE)) | (np.isin(names, _CYCLES) & ~ridden)
    return Truth(
        kitti_labels(labels).with_classes(KITTI_CLASSES),
        labels[alike].with_classes(KITTI_CLASSES, {**_COUNTED_AS, **_LOOKS_LIKE}),
    )


def without_ignored(found: Detections3D, truth: Truth) -> Detections3D:
    """Detections without those that stand for an ignored object.

    That is the case where an ignored object of the class lies within `IGNORED_RADIUS_M` of the detection's centre, on
    the ground plane, and nearer than every object of the class that counts.
    """
    to_ignored = _nearest_of_class(found, truth.ignored)
    kept = (to_ignored >= IGNORED_RADIUS_M) | (_nearest_of_class(found, truth.counted) <= to_ignored)
    return found[kept]


def _nearest_of_class(found: Detections3D, objects: Detections3D) -> FloatArray:
    """(N,) horizontal distance from each detection to the nearest object of its class, infinite without any."""
    apart = np.linalg.norm(found.boxes[:, None, :2] - objects.boxes[None, :, :2], axis=2)
    apart[found.labels[:, None] != objects.labels[None]] = np.inf
    nearest: FloatArray = apart.min(axis=1, initial=np.inf)
    return nearest


def in_evaluated_area(found: Detections3D, camera: Camera) -> Detections3D:
    """Those whose centre the front camera sees and that lie within their class's range."""
    limits = np.array([CLASS_RANGES[name] for name in found.class_names])
    near = np.hypot(found.boxes[:, 0], found.boxes[:, 1]) < limits[found.labels]
    return in_camera_view(found[near], camera)


@dataclass(frozen=True, eq=False)
class ShiftMetrics:
    """One method on one task.

    Attributes:
        metrics: NDS^ and its parts.
        ap_over_iou: (C, T) AP in percent at 40 recall positions by class and threshold of `IOU_THRESHOLDS`.
    """

    metrics: GeneralizationMetrics
    ap_over_iou: FloatArray


def evaluate_shift(
    truths: Sequence[Truth],
    predictions: Sequence[Detections3D],
    cameras: Sequence[Camera],
    class_names: Sequence[str] = KITTI_CLASSES,
) -> ShiftMetrics:
    """Metrics over the frames of one dataset, in the camera's view; classes that are not annotated there are left out.

    Args:
        truths: of each frame (`split_truth`).
        predictions: of the same frames, in KITTI's classes (`in_kitti_classes`).
        cameras: front camera of each frame.
        class_names: which of KITTI's classes to evaluate.

    Raises:
        DatasetError: nothing of these classes is annotated in view.
    """
    counted = [in_evaluated_area(truth.counted, camera) for truth, camera in zip(truths, cameras, strict=True)]
    found = [
        in_evaluated_area(without_ignored(p, truth), camera)
        for p, truth, camera in zip(predictions, truths, cameras, strict=True)
    ]
    present = np.bincount(np.concatenate([part.labels for part in counted]), minlength=len(KITTI_CLASSES)) > 0
    names = tuple(name for name, there in zip(KITTI_CLASSES, present, strict=True) if there and name in class_names)
    if not names:
        raise DatasetError(f"no {' or '.join(class_names)} is annotated in the front camera's view of these frames")
    counted, found = ([part.with_classes(names) for part in parts] for parts in (counted, found))
    return ShiftMetrics(evaluate_generalization(counted, found, class_names=names), ap_over_iou(counted, found))


def ap_over_iou(
    ground_truth: Sequence[Detections3D], predictions: Sequence[Detections3D], thresholds: FloatArray = IOU_THRESHOLDS
) -> FloatArray:
    """(C, T) 3D average precision in percent by class and IoU threshold (paper figure "domain-shift").

    Every frame's detections take, in descending score, the free object of highest IoU, if that is above the threshold.
    Precision is the best at this or a higher recall, averaged over the recalls 1/40 to 1. NaN for classes without any
    object. There are no difficulties and no ignored objects: this is not KITTI's official AP.

    Args:
        ground_truth: objects of each frame.
        predictions: detections of the same frames; all with the same class list.
        thresholds: (T,) IoU.
    """
    names = ground_truth[0].class_names
    result = np.full((len(names), len(thresholds)), np.nan)
    for label in range(len(names)):
        truth = [frame.boxes[frame.labels == label] for frame in ground_truth]
        found = [frame[frame.labels == label] for frame in predictions]
        total = sum(map(len, truth))
        if not total:
            continue
        scores = np.concatenate([frame.scores for frame in found])
        hits = np.concatenate([_hits(f, t, thresholds) for f, t in zip(found, truth, strict=True)])
        order = np.argsort(-scores, kind="stable")
        true_positives = np.cumsum(hits[order], axis=0)
        precision = true_positives / np.arange(1, len(order) + 1)[:, None]
        best = np.maximum.accumulate(precision[::-1], axis=0)[::-1]
        best = np.concatenate([best, np.zeros((1, len(thresholds)))])
        # the first detection at which each recall is reached, one past the end where it is not
        wanted = np.ceil(np.arange(1, 41) / 40 * total - 1e-9)
        for t in range(len(thresholds)):
            result[label, t] = 100 * best[np.searchsorted(true_positives[:, t], wanted), t].mean()
    return result


def _hits(found: Detections3D, truth: FloatArray, thresholds: FloatArray) -> NDArray[np.bool_]:
    """(N, T) whether each detection of one frame finds a free object, by threshold."""
    hits = np.zeros((len(found), len(thresholds)), dtype=bool)
    if not len(truth) or not len(found):
        return hits
    overlap = iou_3d(found.boxes, truth)
    free = np.ones((len(thresholds), len(truth)), dtype=bool)
    for i in np.argsort(-found.scores, kind="stable"):
        chosen = np.where(free, overlap[i], -1.0)
        best = chosen.argmax(axis=1)
        hits[i] = chosen[np.arange(len(thresholds)), best] > thresholds
        free[hits[i], best[hits[i]]] = False
    return hits

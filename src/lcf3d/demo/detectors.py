"""Detectors of the demonstration: made from the labels of the shipped drive, with the faults that real ones have."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.demo.shipped import ShippedFrame
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D, FloatArray, IntArray

CAR, PEDESTRIAN, CYCLIST = range(3)
LABELS = {"Car": CAR, "Van": CAR, "Pedestrian": PEDESTRIAN, "Cyclist": CYCLIST}
LEAST_POINTS = 5
# points on an object at which the LiDAR detector finds it half of the time
HALF_SEEN_POINTS = {CAR: 12.0, PEDESTRIAN: 22.0, CYCLIST: 30.0}
# with some five such things in view, about one false alarm a frame
FALSE_ALARM_RATE = {"pole": 0.25, "bush": 0.25}
# how often the camera finds an object of KITTI's occlusion levels 0 to 3
FOUND_BY_CAMERA = (0.97, 0.93, 0.75, 0.1)
LEAST_HEIGHT_PX = 22.0


def labelled(frame: ShippedFrame) -> tuple[NDArray[np.int64], IntArray]:
    """Rows of the objects that the detectors of the demonstration know (vans are cars to them), and their labels."""
    names = frame.objects.class_names
    rows = np.flatnonzero(np.isin(names, list(LABELS)))
    return rows, np.array([LABELS[str(name)] for name in names[rows]], dtype=np.int64)


def points_on(frame: ShippedFrame, boxes: FloatArray) -> IntArray:
    """(N,) returns of the scan inside each box."""
    counts: IntArray = points_in_boxes(frame.points, boxes).sum(axis=1)
    return counts


def ground_truth(frame: ShippedFrame) -> Detections3D:
    """Labelled objects with at least `LEAST_POINTS` returns; all are in view of the camera."""
    rows, labels = labelled(frame)
    seen = points_on(frame, frame.objects.boxes[rows]) >= LEAST_POINTS
    return Detections3D(frame.objects.boxes[rows][seen], np.ones(int(seen.sum())), labels[seen], KITTI_CLASSES)


def lidar_detections(frame: ShippedFrame, rng: np.random.Generator) -> Detections3D:
    """3D detections without non-maximum suppression: several a thing, fewer and worse with fewer points.

    Poles and bushes are sometimes taken for pedestrians and cyclists, and these two for each other.
    """
    boxes: list[FloatArray] = []
    scores: list[float] = []
    labels: list[int] = []

    def add(box: FloatArray, label: int, level: float, spread: float) -> None:
        for _ in range(1 + rng.poisson(5)):
            noise = rng.normal(0, spread, 7) * np.array([1.5, 1, 0.5, *(box[3:6] * 0.6), 0.8])
            boxes.append(box + noise)
            scores.append(level + rng.normal(0, 0.08))
            labels.append(label)

    rows, classes = labelled(frame)
    truth = frame.objects.boxes[rows]
    for box, kind, points in zip(truth, classes.tolist(), points_on(frame, truth).tolist(), strict=True):
        sureness = points / (points + HALF_SEEN_POINTS[kind])
        found, confused = rng.uniform() < sureness and points >= LEAST_POINTS, rng.uniform() < 0.12
        if found:
            label = PEDESTRIAN + CYCLIST - kind if confused and kind != CAR else kind
            add(box, label, 0.25 + 0.65 * sureness, 0.05 + 0.1 * (1 - sureness))
    things = frame.distractors
    for box, thing, points in zip(things.boxes, things.kinds, points_on(frame, things.boxes).tolist(), strict=True):
        mistaken, label = rng.uniform() < FALSE_ALARM_RATE[str(thing)], int(rng.choice([PEDESTRIAN, CYCLIST]))
        if mistaken and points >= 8:
            # the size of a person, standing where the thing stands
            person = np.array([*box[:2], box[2] - box[5] / 2 + 0.85, 0.7, 0.6, 1.7, 0.0])
            add(person, label, rng.uniform(0.3, 0.75), 0.1)
    return Detections3D(
        np.array(boxes).reshape(-1, 7), np.clip(scores, 0.02, 0.99), np.array(labels, dtype=np.int64), KITTI_CLASSES
    )


def camera_detections(frame: ShippedFrame, rng: np.random.Generator) -> Detections2D:
    """2D detections in the image, with noise, misses (more of hidden and small things) and false alarms.

    Boxes of partly hidden things are completed: KITTI's annotators draw them so (their boxes agree with the projected
    3D boxes of cars to an IoU of 0.97 in the median, whatever hides them), and so do detectors trained on that.
    """
    boxes: list[FloatArray] = []
    scores: list[float] = []
    labels: list[int] = []
    rows, classes = labelled(frame)
    projected, _ = project_boxes(frame.objects.boxes, frame.camera)
    for row, kind in zip(rows.tolist(), classes.tolist(), strict=True):
        box, hidden = frame.objects.boxes2d[row], int(frame.objects.occluded[row])
        if box[3] - box[1] < LEAST_HEIGHT_PX or rng.uniform() > FOUND_BY_CAMERA[hidden]:
            continue
        whole = projected[row] if hidden else box
        boxes.append(whole + rng.normal(0, 0.025, 4) * np.tile(whole[2:] - whole[:2], 2))
        scores.append(float(np.clip(rng.normal(0.9 - 0.1 * hidden, 0.07), 0.3, 0.99)))
        labels.append(PEDESTRIAN + CYCLIST - kind if kind != CAR and rng.uniform() < 0.03 else kind)
    for _ in range(rng.poisson(0.3)):
        boxes.append(_false_box(frame.camera, rng))
        scores.append(rng.uniform(0.3, 0.65))
        labels.append(int(rng.integers(3)))
    limits = np.array([frame.camera.width, frame.camera.height] * 2, dtype=np.float64)
    found = np.clip(np.array(boxes).reshape(-1, 4), 0, limits)
    return Detections2D(found, np.array(scores), np.array(labels, dtype=np.int64), KITTI_CLASSES)


def _false_box(camera: Camera, rng: np.random.Generator) -> FloatArray:
    width, height = rng.uniform(20, 60), rng.uniform(30, 90)
    x, y = rng.uniform(0, camera.width - width), rng.uniform(camera.height * 0.3, camera.height * 0.8 - height)
    return np.array([x, y, x + width, y + height])

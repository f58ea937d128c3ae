"""Detectors of the demonstration: made from the truth, with the faults that real ones have."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.demo.street import BUSH, POLE, Street
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D, FloatArray

CAR, PEDESTRIAN, CYCLIST = range(3)
LEAST_PIXELS = 60
# points on an object at which the LiDAR detector finds it half of the time
HALF_SEEN_POINTS = {CAR: 12.0, PEDESTRIAN: 22.0, CYCLIST: 30.0}
FALSE_ALARM_RATE = {POLE: 0.45, BUSH: 0.4}


def ground_truth(street: Street, seen: NDArray[np.bool_]) -> Detections3D:
    """The objects among the ``seen`` (K,) things of a street."""
    rows = np.flatnonzero((street.kinds <= CYCLIST) & seen)
    return Detections3D(street.boxes[rows], np.ones(len(rows)), street.kinds[rows], KITTI_CLASSES)


def lidar_detections(street: Street, owner: NDArray[np.int64], rng: np.random.Generator) -> Detections3D:
    """3D detections without non-maximum suppression: several a thing, fewer and worse with fewer points.

    Poles and bushes are sometimes taken for pedestrians and cyclists, and these two for each other.
    """
    points = np.bincount(owner[owner >= 0], minlength=len(street.kinds))
    boxes, scores, labels = [], [], []
    for thing, kind in enumerate(street.kinds):
        if kind <= CYCLIST:
            sureness = points[thing] / (points[thing] + HALF_SEEN_POINTS[kind])
            found, label = rng.uniform() < sureness and points[thing] >= 5, int(kind)
            if label != CAR and rng.uniform() < 0.12:
                label = PEDESTRIAN + CYCLIST - label
            level, spread = 0.25 + 0.65 * sureness, 0.05 + 0.1 * (1 - sureness)
        else:
            found = points[thing] >= 8 and rng.uniform() < FALSE_ALARM_RATE.get(int(kind), 0.0)
            label, level, spread = int(rng.choice([PEDESTRIAN, CYCLIST])), rng.uniform(0.3, 0.75), 0.1
        if not found:
            continue
        size = street.boxes[thing, 3:6] if kind <= CYCLIST else np.array([0.7, 0.6, 1.7])
        for _ in range(1 + rng.poisson(5)):
            box = np.array([*street.boxes[thing, :3], *size, street.boxes[thing, 6]])
            box += rng.normal(0, spread, 7) * np.array([1.5, 1, 0.5, *(size * 0.6), 0.8])
            boxes.append(box)
            scores.append(level + rng.normal(0, 0.08))
            labels.append(label)
    return Detections3D(
        np.array(boxes).reshape(-1, 7), np.clip(scores, 0.02, 0.99), np.array(labels, dtype=np.int64), KITTI_CLASSES
    )


def camera_detections(
    street: Street, camera: Camera, visible: NDArray[np.int64], rng: np.random.Generator
) -> Detections2D:
    """2D detections of what the (H, W) map ``visible`` of things shows, with noise, misses and false alarms."""
    boxes, scores, labels = [], [], []
    pixels = np.bincount(visible[visible >= 0], minlength=len(street.kinds))
    projected, _ = project_boxes(street.boxes, camera)
    area = (projected[:, 2] - projected[:, 0]) * (projected[:, 3] - projected[:, 1])
    for thing in np.flatnonzero((street.kinds <= CYCLIST) & (pixels >= LEAST_PIXELS)):
        share = pixels[thing] / max(area[thing], 1.0)
        if share < 0.2 or rng.uniform() < 0.07:
            continue
        side = np.tile(projected[thing, 2:] - projected[thing, :2], 2)
        boxes.append(projected[thing] + rng.normal(0, 0.025, 4) * side)
        scores.append(np.clip(rng.normal(0.9, 0.07), 0.3, 0.99))
        label = int(street.kinds[thing])
        labels.append(PEDESTRIAN + CYCLIST - label if label != CAR and rng.uniform() < 0.03 else label)
    for _ in range(rng.poisson(0.3)):
        boxes.append(_false_box(camera, rng))
        scores.append(rng.uniform(0.3, 0.65))
        labels.append(int(rng.integers(3)))
    limits = np.array([camera.width, camera.height, camera.width, camera.height], dtype=np.float64)
    found = np.clip(np.array(boxes).reshape(-1, 4), 0, limits)
    return Detections2D(found, np.array(scores), np.array(labels, dtype=np.int64), KITTI_CLASSES)


def _false_box(camera: Camera, rng: np.random.Generator) -> FloatArray:
    width, height = rng.uniform(20, 60), rng.uniform(30, 90)
    x, y = rng.uniform(0, camera.width - width), rng.uniform(camera.height * 0.3, camera.height * 0.8 - height)
    return np.array([x, y, x + width, y + height])

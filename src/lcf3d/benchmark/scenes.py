"""Made-up detections of a given number, as a LiDAR detector without NMS and a camera detector give them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D

# KITTI's left colour camera, ideal mounting
PROJECTION = np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]])
CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
GROUND_Z = -1.7


def kitti_camera() -> Camera:
    """The camera of all scenes."""
    return Camera("left", PROJECTION, CAMERA_FROM_LIDAR, 1242, 375)


def street_objects(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """(count, 7) cars that stand apart from each other in the camera's view."""
    boxes: list[NDArray[np.float64]] = []
    while len(boxes) < count:
        x = rng.uniform(8, 70)
        box = np.array([x, rng.uniform(-0.7, 0.7) * x, GROUND_Z + 0.8, 3.9, 1.6, 1.6, rng.uniform(-np.pi, np.pi)])
        if all(np.hypot(*(box[:2] - other[:2])) > 5 for other in boxes):
            boxes.append(box)
    return np.array(boxes)


def detections(
    lidar_count: int, camera_count: int, seed: int = 0, point_count: int = 120_000
) -> tuple[Frame, Detections3D, Detections2D]:
    """A frame, LiDAR detections in dense groups around its objects, and camera detections.

    Args:
        lidar_count: 3D boxes, about ten an object.
        camera_count: 2D boxes; there are as many objects, a tenth of which the camera misses for false boxes.
        seed: of the random generator.
        point_count: points of the scan.
    """
    rng = np.random.default_rng(seed)
    objects = street_objects(camera_count, rng)
    groups = objects[rng.integers(0, len(objects), lidar_count)]
    noise = rng.normal(0, [0.3, 0.2, 0.05, 0.2, 0.08, 0.08, 0.1], groups.shape)
    labels = np.where(rng.uniform(size=lidar_count) < 0.1, 1, 0)
    lidar = Detections3D(groups + noise, rng.uniform(0.1, 1, lidar_count), labels, KITTI_CLASSES)
    view = kitti_camera()
    boxes2d, _ = project_boxes(objects, view)
    sides = np.maximum(boxes2d[:, 2:] - boxes2d[:, :2], 4)
    boxes2d[:, 2:] = boxes2d[:, :2] + sides
    boxes2d += rng.normal(0, 0.03, boxes2d.shape) * np.tile(sides, 2)
    missed = rng.uniform(size=camera_count) < 0.1
    boxes2d[missed] = [100, 20, 160, 60]
    camera = Detections2D(boxes2d, rng.uniform(0.5, 1, camera_count), np.zeros(camera_count, np.int64), KITTI_CLASSES)
    return Frame("bench", scan(objects, point_count, rng), [view]), lidar, camera


def scan(objects: NDArray[np.float64], point_count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(N, 4) float32 ground and the near faces of the objects."""
    on_objects = min(500 * len(objects), point_count // 2)
    which = rng.integers(0, len(objects), on_objects)
    cos, sin = np.cos(objects[which, 6]), np.sin(objects[which, 6])
    face = rng.uniform(-0.5, 0.5, (on_objects, 3)) * objects[which, 3:6]
    side = rng.uniform(size=on_objects) < 0.5
    face[side, 1] = np.sign(face[side, 1]) * objects[which[side], 4] / 2
    face[~side, 0] = np.sign(face[~side, 0]) * objects[which[~side], 3] / 2
    xyz = np.stack([cos * face[:, 0] - sin * face[:, 1], sin * face[:, 0] + cos * face[:, 1], face[:, 2]], axis=1)
    xyz += objects[which, :3]
    distance, angle = rng.uniform(3, 80, point_count - on_objects), rng.uniform(-np.pi, np.pi, point_count - on_objects)
    plane = np.stack([distance * np.cos(angle), distance * np.sin(angle), np.full(len(angle), GROUND_Z)], axis=1)
    points = np.concatenate([xyz, plane + rng.normal(0, 0.02, plane.shape)])
    return np.column_stack([points, rng.uniform(0, 1, len(points))]).astype(np.float32)

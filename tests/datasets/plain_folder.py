"""A small drive as a plain folder: ground and cars scanned exactly, two cameras, labels and detections."""

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from lcf3d.formats.plain import write_detections_2d, write_detections_3d
from lcf3d.geometry.boxes import box_corners
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Camera, Detections2D, Detections3D

CLASSES = ("car", "person")
K = np.array([[300.0, 0, 320], [0, 300, 160], [0, 0, 1]])
FRONT_FROM_LIDAR = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
# looks to the left: camera z is LiDAR y
LEFT_FROM_LIDAR = np.array([[1.0, 0, 0, 0], [0, 0, -1, -0.1], [0, 1, 0, -0.5], [0, 0, 0, 1]])
POSES = {"front": FRONT_FROM_LIDAR, "left": LEFT_FROM_LIDAR}


def camera(name: str) -> Camera:
    return Camera(name, np.hstack([K, np.zeros((3, 1))]), POSES[name], 640, 320)


def boxes_of(frame: int) -> Detections3D:
    """Two cars ahead, one to the left, a person ahead; they move with the frame."""
    boxes = np.array(
        [
            [12 + frame, -3, -1.0, 4.2, 1.8, 1.5, 0.1],
            [20.0, 4, -1.0, 4.0, 1.7, 1.5, -2.0],
            [-1.0, 11 + frame, -1.0, 4.0, 1.7, 1.5, 1.2],
            [9.0, 2, -0.9, 0.7, 0.7, 1.7, 0.0],
        ]
    )
    return Detections3D(boxes, np.ones(4), np.array([0, 0, 0, 1]), CLASSES)


def scan_of(labels: Detections3D, seed: int) -> np.ndarray:
    """(N, 4) points on the ground (z = -1.75) and on the sides of the boxes."""
    rng = np.random.default_rng(seed)
    radius, angle = rng.uniform(3, 35, 4000), rng.uniform(-np.pi, np.pi, 4000)
    ground = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.normal(-1.75, 0.01, 4000)])
    parts = [ground]
    for corners in box_corners(labels.boxes):
        weights = rng.dirichlet(np.ones(8) * 0.4, 60)
        parts.append((0.98 * weights + 0.02 / 8) @ corners)
    walls = rng.uniform([36, -25, -1.7], [40, 25, 4], (800, 3))
    points = np.concatenate([*parts, walls])
    return np.column_stack([points, rng.uniform(0, 1, len(points))]).astype(np.float32)


def write_plain_folder(root: Path, frames: int = 4) -> Path:
    """``sensors.yaml``, scans, images, labels; detections beside: ``lidar_results``, ``camera_results``."""
    for i in range(frames):
        name, labels = f"f{i:02d}", boxes_of(i)
        for folder in ("scans", "images/front", "images/left"):
            (root / folder).mkdir(parents=True, exist_ok=True)
        scan_of(labels, i).astype("<f4").tofile(root / "scans" / f"{name}.bin")
        seen = {}
        for camera_name in POSES:
            image = np.full((320, 640, 3), 80, np.uint8)
            found, visible = project_boxes(labels.boxes, camera(camera_name))
            for x1, y1, x2, y2 in found[visible].astype(int):
                image[y1:y2, x1:x2] = (150, 90, 60)
            Image.fromarray(image).save(root / "images" / camera_name / f"{name}.png")
            count = int(visible.sum())
            seen[camera_name] = Detections2D(found[visible], np.full(count, 0.9), labels.labels[visible], CLASSES)
        write_detections_3d(root / "labels" / f"{name}.json", labels)
        write_detections_2d(root / "camera_results" / f"{name}.json", seen)
        ghost = labels.boxes[:1] + np.array([2, 8, 0, 0, 0, 0, 0])
        found3d = Detections3D(
            np.concatenate([labels.boxes, ghost]), np.array([0.8, 0.6, 0.7, 0.5, 0.6]), [0, 0, 0, 1, 0], CLASSES
        )
        write_detections_3d(root / "lidar_results" / f"{name}.json", found3d)
    write_sensors(root)
    return root


def plain_sensors() -> dict:
    cameras = {
        name: {
            "images": f"images/{name}",
            "intrinsics": [300, 300, 320, 160],
            "size": [640, 320],
            "camera_from_lidar": pose.tolist(),
        }
        for name, pose in POSES.items()
    }
    return {"lidars": {"top": {"scans": "scans"}}, "cameras": cameras, "classes": list(CLASSES), "labels": "labels"}


def write_sensors(root: Path, change=lambda values: None) -> None:
    """``sensors.yaml``, changed by a function."""
    values = plain_sensors()
    change(values)
    (root / "sensors.yaml").write_text(yaml.safe_dump(values, sort_keys=False))

"""A small KITTI-layout folder, made from nothing: cars and people on a plane, with results."""

from pathlib import Path

import numpy as np
from PIL import Image

from lcf3d.formats.kitti import (
    KittiObjects,
    objects_from_detections,
    objects_from_detections_2d,
    write_objects,
)
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D
from tests.fusion.scenes import CAR, PEDESTRIAN, car, pedestrian, surface_points

SIZE = (1242, 375)
P2 = np.array([[721.5377, 0, 609.5593, 44.857], [0, 721.5377, 172.854, 0.2164], [0, 0, 1, 0.002746]])
P3 = P2 - np.array([[0, 0, 0, 384.4], [0, 0, 0, 0], [0, 0, 0, 0]])
CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0.06], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])

# what stands in every frame: two cars and a pedestrian
OBJECTS = [car(12, 3), car(22, -4, 0.2), pedestrian(14, -3)]
LABELS = [CAR, CAR, PEDESTRIAN]


def calibration_text() -> str:
    def row(name, values):
        return f"{name}: {' '.join(f'{v:.12e}' for v in np.ravel(values))}\n"

    return (
        "".join(row(f"P{i}", P3 if i == 3 else P2) for i in range(4))
        + row("R0_rect", np.eye(3))
        + row("Tr_velo_to_cam", CAMERA_FROM_LIDAR[:3])
        + row("Tr_imu_to_velo", np.eye(4)[:3])
    )


def left_camera() -> Camera:
    return Camera("left", P2, CAMERA_FROM_LIDAR, *SIZE)


def right_camera() -> Camera:
    return Camera("right", P3, CAMERA_FROM_LIDAR, *SIZE)


def make_kitti(root: Path, frame_ids=("000000", "000001", "night_7")) -> Path:
    """Write the folder and return it; see `make_results` for detections that go with it."""
    training = root / "training"
    for folder in ("calib", "velodyne", "label_2", "image_2"):
        (training / folder).mkdir(parents=True)
    points = np.concatenate([surface_points(OBJECTS), ground()])
    for frame_id in frame_ids:
        (training / "calib" / f"{frame_id}.txt").write_text(calibration_text())
        (training / "velodyne" / f"{frame_id}.bin").write_bytes(points.astype("<f4").tobytes())
        write_objects(training / "label_2" / f"{frame_id}.txt", labels())
        Image.new("RGB", SIZE, (90, 90, 90)).save(training / "image_2" / f"{frame_id}.png")
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "val.txt").write_text("\n".join(frame_ids) + "\n")
    return root


def ground() -> np.ndarray:
    rng = np.random.default_rng(0)
    xy = rng.uniform([2, -20], [50, 20], (4000, 2))
    return np.column_stack([xy, np.full(4000, -1.6), np.full(4000, 0.2)])


def labels() -> KittiObjects:
    """The objects as a label file holds them."""
    detections = Detections3D(OBJECTS, np.ones(3), LABELS, KITTI_CLASSES)
    boxes2d, _ = project_boxes(detections.boxes, left_camera())
    found = objects_from_detections(detections, boxes2d, CAMERA_FROM_LIDAR)
    return KittiObjects(
        found.class_names,
        np.zeros(3),
        np.zeros(3, np.int64),
        found.alpha,
        found.boxes2d,
        found.dimensions,
        found.locations,
        found.rotation_y,
    )


def make_results(root: Path, frame_ids=("000000", "000001", "night_7")) -> tuple[Path, Path]:
    """LiDAR results (the near car and a false one) and camera results (all objects) for `make_kitti`."""
    view = left_camera()
    found3d = Detections3D([OBJECTS[0], car(30, 8)], [0.9, 0.8], [CAR, CAR], KITTI_CLASSES)
    boxes2d, _ = project_boxes(np.array(OBJECTS), view)
    found2d = Detections2D(boxes2d, [0.9, 0.3, 0.8], LABELS, KITTI_CLASSES)
    projected, _ = project_boxes(found3d.boxes, view)
    for frame_id in frame_ids:
        write_objects(
            root / "lidar" / f"{frame_id}.txt", objects_from_detections(found3d, projected, CAMERA_FROM_LIDAR)
        )
        write_objects(root / "camera" / f"{frame_id}.txt", objects_from_detections_2d(found2d))
    return root / "lidar", root / "camera"

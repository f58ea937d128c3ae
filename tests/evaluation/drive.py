"""A made-up KITTI drive with cars, ghosts and pedestrians, and what two imperfect detectors say of it."""

from pathlib import Path

import numpy as np

from lcf3d.formats.kitti import objects_from_detections, objects_from_detections_2d, write_objects
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D

CAR, PEDESTRIAN, CYCLIST = range(3)
CALIBRATION = """P2: 700 0 621 0 0 700 187 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
VIEW = Camera(
    "left",
    np.array([[700.0, 0, 621, 0], [0, 700, 187, 0], [0, 0, 1, 0]]),
    np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    1242,
    375,
)


def write_drive(root: Path, frames: int, seed: int = 0, scans: bool = False) -> tuple[Path, Path]:
    """Write ``training``, ``ImageSets/val.txt`` and two result folders; gives the folders (LiDAR, camera).

    Every frame has three cars and a cyclist. The LiDAR detector finds them with logit scores around 1, and three ghosts
    with scores around 0; the camera finds every car with a score of 0.9 and never a ghost or a cyclist.
    """
    rng = np.random.default_rng(seed)
    for folder in ("calib", "label_2", "velodyne"):
        (root / "training" / folder).mkdir(parents=True)
    names = [f"{i:06d}" for i in range(frames)]
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "val.txt").write_text("\n".join(names))
    for name in names:
        true, ghosts = _boxes(rng, 4, y0=-6.0), _boxes(rng, 3, y0=-4.5)
        labels = np.array([CAR, CAR, CAR, CYCLIST])
        (root / "training" / "calib" / f"{name}.txt").write_text(CALIBRATION)
        truth = Detections3D(true, np.ones(4), labels, KITTI_CLASSES)
        write_objects(root / "training" / "label_2" / f"{name}.txt", _objects(truth, scores=False))
        found = Detections3D(
            np.concatenate([true, ghosts]),
            np.concatenate([rng.normal(1, 1, 4), rng.normal(0, 1, 3)]),
            np.append(labels, [CAR, CAR, CYCLIST]),
            KITTI_CLASSES,
        )
        write_objects(root / "lidar" / f"{name}.txt", _objects(found, scores=True))
        seen, _ = project_boxes(true[:3], VIEW)
        jitter = seen + rng.normal(0, 0.5, seen.shape)
        camera = Detections2D(jitter, np.full(3, 0.9), labels[:3], KITTI_CLASSES)
        write_objects(root / "camera" / f"{name}.txt", objects_from_detections_2d(camera))
        if scans:
            np.zeros((20, 4), np.float32).tofile(root / "training" / "velodyne" / f"{name}.bin")
    return root / "lidar", root / "camera"


def _boxes(rng: np.random.Generator, count: int, y0: float) -> np.ndarray:
    x = rng.uniform(12, 25) + 3.0 * np.arange(count)
    y = y0 + 3.5 * np.arange(count)
    return np.column_stack([x, y, np.full(count, -0.9), *np.tile([[4.0], [1.7], [1.5], [0.0]], count)])


def _objects(detections, scores):
    projected, _ = project_boxes(detections.boxes, VIEW)
    objects = objects_from_detections(detections, projected, VIEW.camera_from_lidar)
    if scores:
        return objects
    import dataclasses

    zeros = np.zeros(len(objects))
    return dataclasses.replace(objects, scores=None, truncated=zeros, occluded=zeros.astype(np.int64))

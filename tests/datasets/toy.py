"""A dataset of somebody else, in one class: what `lcf3d.datasets.base` says is enough."""

import json
from pathlib import Path

import numpy as np

from lcf3d.datasets.base import BaseDataset, require_folder
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Camera, Detections2D, Detections3D

CLASSES = ("car", "person")
FRONT = Camera(
    "front",
    np.array([[500.0, 0, 400, 0], [0, 500, 200, 0], [0, 0, 1, 0]]),
    np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    800,
    400,
)


class ToyDataset(BaseDataset):
    """``toy:ROOT`` with ``ROOT/ID.json`` a frame: ``{"boxes": [[x, y, z, l, w, h, yaw], ...], "labels": [...]}``."""

    class_names = CLASSES
    camera_names = ("front",)

    def __init__(self, root: str, split: str | None = None) -> None:
        self.root = require_folder(Path(root))
        ids = sorted(path.stem for path in self.root.glob("*.json"))
        self.ids = tuple(ids if split is None else ids[:: 1 + (split == "half")])

    def frame(self, frame_id: str) -> Frame:
        values = json.loads((self.root / f"{frame_id}.json").read_text())
        labels = Detections3D(values["boxes"], np.ones(len(values["boxes"])), values["labels"], CLASSES)
        points = np.column_stack([labels.boxes[:, :3], np.ones(len(labels))]).astype(np.float32)
        image = np.full((400, 800, 3), 90, np.uint8)
        return Frame(frame_id, points, [FRONT], {"front": image}, labels)


def write_toy(root: Path, frames: int) -> None:
    """Frames with three cars and a person each, in different places, and results of two detectors.

    ``lidar`` has everything and a ghost beside each car; ``camera`` sees all but the ghosts.
    """
    from lcf3d.formats.plain import write_detections_2d, write_detections_3d

    rng = np.random.default_rng(0)
    (root / "data").mkdir(parents=True)
    for i in range(frames):
        x = rng.uniform(12, 18, 4) + np.array([0, 8, 16, 0])
        cars = np.column_stack([x[:3], [-4, 0, 5], np.full(3, -1), np.tile([4, 1.8, 1.5, 0], (3, 1))])
        person = np.array([[x[3], 5, -0.8, 0.7, 0.7, 1.7, 0.0]])
        boxes, labels = np.concatenate([cars, person]), np.array([0, 0, 0, 1])
        values = {"boxes": boxes.tolist(), "labels": labels.tolist()}
        (root / "data" / f"f{i:02d}.json").write_text(json.dumps(values))
        ghosts = cars + np.array([3, 7, 0, 0, 0, 0, 0])
        scores = np.concatenate([rng.uniform(0.4, 0.9, 4), rng.uniform(0.4, 0.9, 3)])
        found = Detections3D(np.concatenate([boxes, ghosts]), scores, np.append(labels, [0, 0, 0]), CLASSES)
        write_detections_3d(root / "lidar" / f"f{i:02d}.json", found)
        seen = Detections2D(project_boxes(boxes, FRONT)[0], np.full(4, 0.9), labels, CLASSES)
        write_detections_2d(root / "camera" / f"f{i:02d}.json", {"front": seen})

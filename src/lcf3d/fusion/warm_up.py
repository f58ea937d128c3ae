"""A made-up frame on which every stage of the fusion has something to do, so that the first real one need not wait."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Camera, Detections2D, Detections3D


def warm_up_frame(class_names: Sequence[str]) -> tuple[Frame, Detections3D, dict[str, Detections2D]]:
    """A car that both branches see, one that the camera alone sees, and one that the LiDAR branch alone reports."""
    camera_from_lidar = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    projection = np.array([[700.0, 0, 620, 0], [0, 700, 190, 0], [0, 0, 1, 0]])
    camera = Camera("warm-up", projection, camera_from_lidar, 1240, 380)
    boxes = np.array([[x, y, -0.8, 4.0, 1.7, 1.5, 0.1] for x, y in ((15.0, -4.0), (20.0, 5.0), (30.0, 0.0))])
    side = np.linspace(-0.5, 0.5, 12)
    faces = [boxes[i, :3] + np.array([-2.0, 1.7 * u, 1.5 * v]) for i in range(3) for u in side for v in side]
    ground = [np.array([x, y, -1.6]) for x in np.arange(4.0, 40, 0.5) for y in np.arange(-8.0, 8, 0.5)]
    points = np.column_stack([np.array([*faces, *ground]), np.full(len(faces) + len(ground), 0.3)])
    names, label = tuple(class_names), np.zeros(2, dtype=np.int64)
    lidar = Detections3D(boxes[[0, 2]], np.array([0.8, 0.4]), label, names)
    seen = Detections2D(project_boxes(boxes[:2], camera)[0], np.array([0.9, 0.9]), label, names)
    return Frame("warm-up", points.astype(np.float32), [camera]), lidar, {"warm-up": seen}

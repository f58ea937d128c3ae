"""A camera and a fusion result small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from lcf3d.decisions import Decisions
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import Camera, Detections2D, Detections3D

# camera x right, y down, z forward, at the LiDAR's origin
CAMERA_FROM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=float)


def make_camera(name: str = "left", turn: float = 0.0, width: int = 200, height: int = 100) -> Camera:
    """Focal length 100 px, looking forward or turned to the left by ``turn`` radians."""
    projection = np.array([[100, 0, width / 2, 0], [0, 100, height / 2, 0], [0, 0, 1, 0]], dtype=float)
    rotation = np.eye(4)
    rotation[:2, :2] = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    return Camera(name, projection, CAMERA_FROM_LIDAR @ rotation, width, height)


@pytest.fixture
def camera() -> Camera:
    return make_camera()


@pytest.fixture
def fused() -> FusedDetections:
    """LiDAR boxes: 0 matched, 1 downweighted, 2 dropped, 3 below the score threshold; 2D: 0 matched, 1 recovered,
    2 with few points, 3 below the score threshold."""
    names = ("Car", "Pedestrian")
    boxes = np.array([[x, y, 0, 4, 2, 1.5, 0] for x, y in ((10, 0), (20, 5), (20, -5), (30, 0))], dtype=float)
    lidar = Detections3D(boxes, np.array([0.9, 0.8, 0.7, 0.01]), np.zeros(4, int), names)
    image_boxes = np.array([[70, 30, 130, 60], [150, 40, 160, 60], [20, 40, 30, 60], [1, 1, 2, 2]], dtype=float)
    camera = Detections2D(image_boxes, np.array([0.9, 0.6, 0.5, 0.1]), np.array([0, 1, 1, 0]), names)
    outputs = Detections3D(
        np.concatenate([boxes[:2], [[15, -6, 0, 1, 1, 1.8, 0]]]), np.array([0.95, 0.4, 0.3]), np.array([0, 0, 1]), names
    )
    lidar_table, camera_table = Decisions.blank(4), Decisions.blank(4)
    lidar_table.lidar[:] = range(4)
    lidar_table.outcome[:2] = Outcome.MATCHED, Outcome.KEPT
    lidar_table.reason[:3] = Reason.CONFIRMED, Reason.DOWNWEIGHTED, Reason.UNCONFIRMED
    lidar_table.output[:2] = 0, 1
    camera_table.camera[:], camera_table.detection[:] = 0, range(4)
    camera_table.outcome[:2] = Outcome.MATCHED, Outcome.RECOVERED
    camera_table.reason[:3] = Reason.CONFIRMED, Reason.LOCALIZED, Reason.FEW_POINTS
    camera_table.output[:2] = 0, 2
    return FusedDetections(outputs, lidar_table, camera_table, lidar, (camera,), ("left",))

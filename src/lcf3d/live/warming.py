"""Everything once on made-up input, before the first real frame comes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lcf3d.frame import Frame
from lcf3d.fusion.alignment import Alignment
from lcf3d.fusion.alignment_matching import Sighting
from lcf3d.fusion.alignment_watch import estimate
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Camera, Detections2D, Detections3D


def warm_up(fusion: LateCascadeFusion, cameras: Sequence[Camera], detectors: Mapping[str, Any]) -> None:
    """Run the fusion with a match and a recovery, the watch, and each detector, so that all is loaded and compiled.

    Args:
        fusion: the fusion.
        cameras: the cameras; a made-up one without any.
        detectors: by source: ``scan`` or ``camera NAME``.
    """
    names = fusion.config.class_names
    points = _cloud()
    for view in cameras or [_camera()]:
        boxes = np.array([_ahead(view, 15.0, -3.0), _ahead(view, 20.0, 4.0)])
        lidar = Detections3D(boxes[:1], np.array([0.9]), np.zeros(1, np.int64), names, np.array([[1.0, 0.0]]))
        projected, visible = project_boxes(boxes, view)
        found = Detections2D(projected[visible], np.full(visible.sum(), 0.9), np.zeros(visible.sum(), np.int64), names)
        around = np.concatenate([points, (points * [0.1, 0.1, 0.1, 1] + [*boxes[1, :3], 0]).astype(np.float32)])
        fusion(Frame("warm-up", around, [view]), lidar, {view.name: found})
        estimate([Sighting.of(view, lidar, found, np.zeros((1, 3)))], Alignment.nominal(), time=True)
    for source, detector in detectors.items():
        if source == "scan":
            detector(points)
        for camera in cameras:
            if source == f"camera {camera.name}":
                detector([np.zeros((camera.height, camera.width, 3), np.uint8)])


def _ahead(camera: Camera, depth: float, aside: float) -> list[float]:
    """A car so far ahead of a camera, in the LiDAR frame."""
    x, y, z, _ = np.linalg.inv(camera.camera_from_lidar) @ [aside, 0.5, depth, 1]
    return [float(x), float(y), float(z), 4.0, 1.8, 1.6, 0.3]


def _camera() -> Camera:
    axes = np.eye(4)
    axes[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    return Camera("warm-up", np.array([[500.0, 0, 500, 0], [0, 500, 200, 0], [0, 0, 1, 0]]), axes, 1000, 400)


def _cloud() -> np.ndarray[Any, np.dtype[np.float32]]:
    """A ground and points around the origin."""
    rng = np.random.default_rng(0)
    ground = rng.uniform([-40, -40, -1.75, 0], [40, 40, -1.65, 1], (20000, 4))
    around = rng.uniform([-10, -10, -8, 0], [10, 10, 8, 1], (4000, 4))
    return np.concatenate([ground, around]).astype(np.float32)

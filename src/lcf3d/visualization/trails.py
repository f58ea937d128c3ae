"""Where tracked objects have been: the last seconds of each, in the frame of the present scan."""

from __future__ import annotations

from collections import deque

import numpy as np

from lcf3d.frame import Frame
from lcf3d.geometry.rotation import invert_rigid, transform_points
from lcf3d.provenance import FusedDetections
from lcf3d.structures import FloatArray

SECONDS = 2.0


class Trails:
    """Remembers where the tracks of a drive were, frame after frame in order of time.

    Frames without a time or a pose leave no trail, and a step back in time or another drive begins anew.

    Args:
        seconds: how far back trails reach.
    """

    def __init__(self, seconds: float = SECONDS) -> None:
        self.seconds = seconds
        self._sequence: str | None = None
        self._past: deque[tuple[float, dict[int, FloatArray]]] = deque()

    def __call__(self, frame: Frame, fused: FusedDetections) -> list[FloatArray]:
        """For each output its way (K, 3) in the LiDAR frame, the oldest place first and the present one last."""
        none = [np.zeros((0, 3))] * len(fused)
        if fused.tracks is None or frame.timestamp is None or frame.world_from_lidar is None:
            return none
        if frame.sequence != self._sequence or (self._past and frame.timestamp <= self._past[-1][0]):
            self._past.clear()
        self._sequence = frame.sequence
        ids = fused.tracks.ids.tolist()
        there = transform_points(fused.detections.boxes[:, :3], frame.world_from_lidar)
        self._past.append((frame.timestamp, dict(zip(ids, there, strict=True))))
        while frame.timestamp - self._past[0][0] > self.seconds:
            self._past.popleft()
        lidar_from_world = invert_rigid(frame.world_from_lidar)
        ways = (np.array([places[own] for _, places in self._past if own in places]) for own in ids)
        return [transform_points(way, lidar_from_world) for way in ways]

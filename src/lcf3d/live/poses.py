"""Where the LiDAR was at any moment, from the ego poses of a stream."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort

import numpy as np

from lcf3d.fusion.alignment import STANDING
from lcf3d.geometry.rotation import interpolated, invert_rigid
from lcf3d.structures import Detections3D, FloatArray

# beyond the newest pose the last motion is carried on for so long (seconds)
CARRY_ON = 0.25
# the last motion is that of so long (seconds): poses that follow each other closely have too much noise to tell
BASE = 0.1
# poses older than this before the newest are forgotten
KEPT = 5.0
# answers that are kept between two poses
MOST_ANSWERS = 256


class PoseBuffer:
    """Ego poses by time, interpolated between two and carried on for a moment beyond the newest."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._poses: dict[float, FloatArray] = {}
        # what was asked for since the newest pose: every camera of a moment asks for the scan's
        self._answers: dict[float, FloatArray | None] = {}

    def __len__(self) -> int:
        return len(self._times)

    @property
    def newest(self) -> float:
        """Time of the newest pose, minus infinity without any."""
        return self._times[-1] if self._times else -np.inf

    def add(self, time: float, world_from_lidar: FloatArray) -> None:
        """Take a pose in, in any order; a second one of the same time is left out."""
        if time not in self._poses:
            insort(self._times, time)
            self._poses[time] = np.asarray(world_from_lidar, dtype=np.float64)
            self._answers.clear()
        while self._times[0] < self._times[-1] - KEPT:
            del self._poses[self._times.pop(0)]

    def at(self, time: float) -> FloatArray | None:
        """(4, 4) ``world_from_lidar`` at a moment; None where no poses are near enough."""
        if time not in self._answers:
            if len(self._answers) >= MOST_ANSWERS:
                self._answers.clear()
            self._answers[time] = self._at(time)
        return self._answers[time]

    def _at(self, time: float) -> FloatArray | None:
        if not self._times:
            return None
        i = bisect_left(self._times, time)
        if i < len(self._times) and self._times[i] == time:
            return self._poses[time]
        if len(self._times) < 2 or time < self._times[0] or time > self._times[-1] + CARRY_ON:
            return None
        if i == len(self._times):
            i -= 1
            before = self._times[max(bisect_right(self._times, self._times[i] - BASE) - 1, 0)]
        else:
            before = self._times[i - 1]
        after = self._times[i]
        return interpolated(self._poses[before], self._poses[after], (time - before) / (after - before))

    def motion(self, earlier: float, later: float) -> FloatArray | None:
        """(4, 4) ``lidar_at_later_from_lidar_at_earlier``; None where a pose is missing."""
        first, second = self.at(earlier), self.at(later)
        return None if first is None or second is None else np.asarray(invert_rigid(second) @ first)


def relative_velocities(lidar: Detections3D, motion: FloatArray, seconds: float) -> FloatArray:
    """(N, 3) m/s of boxes as seen from a LiDAR that makes a (4, 4) motion in some seconds, in its axes.

    Noise in the velocities of things that stand would make every time offset look smaller: slow ones count as none.
    """
    centres = lidar.boxes[:, :3]
    relative = (centres @ motion[:3, :3].T + motion[:3, 3] - centres) / seconds
    if lidar.velocities is not None:
        moving = np.nan_to_num(lidar.velocities)
        relative[:, :2] += np.where(np.hypot(moving[:, :1], moving[:, 1:]) > STANDING, moving, 0)
    return np.asarray(relative)

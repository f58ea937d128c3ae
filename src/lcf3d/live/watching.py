"""Moments of a stream for the calibration watch: thinned out, held until the car's motion is known, in their thread."""

from __future__ import annotations

from collections import deque
from threading import RLock
from typing import Any

import numpy as np

from lcf3d.frame import Frame
from lcf3d.fusion.alignment_watch import AlignmentWatch
from lcf3d.live.health import Health
from lcf3d.live.poses import PoseBuffer, relative_velocities
from lcf3d.live.workers import Worker
from lcf3d.structures import Detections2D, Detections3D, FloatArray

# no moment waits longer than this (seconds)
LONGEST_OFFSET = 0.5


class WatchFeed:
    """Shows the watch one moment after the other.

    Args:
        watch: the watch.
        poses: where the car was.
        period: seconds from one moment that it sees to the next.
        workers: of the `Fuser`; in real time the watch has one of its own and skips what it has no time for. None to
            show a moment at once.
        lock: of the `Fuser`.
        health: is told when the watch fails.
    """

    def __init__(
        self,
        watch: AlignmentWatch,
        poses: PoseBuffer,
        period: float,
        workers: dict[str, Worker] | None,
        lock: RLock,
        health: Health,
    ) -> None:
        self.watch = watch
        self._poses, self._period, self._workers, self._lock, self._health = poses, period, workers, lock, health
        self._latest = -np.inf
        self._waiting: deque[tuple[float, Frame, Detections3D, dict[str, Detections2D]]] = deque()

    def offer(self, time: float, nominal: Frame, lidar: Detections3D, found: dict[str, Detections2D]) -> None:
        """A moment that was fused; ``nominal`` has the cameras as calibrated."""
        if not 0 <= time - self._latest < 0.9 * self._period:
            self._latest = time
            self._waiting.append((time, nominal, lidar, found))

    def advance(self, everything: bool) -> None:
        """Show what waits. For a time offset a moment waits until the car's motion to the true moment is known."""
        while self._waiting:
            time, frame, lidar, found = self._waiting[0]
            if self.watch.settings.time and len(self._poses) and not everything:
                ahead = max([0.0, *(self.watch.estimate(camera.name).time_offset for camera in frame.cameras)])
                if self._poses.newest < time + ahead and 0 <= self._latest - time <= LONGEST_OFFSET:
                    return
            self._waiting.popleft()
            self._show(time, frame, lidar, found)

    def _show(self, time: float, frame: Frame, lidar: Detections3D, found: dict[str, Detections2D]) -> None:
        def work(_: Any) -> None:
            self.watch.observe(frame, lidar, found, lambda ahead: self._velocities(time, lidar, ahead))

        def done(_: Any, result: Any, error: Exception | None, spent: float) -> None:
            if error is not None:
                with self._lock:
                    self._health.failed("watch", error)

        if self._workers is None:
            work(None)
            return
        if "watch" not in self._workers:
            self._workers["watch"] = Worker("watch", lambda task: task(None), done)
        self._workers["watch"].submit(work)

    def _velocities(self, time: float, lidar: Detections3D, ahead: float) -> FloatArray | None:
        """(N, 3) m/s of boxes as seen from the moving LiDAR, in its axes, on average over some seconds after a scan.

        None without poses or the wish for it. Less than 50 ms are taken as the 50 ms before the scan.
        """
        if not self.watch.settings.time:
            return None
        step = ahead if abs(ahead) > 0.05 else -0.05
        with self._lock:
            motion = self._poses.motion(time, time + step)
        return None if motion is None else relative_velocities(lidar, motion, step)

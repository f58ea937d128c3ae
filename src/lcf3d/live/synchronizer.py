"""Messages of several sensors grouped into moments, by their own times and not by the order in which they come."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.live.counting import Tally
from lcf3d.structures import Detections2D, Detections3D

# a sensor whose time is further than this from the LiDAR's has another clock (seconds)
CLOCK_LIMIT = 5.0
# the same of one that is ahead, which no waiting explains, unless the deadline is longer
AHEAD = 1.0
# messages of one camera that are kept at most
MOST_MESSAGES = 64


@dataclass(frozen=True)
class SyncSettings:
    """How messages are grouped.

    Attributes:
        offsets: seconds that a camera looks after the scan by design, by camera name; 0 for those not named.
        tolerance: a camera's message this near to its moment (seconds) belongs to the scan. Less than half of the
            camera's period, so that the group does not depend on which of two came first.
        deadline: a group is closed when the stream is this much further (seconds), whatever is missing.
        scans: wait for the scan, as recovery needs it.
        poses: wait for an ego pose of every moment.
        most_pending: groups that may be open at the same time; beyond it the oldest is dropped and counted.
    """

    offsets: Mapping[str, float] = field(default_factory=dict)
    tolerance: float = 0.04
    deadline: float = 0.2
    scans: bool = True
    poses: bool = False
    most_pending: int = 16

    def __post_init__(self) -> None:
        if not (self.tolerance > 0 and self.deadline > 0 and self.most_pending > 0):
            raise ConfigError(
                "tolerance, deadline and most_pending must be above 0, got "
                f"{self.tolerance} s, {self.deadline} s and {self.most_pending}"
            )
        latest = max([0.0, *self.offsets.values()]) + 2 * self.tolerance
        if self.deadline < latest:
            raise ConfigError(
                f"a deadline of {self.deadline} s is before the last camera may come: with these offsets and tolerance "
                f"it must be {latest:.3g} s or more"
            )


class CameraPart(NamedTuple):
    """What one camera gave to a group: its time, 2D detections, the image if there was one, arrival (own clock)."""

    time: float
    detections: Detections2D
    pixels: NDArray[np.uint8] | None
    arrival: float


@dataclass
class Group:
    """The parts of one moment.

    Attributes:
        time: of the scan.
        arrival: when its first LiDAR message came (own clock, seconds).
        last_arrival: when the last part came that it was waiting for.
        lidar: 3D detections.
        points: the scan.
        cameras: the parts of cameras, by name.
    """

    time: float
    arrival: float
    last_arrival: float = 0.0
    lidar: Detections3D | None = None
    points: NDArray[np.float32] | None = None
    cameras: dict[str, CameraPart] = field(default_factory=dict)


class Synchronizer:
    """Groups by the times of the messages alone: it never looks at a clock of its own.

    Args:
        settings: see `SyncSettings`.
        dropped: counts what is left out; a new one without it.

    Attributes:
        dropped: how many messages were left out, by ``(source, cause)``; causes are ``late``, ``clock``,
            ``no lidar`` (the LiDAR has been silent for long), ``duplicate``, ``broken`` (its time is no number, or its
            data has no such shape), ``overflow`` and ``busy`` (its detector was at another message).
        clocks: seconds that the clock of a source is ahead of the LiDAR's, by source, where that is too much.
        closed: time of the newest group that was handed out.
        restarts: how often time went back by more than `CLOCK_LIMIT` and everything began anew.
    """

    def __init__(self, settings: SyncSettings, dropped: Tally[tuple[str, str]] | None = None) -> None:
        self.settings = settings
        self.dropped: Tally[tuple[str, str]] = Tally() if dropped is None else dropped
        self.clocks: dict[str, float] = {}
        self.restarts = 0
        self._groups: dict[float, Group] = {}
        self._cameras: dict[str, dict[float, CameraPart]] = {}
        self._watermark = -np.inf
        self._newest_lidar: float | None = None
        # of every other source, the time of its newest message that fitted the LiDAR's clock
        self._fitted: dict[str, float] = {}
        # a message further ahead of the LiDAR's than this is no late LiDAR any more
        self._ahead = min(CLOCK_LIMIT, max(AHEAD, 2 * settings.deadline))
        self.closed = -np.inf

    @property
    def pending(self) -> int:
        """How many groups are open."""
        return len(self._groups)

    def admit(self, source: str, time: float) -> bool:
        """Whether a message of that time can be used at all; counts it as dropped if not."""
        if not np.isfinite(time):
            return self._drop(source, "broken")
        of_lidar = source in ("lidar", "scan")
        if of_lidar:
            if self._newest_lidar is not None and time < self._newest_lidar - CLOCK_LIMIT:
                self._restart()
            if time <= self.closed:
                return self._drop(source, "late")
            self._newest_lidar = time if self._newest_lidar is None else max(self._newest_lidar, time)
        elif self._newest_lidar is not None:
            if not -CLOCK_LIMIT <= time - self._newest_lidar <= self._ahead:
                return self._misfit(source, time, time - self._newest_lidar)
            self.clocks.pop(source, None)
            self._fitted[source] = max(time, self._fitted.get(source, time))
        # what came before the LiDAR's first message may have another clock
        self._watermark = time if of_lidar and time < self._watermark - self._ahead else max(self._watermark, time)
        return True

    def _misfit(self, source: str, time: float, lead: float) -> bool:
        """A message far from the LiDAR's newest: the LiDAR has fallen silent, or a clock is off."""
        if source in self._fitted and 0 < time - self._fitted[source] <= self._ahead:
            # it goes on as it did; the LiDAR does not
            self._fitted[source] = time
            return self._drop(source, "no lidar")
        self._fitted.pop(source, None)
        self.clocks.setdefault(source, lead)
        return self._drop(source, "clock")

    def add_lidar(self, time: float, detections: Detections3D, arrival: float) -> None:
        """3D detections of a scan; `admit` has let them in."""
        group = self._group(time, arrival)
        if group.lidar is not None:
            self._drop("lidar", "duplicate")
            return
        group.lidar, group.last_arrival = detections, max(group.last_arrival, arrival)

    def add_scan(self, time: float, points: NDArray[np.float32], arrival: float) -> None:
        """A scan; `admit` has let it in."""
        group = self._group(time, arrival)
        if group.points is not None:
            self._drop("scan", "duplicate")
            return
        group.points, group.last_arrival = points, max(group.last_arrival, arrival)

    def add_camera(self, camera: str, part: CameraPart) -> None:
        """2D detections of a camera; `admit` has let them in."""
        parts = self._cameras.setdefault(camera, {})
        source = f"camera {camera}"
        if part.time in parts:
            self._drop(source, "duplicate")
        elif part.time <= self.closed + self._offset(camera) - self.settings.tolerance:
            self._drop(source, "late")
        else:
            parts[part.time] = part
            if len(parts) > MOST_MESSAGES:
                del parts[min(parts)]
                self._drop(source, "overflow")

    def ready(self, expected: frozenset[str], newest_pose: float, everything: bool = False) -> list[Group]:
        """Groups that are complete, or past their deadline, in order of time; they are handed out once.

        Args:
            expected: the cameras that are waited for.
            newest_pose: time of the newest ego pose.
            everything: close all groups, as at the end of a stream.
        """
        done = []
        for time in sorted(self._groups):
            group = self._groups[time]
            over = everything or self._watermark > time + self.settings.deadline
            if not (over or self._complete(group, expected, newest_pose)):
                break
            del self._groups[time]
            self._close(group)
            if group.lidar is None:
                self._drop("lidar", "late")
                continue
            done.append(group)
        while len(self._groups) > self.settings.most_pending:
            del self._groups[min(self._groups)]
            self._drop("lidar", "overflow")
        return done

    def overdue(self, before: float) -> None:
        """Let the deadline of all groups whose LiDAR message arrived before that moment (own clock) be past."""
        times = [group.time for group in self._groups.values() if group.arrival <= before]
        if times:
            self._watermark = max(self._watermark, max(times) + self.settings.deadline + 1e-9)

    def _group(self, time: float, arrival: float) -> Group:
        if time not in self._groups:
            self._groups[time] = Group(time, arrival)
        return self._groups[time]

    def _offset(self, camera: str) -> float:
        return float(self.settings.offsets.get(camera, 0.0))

    def _nearest(self, camera: str, time: float) -> CameraPart | None:
        """The camera's message nearest to its moment of a scan, within the tolerance; the earlier of two as near."""
        moment = time + self._offset(camera)
        near = [t for t in self._cameras.get(camera, {}) if abs(t - moment) <= self.settings.tolerance]
        return self._cameras[camera][min(near, key=lambda t: (abs(t - moment), t))] if near else None

    def _complete(self, group: Group, expected: frozenset[str], newest_pose: float) -> bool:
        if group.lidar is None or (self.settings.scans and group.points is None):
            return False
        parts = [self._nearest(camera, group.time) for camera in expected]
        if any(part is None for part in parts):
            return False
        last = max([group.time, *(part.time for part in parts if part is not None)])
        return not self.settings.poses or newest_pose >= last

    def _close(self, group: Group) -> None:
        """Give a group its camera parts; forget what no later group can use."""
        self.closed = max(self.closed, group.time)
        for camera, parts in self._cameras.items():
            part = self._nearest(camera, group.time)
            if part is not None:
                group.cameras[camera] = part
                group.last_arrival = max(group.last_arrival, part.arrival)
            for time in [t for t in parts if t <= group.time + self._offset(camera) - self.settings.tolerance]:
                del parts[time]

    def _restart(self) -> None:
        self.restarts += 1
        self._groups.clear()
        self._cameras.clear()
        self._fitted.clear()
        self.clocks.clear()
        self.closed = self._watermark = -np.inf
        self._newest_lidar = None

    def _drop(self, source: str, cause: str) -> bool:
        self.dropped.add((source, cause))
        return False

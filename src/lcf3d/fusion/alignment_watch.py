"""A watch over each camera's stand against the LiDAR, frame by frame (METHOD "Calibration watch"; beyond the paper)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import SHRINKAGE, TIME, Alignment, BoxPairs, fit_alignment, realigned
from lcf3d.fusion.alignment_matching import Matcher, Sighting, match_sighting, vote_rotation
from lcf3d.structures import Camera, Detections2D, Detections3D, FloatArray

Status = Literal["unknown", "ok", "drifting", "wrong"]

# image IoU of a match while a camera may still be far off, and when it is nearly right
COARSE_IOU, FINE_IOU = 0.3, 0.5
# the vote is believed when its matches overlap by this factor more than those of the estimate so far
BETTER = 1.1
# frames that follow each other show the same objects: so many count as one
CORRELATED = 5
# with fewer pairs than this nothing is said; the same of time, which a rotation is easily taken for
FEWEST_PAIRS, FEWEST_TIMED = 12, 60
# no detector draws its boxes by such a share tighter or wider: matches that ask for it are of other objects
IMPLAUSIBLE = 0.15


@dataclass(frozen=True)
class WatchSettings:
    """Settings of `AlignmentWatch`.

    Attributes:
        window: frames that an estimate rests on.
        recent: so many latest frames are also looked at alone: where they surely differ, the older are forgotten.
        every: frames between two estimates.
        drifting_deg: a rotation surely above this is called drifting.
        wrong_deg: a rotation surely above this is called wrong.
        sure: how many standard deviations "surely" is.
        time: also estimate the time offset.
        late_s: a time offset surely above this is called drifting, above four times this wrong; judged only where it
            is known to half of this.
    """

    window: int = 50
    recent: int = 10
    every: int = 5
    drifting_deg: float = 0.2
    wrong_deg: float = 1.0
    sure: float = 2.0
    time: bool = False
    late_s: float = 0.02

    def __post_init__(self) -> None:
        if self.window < 1 or self.every < 1 or not 0 < self.drifting_deg <= self.wrong_deg:
            raise ConfigError(
                f"the calibration watch needs a window and a step of at least 1 frame and 0 < drifting <= wrong "
                f"degrees, got window {self.window}, every {self.every}, {self.drifting_deg}, {self.wrong_deg}"
            )


@dataclass(frozen=True, eq=False)
class CameraReport:
    """What the watch says of one camera.

    Attributes:
        status: ``ok``, ``drifting``, ``wrong``, or ``unknown`` while there are too few pairs to tell.
        alignment: the estimate.
        frames: frames it rests on.
    """

    status: Status
    alignment: Alignment
    frames: int

    def to_json(self) -> dict[str, Any]:
        """Plain values: degrees, metres, milliseconds, each with its standard deviation."""
        state, deviation = self.alignment.state, self.alignment.deviation
        angles = {
            name: {"deg": round(float(np.rad2deg(state[i])), 4), "deviation": round(float(np.rad2deg(deviation[i])), 4)}
            for i, name in enumerate(("pitch", "yaw", "roll"))
        }
        return {
            "status": self.status,
            **angles,
            "displacement_m": [round(float(v), 4) for v in state[3:6]],
            "displacement_deviation_m": [round(float(v), 4) for v in deviation[3:6]],
            "time_offset_ms": round(1e3 * self.alignment.time_offset, 2),
            "time_offset_deviation_ms": round(1e3 * float(deviation[TIME]), 2),
            "pairs": self.alignment.pairs,
            "frames": self.frames,
        }


class AlignmentWatch:
    """Estimates each camera's rotation against the LiDAR over a sliding window of frames.

    Args:
        class_names: the classes that take part, by name in both branches.
        settings: see `WatchSettings`.
        pause: called every fraction of a millisecond or so of an estimate; a watch in a thread of its own waits there
            while others have something more urgent to do.

    Example:
        >>> watch = AlignmentWatch(("Car", "Pedestrian"))  # doctest: +SKIP
        >>> watch.observe(frame, lidar, {"left": camera})  # doctest: +SKIP
        >>> watch.report("left").status  # doctest: +SKIP
        'ok'
    """

    def __init__(
        self,
        class_names: Iterable[str],
        settings: WatchSettings | None = None,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        self.class_names = tuple(class_names)
        self.settings = settings or WatchSettings()
        self._pause = pause
        self._sightings: dict[str, deque[Matcher]] = {}
        self._estimates: dict[str, Alignment] = {}
        self._seen: dict[str, int] = {}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that were observed so far, in order of their first frame."""
        return tuple(self._sightings)

    def observe(
        self,
        frame: Frame,
        lidar: Detections3D,
        camera: Mapping[str, Detections2D],
        velocities: Callable[[float], FloatArray | None] | None = None,
    ) -> None:
        """Take one frame in; every `WatchSettings.every` frames of a camera its estimate is renewed.

        Args:
            frame: with the cameras as their calibration says, not corrected.
            lidar: 3D detections; scores of any scale.
            camera: 2D detections by camera.
            velocities: for the time offset: gives (N, 3) m/s of the boxes as seen from the car, in the LiDAR frame, on
                average over so many seconds after the scan; or None where they are not known.
        """
        boxes = lidar.with_classes(self.class_names)
        wanted = np.isin(np.array(lidar.class_names), self.class_names)[lidar.labels] if len(lidar) else slice(None)
        for view in frame.cameras:
            if view.name in camera:
                ahead = self.estimate(view.name).time_offset
                speeds = None if velocities is None else velocities(ahead)
                speeds = None if speeds is None else speeds[wanted]
                self._observe_camera(view, boxes, camera[view.name].with_classes(self.class_names), speeds)

    def _observe_camera(
        self, view: Camera, boxes: Detections3D, found: Detections2D, velocities: FloatArray | None
    ) -> None:
        kept = self._sightings.setdefault(view.name, deque(maxlen=self.settings.window))
        count = self._seen.get(view.name, 0)
        self._seen[view.name] = count + 1
        self._pause()
        kept.append(Matcher(Sighting.of(view, boxes, found, velocities, count // CORRELATED)))
        # the cameras take turns, so that no frame has to wait for all of them
        if (count + 1 + list(self._sightings).index(view.name)) % self.settings.every == 0:
            self._renew(view.name, kept)

    def _renew(self, name: str, kept: deque[Matcher]) -> None:
        """A new estimate, of the latest frames alone if the camera has just moved."""
        settings, matchers = self.settings, list(kept)
        before = self.estimate(name)
        renewed = _estimate(matchers, before, time=settings.time, pause=self._pause)
        if len(matchers) > settings.recent:
            latest = _estimate(matchers[-settings.recent :], renewed, time=settings.time, pause=self._pause)
            moved = latest.surely_beyond(settings.sure, renewed)
            if latest.pairs >= FEWEST_PAIRS and np.rad2deg(moved) > settings.drifting_deg:
                while len(kept) > settings.recent:
                    kept.popleft()
                renewed = latest
        self._estimates[name] = renewed

    def forget(self, camera: str) -> None:
        """Begin anew with a camera, as after a new calibration."""
        for kept in (self._sightings, self._estimates, self._seen):
            kept.pop(camera, None)  # type: ignore[attr-defined]

    def estimate(self, camera: str) -> Alignment:
        """The estimate so far."""
        return self._estimates.get(camera, Alignment.nominal())

    def report(self, camera: str) -> CameraReport:
        """What is known of a camera now."""
        alignment = self.estimate(camera)
        return CameraReport(judge(alignment, self.settings), alignment, len(self._sightings.get(camera, ())))

    def corrected(self, camera: Camera) -> Camera:
        """The camera turned as estimated, once the estimate rests on enough pairs; else as it is."""
        alignment = self.estimate(camera.name)
        if alignment.pairs < FEWEST_PAIRS:
            return camera
        return realigned(camera, alignment.rotation, alignment.state[3:6])

    def corrected_frame(self, frame: Frame) -> Frame:
        """The frame with all its cameras corrected."""
        return frame.with_cameras([self.corrected(camera) for camera in frame.cameras])


def estimate(sightings: list[Sighting], start: Alignment, *, time: bool = False) -> Alignment:
    """Match, fit, match again: the alignment of one camera over some moments.

    Begins with ``start``, or with the vote of all likely pairs where that matches clearly better. From an estimate that
    rests on enough pairs matching is fine at once; else its threshold rises from `COARSE_IOU` to `FINE_IOU`.
    """
    return _estimate([Matcher(sighting) for sighting in sightings], start, time=time)


def _estimate(
    matchers: list[Matcher], start: Alignment, *, time: bool, pause: Callable[[], None] = lambda: None
) -> Alignment:
    """As `estimate`, with what `AlignmentWatch` may call in between."""
    sightings = [matcher.sighting for matcher in matchers]
    state, known = start.state, start.pairs >= FEWEST_PAIRS
    voted = np.zeros_like(state)
    pause()
    voted[:3] = vote_rotation(sightings)
    pause()
    if np.linalg.norm(voted[:2] - state[:2]) > np.deg2rad(0.4):
        before, after = (sum(match_sighting(s, st, COARSE_IOU)[1] for s in sightings) for st in (state, voted))
        if after > BETTER * before + 0.5:
            state, known = voted, False
    current = replace(start, state=state)
    for threshold in (FINE_IOU,) if known else np.linspace(COARSE_IOU, FINE_IOU, 5):
        found = []
        for matcher in matchers:
            pause()
            found.append(matcher.pairs(current.state, float(threshold)))
        pairs = BoxPairs.concatenate(found)
        current = fit_alignment(pairs, current, time=time, pause=pause)
    return current


def judge(alignment: Alignment, settings: WatchSettings) -> Status:
    """What an estimate means: beyond a limit by so many standard deviations, or too uncertain to tell."""
    if alignment.pairs < FEWEST_PAIRS or np.abs(alignment.state[SHRINKAGE]).max() > IMPLAUSIBLE:
        return "unknown"
    surely = np.rad2deg(alignment.surely_beyond(settings.sure))
    late, late_deviation = 0.0, float(alignment.deviation[TIME])
    if settings.time and alignment.pairs >= FEWEST_TIMED and late_deviation < settings.late_s / 2:
        late = abs(alignment.time_offset) - settings.sure * late_deviation
    if surely > settings.wrong_deg or late > 4 * settings.late_s:
        return "wrong"
    if surely > settings.drifting_deg or late > settings.late_s:
        return "drifting"
    # what could hide a rotation that matters is not called in order
    spread = np.rad2deg(np.linalg.norm(alignment.rotation) - alignment.surely_beyond(1.0))
    return "ok" if spread < settings.wrong_deg / 2 else "unknown"

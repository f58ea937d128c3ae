"""A dataset as a stream: its frames as messages at their own times, as fast as they came or faster."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.errors import Lcf3dError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment_watch import WatchSettings
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.live.fuser import Fuser
from lcf3d.live.messages import CameraBoxes, CameraModel, EgoPose, Image, LidarBoxes, Message, Scan
from lcf3d.live.settings import LiveResult, LiveSettings
from lcf3d.live.synchronizer import SyncSettings
from lcf3d.run.sequences import places_in_order
from lcf3d.run.sources import CameraOnImages, LidarOnScans
from lcf3d.structures import Camera

# between drives, and between frames further apart than this, the replay waits this long (seconds); longer than a memory
PAUSE = 1.2


@dataclass
class ReplayReport:
    """What came of a replay.

    Attributes:
        frames: frames pushed.
        results: results that came.
        dropped: messages dropped, by ``source: cause``.
        latency_ms: median and 99th percentile by stage.
        behind: frames that could not be pushed at their time.
        seconds: how long it took.
        unreadable: what was said of frames that could not be read, or not in full.
        interrupted: somebody stopped it (Ctrl-C) before the end.
        diagnostics: health at the end.
    """

    frames: int = 0
    results: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    latency_ms: dict[str, dict[str, float]] = field(default_factory=dict)
    behind: int = 0
    seconds: float = 0.0
    unreadable: list[str] = field(default_factory=list)
    interrupted: bool = False
    diagnostics: list[dict[str, Any]] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return dict(vars(self))


def frame_times(frames: Sequence[float | None], hertz: float) -> list[float]:
    """Times of a replay, always rising: those of the frames from their first, a pause in place of jumps.

    Frames without a time are ``1 / hertz`` seconds apart.
    """
    times, now, before = [], 0.0, None
    for i, stamp in enumerate(frames):
        if i:
            step = 1 / hertz if stamp is None or before is None else stamp - before
            now += step if 0 < step <= PAUSE else PAUSE
        times.append(now)
        before = stamp
    return times


def frame_messages(
    frame: Frame,
    moment: float,
    lidar: LidarSource,
    cameras: Mapping[str, CameraSource],
    known: dict[str, Camera],
    scans: bool,
    shown: bool = False,
) -> Iterator[Message]:
    """The messages of one frame: calibrations that are new, the pose, the scan, the boxes or images.

    Args:
        frame: the frame.
        moment: its time.
        lidar: the LiDAR branch; its detector runs in the `Fuser`, result files are pushed as boxes.
        cameras: the camera branch by camera name, likewise.
        known: the calibrations pushed so far, kept up to date.
        scans: push the scan though no detector needs it, for recovery.
        shown: somebody looks at the results: push scans and images too where nothing else needs them.
    """
    for camera in frame.cameras:
        if camera.name in cameras and not _same(camera, known.get(camera.name)):
            known[camera.name] = camera
            yield CameraModel(moment, camera)
    if frame.world_from_lidar is not None:
        yield EgoPose(moment, frame.world_from_lidar)
    on_scans = isinstance(lidar, LidarOnScans)
    if (scans or on_scans or shown) and frame.points is not None:
        yield Scan(moment, frame.points)
    if not on_scans:
        yield LidarBoxes(moment, lidar.detect(frame))
    for name, source in cameras.items():
        if name not in {camera.name for camera in frame.cameras} or not source.sees(frame, name):
            continue
        if isinstance(source, CameraOnImages):
            yield Image(moment, name, frame.images[name])
        else:
            pixels = frame.images.get(name) if shown else None
            yield CameraBoxes(moment, name, source.detect(frame, name), pixels)


def _same(camera: Camera, other: Camera | None) -> bool:
    return (
        other is not None
        and np.array_equal(camera.projection, other.projection)
        and np.array_equal(camera.camera_from_lidar, other.camera_from_lidar)
        and (camera.width, camera.height) == (other.width, other.height)
    )


def in_order(dataset: Dataset, frame_ids: Sequence[str]) -> tuple[str, ...]:
    """Whole sequences, each by time, as a memory of past frames needs them; as they are where no frame tells."""
    groups = places_in_order(map(dataset.frame, frame_ids), told=False)
    return tuple(frame_ids[place] for group in groups for place in group)


def make_fuser(
    fusion: LateCascadeFusion,
    lidar: LidarSource,
    cameras: Mapping[str, CameraSource],
    first: Frame,
    *,
    realtime: bool,
    correct: bool = False,
    watch: WatchSettings | None = None,
    memory: MemoryConfig | bool = False,
    on_result: Callable[[LiveResult], None] | None = None,
) -> Fuser:
    """The `Fuser` that belongs to two branches of a dataset."""
    sync = SyncSettings(scans=fusion.config.recovery and first.points is not None)
    known = [camera for camera in first.cameras if camera.name in cameras]
    detectors = {name: s.detector for name, s in cameras.items() if isinstance(s, CameraOnImages)}
    return Fuser(
        fusion,
        known,
        lidar_detector=lidar.detector if isinstance(lidar, LidarOnScans) else None,
        camera_detectors={name: d for name, d in detectors.items() if name in {c.name for c in known}},
        settings=replace(LiveSettings(), sync=sync, realtime=realtime, watch=watch or WatchSettings(), correct=correct),
        memory=memory,
        on_result=on_result,
    )


def replay(
    dataset: Dataset,
    frame_ids: Sequence[str],
    lidar: LidarSource,
    cameras: Mapping[str, CameraSource],
    fuser: Fuser,
    *,
    rate: float = 1.0,
    hertz: float = 10.0,
    shown: bool = False,
    on_results: Callable[[list[LiveResult]], None] = lambda results: None,
) -> ReplayReport:
    """Push the frames of a dataset at their times and gather what comes of it.

    Args:
        dataset: whose frames they are.
        frame_ids: the frames, in order of time.
        lidar: the LiDAR branch.
        cameras: the camera branch by camera name.
        fuser: where to push, see `make_fuser`.
        rate: so many times as fast as it was; 0 for as fast as possible.
        hertz: frames a second where the dataset has no times.
        shown: whether images and scans are looked at, see `frame_messages`.
        on_results: called with the results after each frame.
    """
    report = ReplayReport()
    known: dict[str, Camera] = {}
    start = time.perf_counter()
    try:
        for now, frame in _moments(dataset, frame_ids, hertz, report):
            messages = _readable(
                frame_messages(frame, now, lidar, cameras, known, fuser.settings.sync.scans, shown), report
            )
            if rate > 0:
                _wait_until(start + now / rate, report, fuser, on_results)
            for message in messages:
                _collect(fuser.push(message), report, on_results)
            report.frames += 1
    except KeyboardInterrupt:
        # what came so far is told all the same
        report.interrupted = True
    if rate > 0 and fuser.settings.realtime:
        time.sleep(fuser.settings.sync.deadline)
        _collect(fuser.poll(), report, on_results)
    _collect(fuser.flush(), report, on_results)
    report.seconds = time.perf_counter() - start
    report.dropped = fuser.dropped()
    report.latency_ms = {
        part: {"median": fuser.health.percentile(part, 50), "p99": fuser.health.percentile(part, 99)}
        for part in fuser.health.latency
    }
    report.diagnostics = fuser.diagnostics()
    fuser.close()
    return report


def _moments(
    dataset: Dataset, frame_ids: Sequence[str], hertz: float, report: ReplayReport
) -> Iterator[tuple[float, Frame]]:
    """Each frame that can be read, with its time on a clock that always goes on."""
    before: Frame | None = None
    now = 0.0
    for frame_id in frame_ids:
        try:
            frame = dataset.frame(frame_id)
        except Lcf3dError as error:
            report.unreadable.append(str(error))
            continue
        if before is not None:
            same = before.sequence == frame.sequence
            now += frame_times([before.timestamp, frame.timestamp], hertz)[1] if same else PAUSE
        before = frame
        yield now, frame


def _readable(messages: Iterator[Message], report: ReplayReport) -> list[Message]:
    """The messages of a frame up to one that cannot be read: a stream goes on without it."""
    read = []
    try:
        for message in messages:
            read.append(message)
    except Lcf3dError as error:
        report.unreadable.append(str(error))
    return read


def _wait_until(
    moment: float, report: ReplayReport, fuser: Fuser, on_results: Callable[[list[LiveResult]], None]
) -> None:
    """Sleep, closing groups that are overdue in between."""
    left = moment - time.perf_counter()
    report.behind += left < -0.01
    while left > 0:
        time.sleep(min(left, 0.02))
        _collect(fuser.poll(), report, on_results)
        left = moment - time.perf_counter()


def _collect(results: list[LiveResult], report: ReplayReport, on_results: Callable[[list[LiveResult]], None]) -> None:
    report.results += len(results)
    if results:
        on_results(results)

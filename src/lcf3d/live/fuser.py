"""One object for a stream: messages of all sensors in, fused boxes with latency and health out."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any, cast

import numpy as np

from lcf3d.detectors.base import CameraDetector, LidarDetector
from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment_watch import AlignmentWatch
from lcf3d.fusion.calibration import memory_settings
from lcf3d.fusion.memory import remember
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_state import Memory
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.live.calibrations import Calibrations
from lcf3d.live.counting import Tally
from lcf3d.live.diagnostics import Diagnostics
from lcf3d.live.health import Health
from lcf3d.live.messages import (
    CameraBoxes,
    CameraModel,
    EgoPose,
    Image,
    LidarBoxes,
    Message,
    Scan,
    is_whole,
    plain_points,
    source_of,
)
from lcf3d.live.poses import PoseBuffer
from lcf3d.live.settings import LiveResult, LiveSettings
from lcf3d.live.synchronizer import CameraPart, Group, Synchronizer
from lcf3d.live.warming import made_up_cameras, rehearsal, settings_of_rehearsal
from lcf3d.live.watching import WatchFeed
from lcf3d.live.workers import Worker, attempt
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Camera, Detections2D, Detections3D

log = logging.getLogger(__name__)


class Fuser:
    """Fuses a stream of messages.

    Args:
        fusion: the fusion, for example ``LateCascadeFusion(FusionConfig(class_names=...))``.
        cameras: calibrated cameras; those that come later are pushed as `CameraModel`.
        lidar_detector: runs on each `Scan`; without it `LidarBoxes` are pushed.
        camera_detectors: run on each `Image`, by camera name; cameras without one push `CameraBoxes`.
        settings: see `LiveSettings`.
        memory: whether recent frames testify too, as with ``lcf3d run --memory``, see `lcf3d.fusion.memory`; or its
            settings. Classes that these leave out have the weights of the fusion's calibration.
        on_result: called with each result as soon as it is there, before health and the watch take their time.

    Raises:
        ConfigError: a detector or offset of an unknown camera, when cameras are given.

    Example:
        >>> fuser = Fuser(LateCascadeFusion(), cameras)  # doctest: +SKIP
        >>> for message in stream:  # doctest: +SKIP
        ...     for result in fuser.push(message):
        ...         print(result.time, result.fused.explain(0))
    """

    def __init__(
        self,
        fusion: LateCascadeFusion,
        cameras: Sequence[Camera] = (),
        *,
        lidar_detector: LidarDetector | None = None,
        camera_detectors: Mapping[str, CameraDetector] | None = None,
        settings: LiveSettings | None = None,
        memory: MemoryConfig | bool = False,
        on_result: Callable[[LiveResult], None] | None = None,
    ) -> None:
        self.fusion, self.settings = fusion, settings or LiveSettings()
        given = memory if isinstance(memory, MemoryConfig) else None
        self._memory_config = memory_settings(fusion.calibration, given) if memory else None
        self._memory: Memory | None = None
        self._on_result = on_result
        self._models = Calibrations(cameras)
        self._detectors: dict[str, Any] = {f"camera {n}": d for n, d in (camera_detectors or {}).items()}
        if lidar_detector is not None:
            self._detectors["scan"] = lidar_detector
        named = {*(camera_detectors or {}), *self.settings.sync.offsets}
        unknown = sorted(named - set(self._models.names))
        if cameras and unknown:
            raise ConfigError(f"there is no camera {unknown}; the cameras are {sorted(self._models.names)}")
        self.health = Health(fusion.config.class_names)
        self._sync = Synchronizer(self.settings.sync, Tally(self.health.clock))
        self._poses = PoseBuffer()
        self._lock = threading.RLock()
        watch, names = self.settings.watch, fusion.config.class_names
        self.watch = None if watch is None else AlignmentWatch(names, watch, self._let_pass)
        self._workers: dict[str, Worker] = {}
        self._detect_ms: dict[tuple[str, float], float] = {}
        self._results: list[LiveResult] = []
        self._feed: WatchFeed | None = None
        if self.watch is not None:
            workers = self._workers if self.settings.realtime else None
            period = self.settings.watch_period
            self._feed = WatchFeed(self.watch, self._poses, period, workers, self._lock, self.health)

    def push(self, message: Message) -> list[LiveResult]:
        """Take one message in; the results that are there by now and were not handed out before, in order of time."""
        return self._locked(lambda: self._take(message, perf_counter()))

    def poll(self) -> list[LiveResult]:
        """Close the groups that have waited longer than the deadline by the own clock, though nothing more came."""
        before = perf_counter() - self.settings.sync.deadline
        return self._locked(lambda: self._sync.overdue(before))

    def flush(self) -> list[LiveResult]:
        """Fuse everything that is left, at the end of a stream; detectors at work are waited for up to the deadline."""
        for worker in list(self._workers.values()):
            worker.wait_idle(self.settings.sync.deadline)
        return self._locked(lambda: None, everything=True)

    def close(self) -> None:
        """Stop the detectors' threads; one that hangs is left behind."""
        for worker in self._workers.values():
            worker.stop(self.settings.sync.deadline)
        self._workers.clear()

    def warm_up(self) -> None:
        """Load, compile and run everything on a made-up stream: the first real frame is then as quick as others.

        A detector that fails on it is reported and stops nothing.
        """
        with self._lock:
            known = [replace(self._models.at(name, np.inf), delay=0.0) for name in self._models.names]
        cameras = known or made_up_cameras()
        for detectors in ({}, self._detectors) if self._detectors else ({},):
            twin = self._twin(cameras, detectors)
            for message in rehearsal(cameras, self.fusion.config.class_names, detectors):
                twin.push(message)
            twin.flush()
            twin.diagnostics()
            for source, error in twin.health.last_error.items():
                log.warning("%s failed on the made-up stream of the warm-up: %s", source, error)
                self.health.tell(f"{source} failed at the warm-up: {error}")

    def _twin(self, cameras: Sequence[Camera], detectors: Mapping[str, Any]) -> Fuser:
        """A fuser with the same parts, to rehearse with: nothing in threads, and its watch looks at every moment."""
        settings = settings_of_rehearsal(self.settings)
        twin = Fuser(self.fusion, cameras, settings=settings, memory=self._memory_config or False)
        twin._detectors = dict(detectors)
        return twin

    def dropped(self) -> dict[str, int]:
        """Messages left out, by ``source: cause``."""
        with self._lock:
            return {f"{source}: {cause}": count for (source, cause), count in sorted(self._sync.dropped.total.items())}

    def turned_deg(self) -> dict[str, float]:
        """How far each camera has turned against its calibration, in degrees, as far as the watch knows."""
        with self._lock:
            if self.watch is None:
                return {}
            reports = {name: self.watch.estimate(name) for name in self.watch.cameras}
            return {name: float(np.rad2deg(np.linalg.norm(found.rotation))) for name, found in reports.items()}

    def diagnostics(self) -> list[dict[str, Any]]:
        """Health of every part as plain values in the form of ROS ``diagnostic_msgs/DiagnosticStatus``."""
        with self._lock:
            reports = {n: self.watch.report(n) for n in self.watch.cameras} if self.watch is not None else {}
            hanging = {
                name: perf_counter() - worker.busy_since
                for name, worker in self._workers.items()
                if worker.busy_since is not None
            }
            late = {name: s for name, s in hanging.items() if s > self.settings.sync.deadline}
            quiet = self.health.quiet(perf_counter()) if self.settings.realtime else 0.0
            return Diagnostics(self.health, self._sync, reports, late, quiet).entries(self._models.names)

    def _locked(self, action: Callable[[], None], everything: bool = False) -> list[LiveResult]:
        with self._lock:
            action()
            self._advance(everything)
            results, self._results = self._results, []
            return results

    def _let_pass(self) -> None:
        """The watch in its thread waits while a message is being taken in: it must not hold up a result.

        Python's own turns between threads are 5 ms long.
        """
        with self._lock:
            pass

    def _take(self, message: Message, arrival: float) -> None:
        # without a name not even this can be told
        whole = not isinstance(message, CameraModel) or isinstance(message.camera, Camera)
        source = source_of(message) if whole else "calibration"
        if not is_whole(message):
            self._sync.dropped.add((source, "broken"))
            return
        if isinstance(message, CameraModel):
            self._learn_camera(message)
            return
        if isinstance(message, Image | CameraBoxes) and message.camera not in self._models.names:
            self.health.tell_once(f"camera {message.camera} has no calibration yet: its messages wait for one")
        misfit = self._models.misfit(message) if isinstance(message, Image) else None
        if misfit is not None:
            self.health.tell_once(misfit)
        self.health.saw(source, message, arrival)
        restarts = self._sync.restarts
        admitted = self._sync.admit(source, message.time)
        if self._sync.restarts > restarts:
            self._begin_anew()
        if not admitted:
            return
        if isinstance(message, EgoPose):
            self._poses.add(message.time, message.world_from_lidar)
            return
        if isinstance(message, Scan):
            message = replace(message, points=plain_points(message.points))
            self._sync.add_scan(message.time, message.points, arrival)
        if source in self._detectors and isinstance(message, Scan | Image):
            self._detect(source, message, arrival)
        elif isinstance(message, LidarBoxes):
            self._sync.add_lidar(message.time, message.detections, arrival)
        elif isinstance(message, CameraBoxes):
            self._sync.add_camera(message.camera, CameraPart(message.time, message.detections, message.pixels, arrival))
        elif isinstance(message, Image):
            self.health.tell_once(f"camera {message.camera} sends images, but there is no detector for them")

    def _begin_anew(self) -> None:
        """Time went back: poses are of another time, and the latest calibrations hold from now on."""
        self.health.began_anew()
        self._poses.clear()
        self._models.begin_anew()

    def _learn_camera(self, message: CameraModel) -> None:
        """A calibration that is new, or that changes in the middle: the watch of that camera then begins anew."""
        if self._models.learn(message, self._sync.closed):
            self.health.tell(f"camera {message.camera.name}: new calibration at {message.time:.3f} s")
            if self.watch is not None:
                self.watch.forget(message.camera.name)

    def _detect(self, source: str, message: Scan | Image, arrival: float) -> None:
        """Run a detector now, or hand the message to its thread."""
        detector = self._detectors[source]

        def work(taken: tuple[Scan | Image, float]) -> Any:
            given = taken[0]
            return detector(given.points) if isinstance(given, Scan) else detector([given.pixels])[0]

        if not self.settings.realtime:
            start = perf_counter()
            result, error = attempt(work, (message, arrival))
            self._detected(source, message, result, error, (perf_counter() - start) * 1e3, arrival)
            return
        if source not in self._workers:

            def done(taken: tuple[Scan | Image, float], result: Any, error: Exception | None, spent: float) -> None:
                with self._lock:
                    self._detected(source, taken[0], result, error, spent, taken[1])
                    self._advance(False)

            self._workers[source] = Worker(source, work, done)
        if not self._workers[source].submit((message, arrival)):
            self._sync.dropped.add((source, "busy"))

    def _detected(
        self, source: str, message: Scan | Image, result: Any, error: Exception | None, spent: float, arrival: float
    ) -> None:
        """What a detector found, or that it failed."""
        wanted = Detections3D if isinstance(message, Scan) else Detections2D
        if error is None and not isinstance(result, wanted):
            error = TypeError(f"it must give {wanted.__name__}, not {type(result).__name__}")
        if error is not None:
            self.health.failed(source, error)
            return
        self._detect_ms[source, message.time] = spent
        if isinstance(message, Scan):
            if message.time > self._sync.closed:
                self._sync.add_lidar(message.time, result, arrival)
            else:
                self._sync.dropped.add(("lidar", "late"))
        else:
            self._sync.add_camera(message.camera, CameraPart(message.time, result, message.pixels, arrival))

    def _advance(self, everything: bool) -> None:
        """Fuse the groups that are ready."""
        newest = self._poses.newest if self.settings.sync.poses else np.inf
        for group in self._sync.ready(frozenset(self._models.names), newest, everything):
            # whatever a message has in it, the next one is taken in
            _, error = attempt(self._fuse, group)
            if error is not None:
                self.health.failed("fusion", error)
        if self._feed is not None:
            self._feed.advance(everything)
        if len(self._detect_ms) > 64:
            for key in list(self._detect_ms)[:-64]:
                del self._detect_ms[key]

    def _fuse(self, group: Group) -> None:
        assert group.lidar is not None
        begun = perf_counter()
        frame, nominal = self._frame(group)
        blinded = self.health.blinded() if self.settings.leave_out_blinded else frozenset()
        found = {n: p.detections for n, p in group.cameras.items() if n in self._models.names and n not in blinded}
        result, error = attempt(lambda lidar: self.fusion(frame, lidar, found), group.lidar)
        if error is not None:
            self.health.failed("fusion", error)
            return
        fused = perf_counter()
        result = self._remember(frame, replace(result, notes=(*result.notes, *self._notes(group, blinded))))
        ended = perf_counter()
        latency = {
            "wait": (group.last_arrival - group.arrival) * 1e3,
            "fusion": (fused - begun) * 1e3,
            **({} if self._memory_config is None else {"memory": (ended - fused) * 1e3}),
            "added": (ended - group.last_arrival) * 1e3,
            **self._detector_times(group),
        }
        live = LiveResult(group.time, frame, result, latency)
        self._results.append(live)
        if self._on_result is not None:
            _, error = attempt(self._on_result, live)
            if error is not None:
                self.health.failed("callback", error)
        self._look_after(group, frame, nominal, result, latency)

    def _remember(self, frame: Frame, result: FusedDetections) -> FusedDetections:
        """The result with what recent frames add; as it is where there is no memory, or where that fails."""
        config = self._memory_config
        if config is None:
            return result
        found, error = attempt(lambda fused: remember(self._memory, fused, frame, config), result)
        if error is not None:
            self.health.failed("memory", error)
            return result
        self._memory, remembered = found
        return cast(FusedDetections, remembered)

    def _look_after(
        self, group: Group, frame: Frame, nominal: Frame, result: FusedDetections, latency: dict[str, float]
    ) -> None:
        """What takes time and no result waits for: health and the calibration watch."""
        assert group.lidar is not None
        found = {name: part.detections for name, part in group.cameras.items() if name in self._models.names}
        self.health.fused(frame, result, found, latency, group.points)
        if self._feed is not None:
            self._feed.offer(group.time, nominal, group.lidar, found)

    def _frame(self, group: Group) -> tuple[Frame, Frame]:
        """What is fused, with each camera as it stood at its own moment; and the same without corrections."""
        nominal, corrected = [], []
        for name in self._models.names:
            camera = self._models.at(name, group.time)
            part = group.cameras.get(name)
            shift = 0.0 if part is None else part.time - group.time
            nominal.append(self._moved(camera, group.time, shift))
            if self.settings.correct and self.watch is not None:
                late = self.watch.estimate(name).time_offset if self.watch.settings.time else 0.0
                corrected.append(self.watch.corrected(self._moved(camera, group.time, shift + late)))
        images = {n: p.pixels for n, p in group.cameras.items() if p.pixels is not None}
        frame = Frame(
            f"{group.time:.6f}",
            group.points,
            corrected or nominal,
            images,
            timestamp=group.time,
            world_from_lidar=self._poses.at(group.time),
        )
        return frame, frame.with_cameras(nominal) if corrected else frame

    def _moved(self, camera: Camera, time: float, shift: float) -> Camera:
        """A camera as it stood ``shift`` seconds after a scan, seen from the LiDAR at the scan."""
        motion = self._poses.motion(time, time + shift) if shift else None
        transform = camera.camera_from_lidar if motion is None else camera.camera_from_lidar @ motion
        return replace(camera, camera_from_lidar=transform, delay=shift)

    def _notes(self, group: Group, blinded: Iterable[str]) -> list[str]:
        notes = [f"camera {n} sees far less than it used to and was not used" for n in sorted(blinded)]
        notes += [
            f"camera {n} has no calibration and was not used"
            for n in sorted(set(group.cameras) - {*self._models.names})
        ]
        if len(self._poses) and any(
            p.time != group.time and self._poses.motion(group.time, p.time) is None for p in group.cameras.values()
        ):
            notes.append("there is no ego pose at this moment: nothing was moved to the cameras' times")
        return notes

    def _detector_times(self, group: Group) -> dict[str, float]:
        times = {"scan": group.time, **{f"camera {n}": p.time for n, p in group.cameras.items()}}
        return {f"detect {s}": self._detect_ms[s, t] for s, t in times.items() if (s, t) in self._detect_ms}

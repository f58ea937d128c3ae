"""A made-up six-camera drive as a stream: latency, what is dropped, memory.

    python benchmarks/live_replay.py --hertz 10 --seconds 60          # in real time
    python benchmarks/live_replay.py --hertz 20 --seconds 60
    python benchmarks/live_replay.py --minutes 30 --watch-period 1    # as fast as it goes: is memory flat?

The six cameras stand as nuScenes' do. Cars and people drive and walk about a car that drives itself; the LiDAR branch
has their boxes with noise and false ones, each camera its 2D boxes at its own moment, with noise and misses. Poses come
50 times a second. Nothing runs but the `Fuser`, with the calibration watch of all cameras on: no detectors.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d import Detections2D, Detections3D, FusionConfig, LateCascadeFusion
from lcf3d.geometry.camera import project_boxes
from lcf3d.live.fuser import Fuser
from lcf3d.live.messages import CameraBoxes, EgoPose, LidarBoxes, Message
from lcf3d.live.settings import LiveResult, LiveSettings
from lcf3d.live.synchronizer import SyncSettings
from lcf3d.live.warming import settle_memory
from lcf3d.simulation.presets import get_preset
from lcf3d.structures import FloatArray

NAMES = ("car", "pedestrian")
# objects within sight, false LiDAR boxes a frame, seconds after which the road repeats
OBJECTS, FALSE, LOOP = 60, 40, 60.0
EGO_SPEED = 10.0
# frames between two looks at memory
EVERY = 1000


class Drive:
    """Objects that move evenly along a straight road that repeats every `LOOP` seconds, and the cameras."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.cameras = get_preset("nuscenes32").cameras
        count = OBJECTS * int(LOOP * EGO_SPEED / 120)
        self.labels = (rng.random(count) < 0.4).astype(np.int64)
        people = self.labels == 1
        sizes = np.where(people[:, None], [0.7, 0.7, 1.75], [4.4, 1.8, 1.6])
        yaw = np.where(people, rng.uniform(-3, 3, count), rng.choice([0.0, 3.1], count))
        speed = np.where(people, 1.3, rng.choice([0.0, 8.0, 12.0], count))
        self.boxes = np.column_stack(
            [rng.uniform(0, LOOP * EGO_SPEED, count), rng.uniform(-20, 20, count), sizes[:, 2] / 2 - 1.8, sizes, yaw]
        )
        self.velocities = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)

    def at(self, moment: float) -> tuple[FloatArray, np.ndarray[Any, Any]]:
        """(N, 7) boxes near the car in its frame at a moment, and which objects they are."""
        x = self.boxes[:, 0] + self.velocities[:, 0] * (moment % LOOP) - EGO_SPEED * moment
        length = LOOP * EGO_SPEED
        x = (x + length / 2) % length - length / 2
        near = np.flatnonzero((np.abs(x) < 60) & (np.hypot(x, self.boxes[:, 1]) > 4))
        boxes = self.boxes[near].copy()
        boxes[:, 0] = x[near]
        boxes[:, 1] += self.velocities[near, 1] * (moment % LOOP)
        return boxes, near

    def frame(self, moment: float, rng: np.random.Generator, late: float = 0.0) -> Iterator[Message]:
        """The messages of one scan: boxes, and 2D boxes of each camera up to 20 ms later.

        The images were taken ``late`` seconds after their time stamps.
        """
        boxes, near = self.at(moment)
        wrong = np.column_stack(
            [rng.uniform(-50, 50, (FALSE, 2)), np.full(FALSE, -1.0), np.tile([4.4, 1.8, 1.6, 0], (FALSE, 1))]
        )
        noisy = np.concatenate([boxes + rng.normal(0, [0.1] * 3 + [0.05] * 3 + [0.05], boxes.shape), wrong])
        labels = np.concatenate([self.labels[near], np.zeros(FALSE, np.int64)])
        scores = np.concatenate([rng.uniform(0.5, 0.95, len(boxes)), rng.uniform(0.05, 0.4, FALSE)])
        speeds = np.concatenate([self.velocities[near], np.zeros((FALSE, 2))])
        yield LidarBoxes(moment, Detections3D(noisy, scores, labels, NAMES, speeds))
        for c, camera in enumerate(self.cameras):
            stamp = moment + 0.003 * c
            there, who = self.at(stamp + late)
            projected, visible = project_boxes(there, camera)
            seen = np.flatnonzero(visible & (projected[:, 3] - projected[:, 1] > 15) & (rng.random(len(there)) > 0.1))
            edges = np.clip(projected[seen] + rng.normal(0, 2, (len(seen), 4)), 0, [1600, 900, 1600, 900])
            good = (edges[:, 2:] > edges[:, :2] + 1).all(axis=1)
            found = Detections2D(edges[good], rng.uniform(0.5, 0.95, good.sum()), self.labels[who[seen[good]]], NAMES)
            yield CameraBoxes(stamp, camera.name, found)


def poses(first: float, last: float) -> Iterator[EgoPose]:
    """Poses of the car, 50 a second."""
    for k in range(int(np.ceil(first * 50)), int(np.ceil(last * 50))):
        pose = np.eye(4)
        pose[0, 3] = EGO_SPEED * k / 50
        yield EgoPose(k / 50, pose)


def memory_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 2**20


def stream(drive: Drive, hertz: float, frames: int) -> Iterator[tuple[float, list[Message]]]:
    """The messages of one frame after the other, with its time. After `LOOP` seconds the boxes come again."""
    rng, loop = np.random.default_rng(1), round(LOOP * hertz)
    made: list[list[Message]] = []
    for i in range(frames):
        moment = i / hertz
        if i < loop:
            made.append(list(drive.frame(moment, rng)))
        shift = (i // loop) * LOOP
        again = [replace(message, time=message.time + shift) for message in made[i % loop]]
        yield moment, sorted([*again, *poses(moment, moment + 1 / hertz)], key=lambda message: message.time)


def run(hertz: float, seconds: float, realtime: bool, watch_period: float) -> dict[str, Any]:
    """Stream so many seconds of driving; memory after every `EVERY` frames."""
    drive, clock = Drive(), Clock()
    config = FusionConfig(class_names=NAMES, recovery=False)
    sync = SyncSettings(tolerance=0.024, deadline=0.15, scans=False, poses=False)
    fuser = Fuser(
        LateCascadeFusion(config),
        drive.cameras,
        settings=LiveSettings(sync, realtime=realtime, watch_period=watch_period),
        on_result=clock,
    )
    fuser.warm_up()
    settle_memory()
    frames = round(hertz * seconds)
    results, behind, memory, since = 0, 0, [], []
    start, cpu = time.perf_counter(), time.process_time()
    for i, (moment, messages) in enumerate(stream(drive, hertz, frames)):
        if realtime:
            left = start + moment - time.perf_counter()
            behind += left < -0.5 / hertz
            time.sleep(max(left, 0))
        for message in messages:
            clock.begin()
            for result in fuser.push(message):
                results += 1
                if realtime:
                    since.append((time.perf_counter() - start - result.time) * 1e3)
        if i % EVERY == EVERY - 1:
            memory.append(round(memory_mb(), 1))
            print(f"{i + 1} frames: {memory[-1]} MB", file=sys.stderr, flush=True)
    results += len(fuser.flush())
    fuser.close()
    assert fuser.watch is not None
    return {
        "hertz": hertz,
        "frames": frames,
        "results": results,
        "realtime": realtime,
        "frames_behind": behind,
        "dropped": fuser.dropped(),
        "added_ms": percentiles(clock.wall),
        "added_cpu_ms": percentiles(clock.cpu),
        "added_waited_for_threads_ms": percentiles(clock.waited),
        "first_added_cpu_ms": round(clock.cpu[0], 2),
        "since_due_ms": percentiles(since) if since else None,
        "seconds": round(time.perf_counter() - start, 1),
        "cpu_ms_per_frame": round(1e3 * (time.process_time() - cpu) / frames, 2),
        f"memory_mb_every_{EVERY}_frames": memory,
        "alignment": {name: fuser.watch.report(name).status for name in fuser.watch.cameras},
    }


class Clock:
    """Latency of each result as it comes, before health and the watch: by the clock, in CPU time of its thread, and how
    long it waited for other threads of this process, which is neither CPU time nor waiting for a free core.
    """

    def __init__(self) -> None:
        self._pushed = (0.0, 0.0, 0.0)
        self.cpu: list[float] = []
        self.wall: list[float] = []
        self.waited: list[float] = []

    @staticmethod
    def _now() -> tuple[float, float, float]:
        """Seconds by the clock, of CPU time, and of waiting for a core, of this thread."""
        wanted = Path("/proc/thread-self/schedstat").read_text(encoding="ascii").split()[1]
        return time.perf_counter(), time.thread_time(), int(wanted) * 1e-9

    def begin(self) -> None:
        """A message is pushed."""
        self._pushed = self._now()

    def __call__(self, result: LiveResult) -> None:
        """A result has come."""
        wall, cpu, core = (1e3 * (now - then) for now, then in zip(self._now(), self._pushed, strict=True))
        self.cpu.append(cpu)
        self.waited.append(max(wall - cpu - core, 0.0))
        self.wall.append(result.latency_ms["added"])


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """Median, 99th percentile and the largest."""
    return {name: round(float(np.percentile(values, p)), 2) for name, p in (("median", 50), ("p99", 99), ("max", 100))}


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hertz", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--minutes", type=float, help="as fast as it goes instead of in real time")
    parser.add_argument("--watch-period", type=float, default=0.1, help="seconds between moments that the watch sees")
    options = parser.parse_args()
    seconds = options.seconds if options.minutes is None else 60 * options.minutes
    print(json.dumps(run(options.hertz, seconds, options.minutes is None, options.watch_period), indent=1))


if __name__ == "__main__":
    main()

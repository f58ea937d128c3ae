"""The shipped drive as a stream of scans and images through `Fuser` with both shipped networks, each in its thread.

    python benchmarks/live_networks.py --hertz 10 --seconds 20      # in real time: what is dropped, latency
    python benchmarks/live_networks.py --slow --seconds 2           # one after the other: CPU time of each stage

The drive's frames come again and again. With recovery and the shipped localizer, calibration watch on.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

from live_replay import percentiles

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.datasets.drive import read_drive
from lcf3d.demo.drive import shipped_detectors
from lcf3d.live.fuser import Fuser
from lcf3d.live.messages import Image, Scan
from lcf3d.live.settings import LiveResult, LiveSettings
from lcf3d.localizers.named import ShippedLocalizer


def timed(work: Callable[..., Any], spent: list[float]) -> Callable[..., Any]:
    """The same work, its CPU milliseconds noted: those of the thread, as each network has one thread."""

    def run(*given: Any) -> Any:
        begun = time.thread_time()
        result = work(*given)
        spent.append((time.thread_time() - begun) * 1e3)
        return result

    return run


def run(hertz: float, seconds: float, realtime: bool) -> dict[str, Any]:
    """Stream so many seconds."""
    shipped, detectors = read_drive(), shipped_detectors()
    cpu: dict[str, list[float]] = {"LiDAR network": [], "camera network": [], "fusion": []}
    fusion = LateCascadeFusion(FusionConfig.preset("kitti"), ShippedLocalizer())
    came: list[LiveResult] = []
    fuser = Fuser(
        fusion,
        [shipped[0].camera],
        lidar_detector=timed(detectors.lidar, cpu["LiDAR network"]),
        camera_detectors={shipped[0].camera.name: timed(detectors.camera, cpu["camera network"])},
        settings=LiveSettings(realtime=realtime),
        on_result=came.append,
    )
    fuser.warm_up()
    fuser.fusion = timed(fusion, cpu["fusion"])  # type: ignore[assignment]
    for values in cpu.values():
        values.clear()
    frames, behind = round(hertz * seconds), 0
    start = time.perf_counter()
    for i in range(frames):
        item, moment = shipped[i % len(shipped)], i / hertz
        if realtime:
            left = start + moment - time.perf_counter()
            behind += left < -0.5 / hertz
            time.sleep(max(left, 0))
        fuser.push(Scan(moment, item.points))
        fuser.push(Image(moment, item.camera.name, item.image))
    fuser.flush()
    fuser.close()
    parts = sorted({part for result in came for part in result.latency_ms})
    return {
        "hertz": hertz,
        "realtime": realtime,
        "frames": frames,
        "results": len(came),
        "frames_behind": behind,
        "dropped": fuser.dropped(),
        "latency_ms": {p: percentiles([r.latency_ms[p] for r in came if p in r.latency_ms]) for p in parts},
        "cpu_ms": {name: percentiles(values) for name, values in cpu.items() if values},
    }


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hertz", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--slow", action="store_true", help="no threads, nothing is left out")
    options = parser.parse_args()
    print(json.dumps(run(options.hertz, options.seconds, not options.slow), indent=1))


if __name__ == "__main__":
    main()

"""Is the first real frame of a stream as quick as the others? Each line is a fresh process, with `Fuser.warm_up`.

    python benchmarks/live_first_frame.py

``empty`` has nothing in numba's cache, ``filled`` what the process before left there. Two streams: the made-up drive of
`live_replay` with six cameras (one with a lens), poses, scans, recovery and memory; and the shipped drive through both
shipped networks and the shipped localizer, with memory. CPU time of the pushing thread from the last message of a
moment to its result, health and watch included, as nothing runs in threads. At the end the compiled functions that were
not ready after the warm-up: there should be none.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from live_replay import NAMES, Drive, poses

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.datasets.drive import read_drive
from lcf3d.distortion import Distortion
from lcf3d.live.fuser import Fuser
from lcf3d.live.messages import Image, Message, Scan
from lcf3d.live.settings import LiveSettings
from lcf3d.live.synchronizer import SyncSettings

FRAMES = 30


def six_cameras() -> tuple[Fuser, Iterator[list[Message]]]:
    """Boxes of six cameras and scans."""
    drive, scan = Drive(), read_drive()[0].points
    bent = replace(drive.cameras[0], distortion=Distortion("brown_conrady", (-0.05, 0.01, 0.0, 0.0, 0.0)))
    drive.cameras = (bent, *drive.cameras[1:])
    fusion = LateCascadeFusion(FusionConfig(class_names=NAMES))
    sync = SyncSettings(tolerance=0.024, deadline=0.15)
    fuser = Fuser(fusion, drive.cameras, settings=LiveSettings(sync), memory=True)
    rng = np.random.default_rng(1)

    def moments() -> Iterator[list[Message]]:
        for i in range(FRAMES):
            moment = 0.1 * i
            yield [*poses(moment - 0.1, moment + 0.1), Scan(moment, scan), *drive.frame(moment, rng)]

    return fuser, moments()


def networks() -> tuple[Fuser, Iterator[list[Message]]]:
    """Scans and images."""
    from lcf3d.demo.drive import shipped_detectors
    from lcf3d.localizers.named import ShippedLocalizer

    shipped, detectors = read_drive(), shipped_detectors()
    name = shipped[0].camera.name
    fuser = Fuser(
        LateCascadeFusion(FusionConfig.preset("kitti"), ShippedLocalizer()),
        [shipped[0].camera],
        lidar_detector=detectors.lidar,
        camera_detectors={name: detectors.camera},
        memory=True,
    )

    def moments() -> Iterator[list[Message]]:
        for i in range(FRAMES):
            item = shipped[i % len(shipped)]
            yield [Scan(0.1 * i, item.points), Image(0.1 * i, name, item.image)]

    return fuser, moments()


def compiled() -> dict[str, int]:
    """Compiled functions by name, with how many kinds of arguments they are ready for."""
    from numba.core.dispatcher import Dispatcher

    found = [item for item in gc.get_objects() if isinstance(item, Dispatcher)]
    return {f"{item.py_func.__module__}.{item.py_func.__name__}": len(item.overloads) for item in found}


def measure(stream: str) -> dict[str, Any]:
    """Warm up, then stream."""
    begun = time.process_time()
    fuser, moments = {"six_cameras": six_cameras, "networks": networks}[stream]()
    built = time.process_time()
    fuser.warm_up()
    warm = time.process_time()
    before, spent, results = compiled(), [], 0
    for messages in moments:
        *earlier, last = messages
        for message in earlier:
            fuser.push(message)
        start = time.thread_time()
        results += len(fuser.push(last))
        spent.append((time.thread_time() - start) * 1e3)
    after = compiled()
    return {
        "results": results,
        "build_cpu_s": round(built - begun, 2),
        "warm_up_cpu_s": round(warm - built, 2),
        "first_ms": round(spent[0], 1),
        "others_median_ms": round(float(np.median(spent[1:])), 1),
        "others_max_ms": round(max(spent[1:]), 1),
        "compiled_later": sorted(name for name, kinds in after.items() if kinds > before.get(name, 0)),
        "health": [f"{e['hardware_id']}: {e['message']}" for e in fuser.diagnostics() if e["level"]],
    }


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stream", choices=["six_cameras", "networks"], help="one of them, in this process")
    options = parser.parse_args()
    if options.stream:
        print(json.dumps(measure(options.stream)))
        return
    for stream in ("six_cameras", "networks"):
        with tempfile.TemporaryDirectory() as cache:
            for kind in ("empty", "filled"):
                command = [sys.executable, __file__, "--stream", stream]
                environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
                ended = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
                print(stream, kind, json.dumps(json.loads(ended.stdout), indent=1), flush=True)


if __name__ == "__main__":
    main()

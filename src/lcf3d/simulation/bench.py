"""How long a simulated frame takes, stage by stage."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import TypeVar

import numpy as np

from lcf3d.simulation.camera import measure_exposure, render
from lcf3d.simulation.frames import capture, make_stage
from lcf3d.simulation.lidar import scan
from lcf3d.simulation.presets import Preset, get_preset
from lcf3d.simulation.scene import build_scene

T = TypeVar("T")


def benchmark(frames: int = 5, preset: str | Preset = "kitti64") -> dict[str, float]:
    """Median seconds of each stage over single frames in scenes of their own, warm, two threads.

    Args:
        frames: how many to take the median over.
        preset: name of the preset, or one of one's own.

    Returns:
        ``scene`` (street and road users), ``stage`` (triangles and search tree), ``lidar`` (a scan), ``camera`` (one
        image, without labels), ``frame`` (everything: scene, scan, all images and labels).

    Raises:
        MissingExtraError: embreex is not installed.
    """
    sensors = get_preset(preset) if isinstance(preset, str) else preset
    times: dict[str, list[float]] = {name: [] for name in ("scene", "stage", "lidar", "camera", "frame")}

    def timed(name: str, work: Callable[[], T]) -> T:
        start = perf_counter()
        result = work()
        times[name].append(perf_counter() - start)
        return result

    for index in range(frames + 1):  # the first compiles and fills the caches
        rng = np.random.default_rng(index)
        scene = timed("scene", lambda: build_scene(np.random.default_rng(index), sensors.layout, world=sensors.world))  # noqa: B023
        stage = timed("stage", lambda: make_stage(scene, sensors, 0.0))  # noqa: B023
        timed("lidar", lambda: scan(sensors.lidar, stage, (0.0, 0.0), sensors.rain, rng))  # noqa: B023
        exposure = measure_exposure(sensors.cameras[0], stage)
        timed("camera", lambda: render(sensors.cameras[0], stage, rng, exposure))  # noqa: B023
        start = perf_counter()
        whole = capture(
            build_scene(np.random.default_rng(index), sensors.layout, world=sensors.world),
            sensors,
            0.0,
            (index,),
            "bench",
            threads=2,
        )
        _ = whole.kitti if sensors.layout == "kitti" else whole.labels
        times["frame"].append(perf_counter() - start)
    return {name: float(np.median(values[1:])) for name, values in times.items()}

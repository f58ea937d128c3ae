"""Milliseconds of stereo fusion beside single-view fusion of the same frame, medians of one run.

    python benchmarks/stereo_speed.py

A made-up frame (`lcf3d.benchmark.scenes`): 120,000 points, ``--boxes`` LiDAR boxes, ``--detections`` camera detections
in each view, of which ``--recovered`` show objects that the LiDAR detector missed.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from typing import Any

import numpy as np

from lcf3d import Detections2D, Detections3D, Frame, FusionConfig, LateCascadeFusion
from lcf3d.benchmark.scenes import detections, street_objects
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES

BASELINE = 0.54


def stereo_frame(
    boxes: int, count: int, recovered: int, seed: int
) -> tuple[Frame, Detections3D, dict[str, Detections2D]]:
    """The frame of `detections` with a right camera, without LiDAR boxes of the first ``recovered`` objects."""
    frame, lidar, left_found = detections(boxes, count, seed)
    rng = np.random.default_rng(seed)
    objects = street_objects(count, rng)  # the same ones: they are what the scene draws first
    distance = np.hypot(*(lidar.boxes[:, None, :2] - objects[None, :recovered, :2]).transpose(2, 0, 1))
    lidar = lidar[~(distance < 3).any(axis=1)]
    left = frame.cameras[0]
    transform = np.array(left.camera_from_lidar)
    transform[0, 3] -= BASELINE
    right = replace(left, name="right", camera_from_lidar=transform)
    found = {"left": left_found}
    exact, _ = project_boxes(objects, right)
    sides = np.tile(np.maximum(exact[:, 2:] - exact[:, :2], 4), 2)
    noisy = exact + rng.normal(0, 0.03, exact.shape) * sides
    kept = (noisy[:, 2:] - noisy[:, :2] > 2).all(axis=1)
    found["right"] = Detections2D(noisy[kept], rng.uniform(0.5, 1, kept.sum()), [0] * int(kept.sum()), KITTI_CLASSES)
    return Frame(frame.id, frame.points, [left, right]), lidar, found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boxes", type=int, default=200)
    parser.add_argument("--detections", type=int, default=20)
    parser.add_argument("--recovered", type=int, default=5)
    parser.add_argument("--frames", type=int, default=10, help="different frames")
    parser.add_argument("--repeats", type=int, default=30, help="calls a frame")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    single = LateCascadeFusion(FusionConfig.preset("kitti"))
    settings = StereoConfig.preset("kitti")
    ways: dict[str, Any] = {
        "single": single,
        **{
            f"stereo, unpaired {unpaired}": StereoLateCascadeFusion(settings.updated(unpaired=unpaired))
            for unpaired in ("discard", "single_view")
        },
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    outputs = dict.fromkeys(ways, 0)
    for seed in range(options.frames):
        frame, lidar, found = stereo_frame(options.boxes, options.detections, options.recovered, seed)
        for repeat in range(options.repeats + 1):
            # all ways in turn, so that what else the machine does strikes them alike
            for name, fusion in ways.items():
                given = {"left": found["left"]} if name == "single" else found
                begin = time.perf_counter()
                fused = fusion(frame, lidar, given)
                if repeat:
                    times[name].append(time.perf_counter() - begin)
                else:
                    outputs[name] += int((fused.outcomes == 1).sum())
    medians = {name: float(np.median(values)) * 1e3 for name, values in times.items()}
    if options.json:
        print(json.dumps({"median_ms": medians, "recovered": outputs}, indent=2))
        return
    for name, value in medians.items():
        ratio = value / medians["single"]
        print(f"{name:30s} {value:7.2f} ms  {ratio:4.2f} x single   {outputs[name] / options.frames:.1f} recovered")


if __name__ == "__main__":
    main()

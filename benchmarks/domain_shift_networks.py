"""The shipped networks, trained on simulated kitti64 alone, on other sensors: LiDAR alone against the fusion, NDS^.

    python benchmarks/domain_shift_networks.py --frames 100

Streets are simulated in memory (extra ``simulate``), the front camera only, seeds that no training saw. Points are
adapted as in ``lcf3d generalize`` (ground height, intensity); everything is evaluated in KITTI's classes in the front
camera's view. LiDAR alone: the network's own suppression. Fused: no suppression, the presets kitti and paper.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from lcf3d.detectors.named import load_detector
from lcf3d.evaluation.domain_report import COLUMNS, table_values
from lcf3d.evaluation.domain_shift import (
    AdaptedLidar,
    Truth,
    evaluate_shift,
    find_domain,
    in_kitti_classes,
    split_truth,
)
from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.simulation import capture, get_preset
from lcf3d.simulation.scene import build_scene
from lcf3d.structures import KITTI_CLASSES, Camera, Detections3D

SEED = 3201
PRESETS = ("kitti64", "sparse16", "nuscenes32", "rain", "night")
# about as many pixels to a degree as KITTI's images have
CAMERA_SETTINGS = {"nuscenes32": "?size=544x960"}


def simulated(preset_name: str, frames: int) -> Iterator[Frame]:
    """Frames of scenes of their own, the front camera only."""
    preset = get_preset(preset_name)
    front = next(c for c in preset.cameras if c.name in ("left", "CAM_FRONT"))
    preset = replace(preset, cameras=(front,))
    for index in range(frames):
        scene = build_scene(np.random.default_rng([SEED, index]), preset.layout, 0.0, None, 1.0)
        yield capture(scene, preset, 0.0, (SEED, index, 0), f"{index:06d}").frame


def run(preset_name: str, frames: int) -> dict[str, list[float]]:
    """Values of the table's columns by method."""
    domain = find_domain("nuscenes" if preset_name == "nuscenes32" else "kitti")
    camera = load_detector(f"shipped:kitti{CAMERA_SETTINGS.get(preset_name, '')}", "camera", KITTI_CLASSES)
    networks = {mode: load_detector(f"shipped:kitti?nms={mode}", "lidar", KITTI_CLASSES) for mode in ("keep", "off")}
    fusions = {f"fused, {name}": LateCascadeFusion(FusionConfig.preset(name)) for name in ("paper", "kitti")}
    truths: list[Truth] = []
    cameras: list[Camera] = []
    found: dict[str, list[Detections3D]] = {"LiDAR alone": [], **{name: [] for name in fusions}}
    for frame in simulated(preset_name, frames):
        front = frame.cameras[0]
        assert frame.labels is not None
        truths.append(split_truth(frame.labels))
        cameras.append(front)
        boxes = {
            mode: in_kitti_classes(AdaptedLidar(network, domain, find_domain("kitti"), front.name).detect(frame))
            for mode, network in networks.items()
        }
        seen = {front.name: camera([frame.images[front.name]])[0]}
        found["LiDAR alone"].append(boxes["keep"])
        for name, fusion in fusions.items():
            found[name].append(fusion(frame, boxes["off"], seen).detections)
    return {name: list(table_values(evaluate_shift(truths, results, cameras))) for name, results in found.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=100, help="of each preset")
    parser.add_argument("--preset", action="append", help="only this one; repeatable")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    results = {}
    print("preset", "method", *COLUMNS, sep=" | ")
    for preset in arguments.preset or PRESETS:
        results[preset] = run(preset, arguments.frames)
        for method, values in results[preset].items():
            print(preset, method, *(f"{value:.3f}" for value in values), sep=" | ", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"columns": COLUMNS, "results": results}, indent=1))


if __name__ == "__main__":
    main()

"""What a turned camera costs the fusion, and what the calibration watch brings back, on KITTI-layout results.

    python benchmarks/calibration_watch.py KITTI --split val --lidar results/point_gnn --camera results/rcnn_2d

For each angle the camera's projection is turned about its vertical axis (``--axis pitch`` or ``roll`` for others), as
``K R inv(K) P2``. Three ways are judged by the official protocol: fusion as it is; fusion with the watch correcting
each frame by what it knew before that frame; the LiDAR detections alone. Also says when the watch gave its first
alarm, and how far its estimate was off once its window was full.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_results import image_boxes
from lcf3d.evaluation.kitti import evaluate, result_folder
from lcf3d.formats.kitti import KittiFrames, objects_from_detections, read_folder, write_objects
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import rotation_of
from lcf3d.fusion.alignment_watch import AlignmentWatch, WatchSettings
from lcf3d.fusion.self_calibration import self_calibrate
from lcf3d.structures import Camera, Detections2D, Detections3D, FloatArray

ANGLES = (0.0, 0.2, 0.5, 1.0, 2.0, 5.0)
AXES = {"pitch": 0, "yaw": 1, "roll": 2}
TEACHING_FRAMES = 400
Inputs = list[tuple[Frame, Detections3D, Detections2D]]


def turned(camera: Camera, axis: str, degrees: float) -> Camera:
    """The camera turned about one of its axes."""
    vector = np.zeros(3)
    vector[AXES[axis]] = np.deg2rad(degrees)
    matrix = camera.intrinsics
    return replace(camera, projection=matrix @ rotation_of(vector) @ np.linalg.inv(matrix) @ camera.projection)


def fuse(inputs: Inputs, config: FusionConfig) -> list[tuple[Detections3D, FloatArray]]:
    """Boxes of all frames and where they are in the image, scores calibrated without labels as ``lcf3d run`` does."""
    fusion = LateCascadeFusion(
        config, calibration=self_calibrate(inputs[:: -(-len(inputs) // TEACHING_FRAMES)], config)
    )
    out = []
    for frame, lidar, camera in inputs:
        fused = fusion(frame, lidar, {"left": camera})
        # the watch turns camera_from_lidar; result files keep the axes of the data set
        out.append((fused.detections, image_boxes(frame, fused)))
    return out


def measure(inputs: Inputs, truth: KittiFrames, config: FusionConfig, axis: str, degrees: float) -> dict[str, Any]:
    """AP of both ways at one angle, alarms and errors of the watch."""
    watch = AlignmentWatch(config.class_names, WatchSettings())
    wrong: Inputs = []
    corrected: Inputs = []
    states, errors = [], []
    truth_rad = np.zeros(3)
    truth_rad[AXES[axis]] = -np.deg2rad(degrees)
    for frame, lidar, camera in inputs:
        bad = frame.with_cameras([turned(frame.camera("left"), axis, degrees)])
        wrong.append((bad, lidar, camera))
        corrected.append((watch.corrected_frame(bad), lidar, camera))
        watch.observe(bad, lidar, {"left": camera})
        states.append(watch.report("left").status)
        errors.append(np.rad2deg(watch.estimate("left").rotation - truth_rad))
    alarms = [i for i, state in enumerate(states) if state in ("drifting", "wrong")]
    late = np.array(errors[watch.settings.window :])
    return {
        "degrees": degrees,
        "as_it_is": scores(inputs, fuse(wrong, config), truth),
        "watch": scores(inputs, fuse(corrected, config), truth),
        "first_alarm": alarms[0] + 1 if alarms else None,
        "states": dict(Counter(states)),
        "error_rms_deg": np.sqrt((late**2).mean(axis=0)).round(3).tolist() if len(late) else None,
        "error_max_deg": np.abs(late).max(axis=0).round(3).tolist() if len(late) else None,
    }


def scores(inputs: Inputs, found: list[tuple[Detections3D, FloatArray]], truth: KittiFrames) -> dict[str, float]:
    """Moderate 3D AP R40 by class, of boxes and scores as result files hold them."""
    with TemporaryDirectory() as folder:
        for (frame, _, _), (boxes, projected) in zip(inputs, found, strict=True):
            lines = objects_from_detections(boxes, projected, frame.cameras[0].camera_from_lidar)
            write_objects(Path(folder) / f"{frame.id}.txt", lines)
        metrics = evaluate(truth, read_folder(Path(folder), truth.frame_ids, results=True))
    return {name: round(metrics.ap(name, "3d", "moderate"), 2) for name in ("Car", "Pedestrian")}


def main() -> None:
    """Read, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--split")
    parser.add_argument("--lidar", type=Path, required=True)
    parser.add_argument("--camera", type=Path, required=True)
    parser.add_argument("--axis", choices=AXES, default="yaw")
    parser.add_argument("--angles", type=float, nargs="+", default=ANGLES)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()

    config = FusionConfig.preset("kitti").updated(recovery=False)
    dataset = KittiDataset(options.root, options.split, class_names=config.class_names)
    lidar = dataset.lidar_results(options.lidar, config.class_names)
    camera = dataset.camera_results(options.camera, config.class_names)
    frames = [dataset.frame(frame_id) for frame_id in dataset.ids]
    inputs = [
        (frame.with_cameras([frame.camera("left")]), lidar.detect(frame), camera.detect(frame, "left"))
        for frame in frames
    ]
    truth = read_folder(options.root / "training" / "label_2", dataset.ids, results=False)
    alone = evaluate(truth, read_folder(result_folder(options.lidar), dataset.ids, results=True))
    table: dict[str, Any] = {
        "frames": len(frames),
        "axis": options.axis,
        "lidar_alone": {name: round(alone.ap(name, "3d", "moderate"), 2) for name in ("Car", "Pedestrian")},
        "angles": [],
    }
    print("LiDAR alone", table["lidar_alone"], flush=True)
    for degrees in options.angles:
        row = measure(inputs, truth, config, options.axis, degrees)
        table["angles"].append(row)
        print(json.dumps(row), flush=True)
    if options.json:
        options.json.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Fused AP with four fisheye cameras of 190 degrees and with six pinhole cameras, on the same simulated streets.

Both rigs look at the same scenes with the same LiDAR and about the same pixels an angle. The LiDAR branch is the labels
disturbed (a fifth missed, false boxes added), the same for both; the camera branch is what a perfect detector sees in
the rendered images, or with ``--boxes`` the projections of the labels, disturbed alike.

python benchmarks/fisheye.py --frames 200 --boxes
python benchmarks/fisheye.py --frames 1 --picture docs/images/fisheye.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lcf3d import Camera, Detections2D, Detections3D, Distortion, FusionConfig, LateCascadeFusion
from lcf3d.evaluation.center_distance import EvaluationBoxes, class_curves
from lcf3d.geometry.camera import project_boxes
from lcf3d.simulation.frames import SimulatedFrame, simulate_frame
from lcf3d.simulation.presets import (
    ego_from_nuscenes_camera,
    ego_from_nuscenes_lidar,
    get_preset,
    nuscenes_lidar_from_forward,
)
from lcf3d.structures import NUSCENES_CLASSES

DISTANCES = (0.5, 1.0, 2.0, 4.0)
LEAST_PX = 10
CLASSES = ("car", "truck", "bus", "pedestrian", "motorcycle", "bicycle")
MOUNTS = (
    ("front", (1.72, 0.0, 1.5), 0.0),
    ("right", (0.8, -0.6, 1.5), -90.0),
    ("back", (0.0, 0.0, 1.55), 180.0),
    ("left", (0.8, 0.6, 1.5), 90.0),
)
# a common lens: nearly equidistant
LENS = Distortion("fisheye", (-0.012, 0.004, -0.003, 0.0005))


def fisheye_rig(focal: float) -> tuple[Camera, ...]:
    """Four cameras around the car whose image circles of 190 degrees lie in square images."""
    ego_from_lidar = ego_from_nuscenes_lidar() @ nuscenes_lidar_from_forward()
    size = int(2 * np.ceil(focal * 1.65))
    projection = np.array([[focal, 0, size / 2, 0], [0, focal, size / 2, 0], [0, 0, 1, 0.0]])
    return tuple(
        Camera(name, projection, np.linalg.inv(ego_from_nuscenes_camera(at, yaw)) @ ego_from_lidar, size, size, LENS)
        for name, at, yaw in MOUNTS
    )


def lidar_branch(truth: Detections3D, rng: np.random.Generator) -> Detections3D:
    """The labels with a fifth missed, noise on the boxes, and a false box for every second one."""
    n = len(truth)
    found = truth[rng.uniform(size=n) > 0.2]
    boxes = found.boxes + rng.normal(0, [0.2, 0.2, 0.1, 0.2, 0.1, 0.1, 0.1], (len(found), 7))
    boxes[:, 3:6] = np.maximum(boxes[:, 3:6], 0.2)
    count = n // 2
    away, turn = rng.uniform(5, 50, count), rng.uniform(-np.pi, np.pi, count)
    false = np.column_stack(
        [away * np.cos(turn), away * np.sin(turn), np.full(count, -1.0), np.tile([4.2, 1.8, 1.6], (count, 1)), turn]
    )
    return Detections3D(
        np.concatenate([boxes, false]),
        np.concatenate([rng.beta(4, 2, len(found)), rng.beta(2, 4, count)]),
        np.concatenate([found.labels, np.full(count, NUSCENES_CLASSES.index("car"))]),
        NUSCENES_CLASSES,
    )


def camera_branch(seen: Detections2D, rng: np.random.Generator) -> Detections2D:
    """What is visible, a tenth missed, sides off by 3 % of the size."""
    found = seen[rng.uniform(size=len(seen)) > 0.1]
    sides = found.boxes[:, 2:] - found.boxes[:, :2]
    boxes = found.boxes + rng.normal(0, 0.03, found.boxes.shape) * np.tile(sides, 2)
    boxes[:, 2:] = np.maximum(boxes[:, 2:], boxes[:, :2] + 2)
    return replace(found, boxes=boxes, scores=rng.beta(8, 2, len(found)))


def projections(truth: Detections3D, view: Camera) -> Detections2D:
    """The boxes of the labels in an image, where they are `LEAST_PX` high."""
    boxes, _ = project_boxes(truth.boxes, view)
    tall = np.flatnonzero(boxes[:, 3] - boxes[:, 1] > LEAST_PX)
    return Detections2D(boxes[tall], np.ones(len(tall)), truth.labels[tall], truth.class_names)


def table(parts: Sequence[Detections3D]) -> EvaluationBoxes:
    """Detections of all frames as the metrics read them."""
    joined = Detections3D.concatenate([replace(p, velocities=None, attributes=None) for p in parts])
    n = len(joined)
    frames = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    b = joined.boxes
    return EvaluationBoxes(
        frames, joined.labels, b[:, :2], b[:, 3:6], b[:, 6], joined.scores, np.full((n, 2), np.nan), np.full(n, -1)
    )


def mean_ap(truth: Sequence[Detections3D], found: Sequence[Detections3D]) -> float:
    """Mean AP, as nuScenes has it, of the classes that occur; percent."""
    own, other = table(truth), table(found)
    curves = class_curves(own, other, len(NUSCENES_CLASSES), DISTANCES)
    present = [c for c in np.unique(own.labels) if NUSCENES_CLASSES[c] in CLASSES]
    return 100 * float(np.mean([[x.average_precision(0.1, 0.1) for x in curves[c]] for c in present]))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--scale", type=float, default=0.4, help="of the pinhole cameras' images")
    parser.add_argument("--street", help="kind of street; drawn if not given")
    parser.add_argument("--boxes", action="store_true", help="no images: 2D detections from the labels")
    parser.add_argument("--picture", type=Path, help="draw the first frame's front fisheye image here")
    arguments = parser.parse_args()
    pinhole = get_preset("nuscenes32").resized(arguments.scale)
    focal = float(pinhole.cameras[0].intrinsics[0, 0])
    rigs = {"pinhole": pinhole, "fisheye": replace(pinhole, cameras=fisheye_rig(focal))}
    truth, lidar_only = [], []
    fused: dict[str, list[Detections3D]] = {name: [] for name in rigs}
    fusion = LateCascadeFusion(FusionConfig(class_names=NUSCENES_CLASSES))
    for index in range(arguments.frames):
        frames = {
            name: simulate_frame(rig, arguments.seed, index, street=arguments.street, images=not arguments.boxes)
            for name, rig in rigs.items()
        }
        kept = frames["pinhole"].labels
        kept = kept[np.hypot(kept.boxes[:, 0], kept.boxes[:, 1]) < 50]
        kept = kept[np.isin(kept.labels, [NUSCENES_CLASSES.index(c) for c in CLASSES])]
        lidar = lidar_branch(kept, np.random.default_rng([arguments.seed, index, 1]))
        truth.append(kept)
        lidar_only.append(lidar)
        for name, frame in frames.items():
            rng = np.random.default_rng([arguments.seed, index, 2])
            views = frame.preset.cameras
            seen = [projections(kept, c) if arguments.boxes else frame.detections_2d(c.name) for c in views]
            cameras = {c.name: camera_branch(found, rng) for c, found in zip(views, seen, strict=True)}
            result = fusion(frame.frame, lidar, cameras)
            fused[name].append(result.detections)
            if name == "fisheye" and index == 0 and arguments.picture:
                draw(frame, result, arguments.picture)
        print(f"{index + 1} of {arguments.frames}", end="\r", flush=True)
    print(f"{arguments.frames} frames, {sum(len(t) for t in truth)} objects within 50 m, focal length {focal:.0f} px")
    print(f"LiDAR branch alone   mAP {mean_ap(truth, lidar_only):.2f}")
    for name, found in fused.items():
        print(f"fused, {name:9}     mAP {mean_ap(truth, found):.2f}")


def draw(frame: SimulatedFrame, fused: object, path: Path) -> None:
    """The front camera's image with the fused boxes."""
    from lcf3d.provenance import FusedDetections
    from lcf3d.visualization.camera_view import draw_camera
    from lcf3d.visualization.scene import Scene

    assert isinstance(fused, FusedDetections)
    view = frame.preset.cameras[0]
    picture = draw_camera(frame.renders[view.name].image, view, Scene.from_fused(fused), title="fisheye, 190 degrees")
    picture.save(path, quality=85)


if __name__ == "__main__":
    main()

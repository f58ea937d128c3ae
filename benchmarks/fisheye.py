"""Fused AP with fisheye cameras and with six pinhole cameras, on the same simulated streets.

``six lenses`` stand where the pinhole cameras do and see as far to the sides; ``four of 190 degrees`` look around the
car with overlap, with the same pixels an angle in the middle. The LiDAR branch is the labels
disturbed (a fifth missed, false boxes added), the same for both; the camera branch is what a perfect detector sees in
the rendered images, with ``--boxes`` the projections of the labels, disturbed alike, or with ``--network`` what the
shipped camera network finds in the rendered images of one KITTI camera, without a lens and with one.

python benchmarks/fisheye.py --frames 200 --boxes
python benchmarks/fisheye.py --frames 12 --network
python benchmarks/fisheye.py --frames 1 --picture docs/images/fisheye.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lcf3d import Camera, Detections2D, Detections3D, Distortion, FusionConfig, LateCascadeFusion
from lcf3d.detectors.camera.small import shipped
from lcf3d.evaluation.center_distance import EvaluationBoxes, class_curves
from lcf3d.geometry.camera import project_boxes
from lcf3d.simulation.frames import SimulatedFrame, simulate_frame
from lcf3d.simulation.presets import (
    Preset,
    ego_from_nuscenes_camera,
    ego_from_nuscenes_lidar,
    get_preset,
    nuscenes_lidar_from_forward,
)
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES

DISTANCES = (0.5, 1.0, 2.0, 4.0)
LEAST_PX = 10
CLASSES = ("car", "truck", "bus", "pedestrian", "motorcycle", "bicycle", *KITTI_CLASSES)
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


def with_lenses(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras with `LENS` in front, which shows the same directions at the left and right border of the image."""
    changed = []
    for camera in cameras:
        projection = np.array(camera.projection)
        side = np.array([np.arctan(camera.width / 2 / projection[0, 0])])
        projection[0, 0] = projection[1, 1] = camera.width / 2 / float(LENS.radii(side)[0])
        changed.append(replace(camera, projection=projection, distortion=LENS))
    return tuple(changed)


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
        np.concatenate([found.labels, np.full(count, [n.lower() for n in truth.class_names].index("car"))]),
        truth.class_names,
    )


def camera_branch(seen: Detections2D, rng: np.random.Generator) -> Detections2D:
    """What is visible, a tenth missed, sides off by 3 % of the size."""
    sides = seen.boxes[:, 2:] - seen.boxes[:, :2]
    boxes = seen.boxes + rng.normal(0, 0.03, seen.boxes.shape) * np.tile(sides, 2)
    return replace(seen, boxes=boxes, scores=rng.beta(8, 2, len(seen)))[rng.uniform(size=len(seen)) > 0.1]


def projections(truth: Detections3D, view: Camera) -> Detections2D:
    """The boxes of the labels in an image, of no height where they are not seen."""
    return Detections2D(project_boxes(truth.boxes, view)[0], np.ones(len(truth)), truth.labels, truth.class_names)


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
    own, other, names = table(truth), table(found), truth[0].class_names
    curves = class_curves(own, other, len(names), DISTANCES)
    present = [c for c in np.unique(own.labels) if names[c] in CLASSES]
    return 100 * float(np.mean([[x.average_precision(0.1, 0.1) for x in curves[c]] for c in present]))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--scale", type=float, default=0.4, help="of the pinhole cameras' images")
    parser.add_argument("--street", help="kind of street; drawn if not given")
    parser.add_argument("--boxes", action="store_true", help="no images: 2D detections from the labels")
    parser.add_argument("--picture", type=Path, help="draw the first frame's front fisheye image here; no other rigs")
    parser.add_argument("--network", action="store_true", help="2D detections by the shipped network; one KITTI camera")
    arguments = parser.parse_args()
    pinhole = get_preset("nuscenes32").resized(arguments.scale)
    focal = float(pinhole.cameras[0].intrinsics[0, 0])
    rigs = {
        "six pinholes": pinhole,
        "six lenses": replace(pinhole, cameras=with_lenses(pinhole.cameras)),
        "four of 190 degrees": replace(pinhole, cameras=fisheye_rig(focal)),
    }
    if arguments.picture:
        rigs = {"four of 190 degrees": rigs["four of 190 degrees"]}
    names: tuple[str, ...] = NUSCENES_CLASSES
    if arguments.network:
        names, one = KITTI_CLASSES, get_preset("kitti64")
        one = replace(one, cameras=one.cameras[:1])
        focal = float(one.cameras[0].intrinsics[0, 0])
        rigs = {"one pinhole": one, "one lens": replace(one, cameras=with_lenses(one.cameras))}
        network = shipped("kitti", threads=1)
    truth, lidar_only = [], []
    fused: dict[str, list[Detections3D]] = {name: [] for name in rigs}
    fusion = LateCascadeFusion(FusionConfig(class_names=names))
    for index in range(arguments.frames):

        def look(rig: Preset, index: int = index) -> SimulatedFrame:
            return simulate_frame(rig, arguments.seed, index, street=arguments.street, images=not arguments.boxes)

        if arguments.boxes and not arguments.picture:
            once = look(pinhole)
            frames = {name: replace(once, preset=rig) for name, rig in rigs.items()}
        else:
            frames = {name: look(rig) for name, rig in rigs.items()}
        kept = next(iter(frames.values())).labels
        kept = kept[np.hypot(kept.boxes[:, 0], kept.boxes[:, 1]) < 50]
        kept = kept[np.isin(kept.labels, [i for i, name in enumerate(names) if name in CLASSES])]
        lidar = lidar_branch(kept, np.random.default_rng([arguments.seed, index, 1]))
        truth.append(kept)
        lidar_only.append(lidar)
        for name, frame in frames.items():
            cameras = {}
            for number, view in enumerate(frame.preset.cameras):
                if arguments.network:
                    cameras[view.name] = network([frame.renders[view.name].image])[0]
                    continue
                rng = np.random.default_rng([arguments.seed, index, number, 2])
                seen = projections(kept, view) if arguments.boxes else frame.detections_2d(view.name)
                found = camera_branch(seen, rng)
                # drawn for all objects alike, so that the rigs differ by nothing else
                cameras[view.name] = found[found.boxes[:, 3] - found.boxes[:, 1] > LEAST_PX]
            result = fusion(frame.frame, lidar, cameras)
            fused[name].append(result.detections)
            if name == "four of 190 degrees" and index == 0 and arguments.picture:
                draw(frame, result, arguments.picture)
        print(f"{index + 1} of {arguments.frames}", end="\r", flush=True)
    print(f"{arguments.frames} frames, {sum(len(t) for t in truth)} objects within 50 m, focal length {focal:.0f} px")
    print(f"LiDAR branch alone           mAP {mean_ap(truth, lidar_only):.2f}")
    for name, found in fused.items():
        print(f"fused, {name:20}  mAP {mean_ap(truth, found):.2f}")


def draw(frame: SimulatedFrame, fused: object, path: Path) -> None:
    """The front camera's image with the fused boxes."""
    from lcf3d.provenance import FusedDetections
    from lcf3d.visualization.camera_view import draw_camera
    from lcf3d.visualization.scene import Scene

    assert isinstance(fused, FusedDetections)
    view = frame.preset.cameras[0]
    picture = draw_camera(frame.renders[view.name].image, view, Scene.from_fused(fused))
    # the sky and the bonnet have nothing in them
    size = view.height
    picture.crop((0, int(0.34 * size), size, int(0.78 * size))).save(path, quality=85)


if __name__ == "__main__":
    main()

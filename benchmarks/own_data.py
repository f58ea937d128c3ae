"""Do a plain folder and bags give the same fused boxes as memory and the KITTI layout? Pinhole and fisheye cameras.

Simulated frames without rendered images (the files hold grey ones), detections as in ``fisheye.py``. Everything is
written, read again, and fused from what was read.

python benchmarks/own_data.py --frames 20
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from fisheye import CLASSES, LEAST_PX, camera_branch, lidar_branch, mean_ap, projections, with_lenses

from lcf3d import Detections2D, Detections3D, Frame, FusionConfig, LateCascadeFusion
from lcf3d.datasets.bag import BagDataset
from lcf3d.datasets.bag_export import write_bag
from lcf3d.datasets.convert import write_kitti
from lcf3d.datasets.folder import FolderDataset
from lcf3d.datasets.folder_export import write_folder
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.simulation.frames import simulate_frame
from lcf3d.simulation.presets import get_preset
from lcf3d.structures import NUSCENES_CLASSES

FUSION = LateCascadeFusion(FusionConfig(class_names=NUSCENES_CLASSES))


def make_frames(count: int, seed: int) -> dict[str, list[Frame]]:
    """The same moments seen by six pinhole cameras and by six lenses that show as much."""
    pinhole = get_preset("nuscenes32").resized(0.4)
    rigs = {"pinhole": pinhole.cameras, "fisheye": with_lenses(pinhole.cameras)}
    frames: dict[str, list[Frame]] = {name: [] for name in rigs}
    for index in range(count):
        simulated = simulate_frame(pinhole, seed, index, images=False, threads=1)
        labels = simulated.labels
        labels = labels[np.hypot(labels.boxes[:, 0], labels.boxes[:, 1]) < 50]
        labels = labels[np.isin(labels.labels, [NUSCENES_CLASSES.index(c) for c in CLASSES])]
        labels = replace(labels, velocities=None, attributes=None)
        for name, cameras in rigs.items():
            images = {c.name: np.full((c.height, c.width, 3), 90, np.uint8) for c in cameras}
            points = simulated.frame.points
            frames[name].append(Frame(f"{index:06d}", points, cameras, images, labels, 1e3 + 0.1 * index))
        print(f"{index + 1} of {count} frames", end="\r", flush=True)
    return frames


def detections(frames: Sequence[Frame], seed: int) -> list[tuple[Detections3D, Mapping[str, Detections2D]]]:
    """Both branches of every frame."""
    found = []
    for index, frame in enumerate(frames):
        assert frame.labels is not None
        cameras = {}
        for number, view in enumerate(frame.cameras):
            seen = camera_branch(projections(frame.labels, view), np.random.default_rng([seed, index, number, 2]))
            cameras[view.name] = seen[seen.boxes[:, 3] - seen.boxes[:, 1] > LEAST_PX].clipped(view)
        found.append((lidar_branch(frame.labels, np.random.default_rng([seed, index, 1])), cameras))
    return found


def fuse(
    frames: Sequence[Frame],
    branches: Sequence[tuple[Detections3D, Mapping[str, Detections2D]]],
    only: str | None = None,
    names: Mapping[str, str] | None = None,
) -> list[Detections3D]:
    """Fused boxes; of one camera ``only``, called ``names[only]`` in the frames."""
    results = []
    for frame, (lidar, cameras) in zip(frames, branches, strict=True):
        chosen = {(names or {}).get(n, n): found for n, found in cameras.items() if only in (None, n)}
        used = [c for c in frame.cameras if c.name in chosen]
        results.append(FUSION(Frame(frame.id, frame.points, used), lidar, chosen).detections)
    return results


def difference(a: Sequence[Detections3D], b: Sequence[Detections3D]) -> str:
    """How far two results are from each other."""
    counts = sum(len(x) for x in a), sum(len(x) for x in b)
    if [len(x) for x in a] != [len(x) for x in b]:
        return f"{counts[0]} and {counts[1]} boxes"
    boxes = max((float(np.abs(x.boxes - y.boxes).max(initial=0)) for x, y in zip(a, b, strict=True)), default=0.0)
    scores = max((float(np.abs(x.scores - y.scores).max(initial=0)) for x, y in zip(a, b, strict=True)), default=0.0)
    return f"{counts[0]} boxes, largest difference {boxes:.1e} (m, rad), of scores {scores:.1e}"


def main() -> None:
    """Print the comparisons."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seed", type=int, default=5)
    arguments = parser.parse_args()
    rigs = make_frames(arguments.frames, arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for rig, frames in rigs.items():
            branches = detections(frames, arguments.seed)
            truth = [frame.labels for frame in frames if frame.labels is not None]
            memory = fuse(frames, branches)
            print(f"{rig}, memory: mAP {mean_ap(truth, memory):.2f}")
            forms: dict[str, Callable[[Path], object]] = {
                "folder": lambda p, f=frames: write_folder(f, p),
                "mcap": lambda p, f=frames: write_bag(f, p.with_suffix(".mcap")),
                "rosbag2": lambda p, f=frames: write_bag(f, p),
                "ROS 1 bag": lambda p, f=frames: write_bag(f, p.with_suffix(".bag")),
            }
            for form, write in forms.items():
                path = root / f"{rig}_{form.replace(' ', '_')}"
                write(path)
                path = {"mcap": path.with_suffix(".mcap"), "ROS 1 bag": path.with_suffix(".bag")}.get(form, path)
                again = list(FolderDataset(path) if form == "folder" else BagDataset(path))
                read = fuse(again, branches)
                print(f"{rig}, {form}: mAP {mean_ap(truth, read):.2f}; {difference(memory, read)}")
        frames = rigs["pinhole"]
        branches = detections(frames, arguments.seed)
        camera = frames[0].cameras[0].name
        write_kitti(frames, root / "kitti", camera, intensity_scale=1.0)
        from_kitti = fuse(list(KittiDataset(root / "kitti")), branches, camera, {camera: "left"})
        from_folder = fuse(list(FolderDataset(root / "pinhole_folder")), branches, camera)
        print(f"one pinhole camera, KITTI layout and folder: {difference(from_kitti, from_folder)}")


if __name__ == "__main__":
    main()

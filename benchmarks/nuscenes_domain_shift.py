"""The four tasks of the domain-shift experiment on two simulated folders, with stand-ins for the detectors.

    lcf3d simulate sim_k --preset kitti64 --frames 24 --seed 5
    lcf3d simulate sim_n --preset nuscenes32 --frames 24 --seed 5
    python benchmarks/nuscenes_domain_shift.py sim_k sim_n --out shift

Trained detectors are better; without any, result files are made from the labels with errors: few and small for a
detector on its own data (``HOME``), many and large on the other data (``AWAY``). The camera branch is the same in all
tasks, as a detector trained on much more data would be. Scans are real (simulated ones), so that recovery does its own
work. Writes the result files to ``OUT/results`` and the report of ``lcf3d generalize`` to ``OUT``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lcf3d import FusionConfig, Lcf3dError
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.evaluation.domain_report import run_tasks, to_json
from lcf3d.formats.coco import write_camera_detections
from lcf3d.formats.kitti import objects_from_detections, objects_from_detections_2d, write_objects
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Camera, Detections2D, Detections3D


class Errors(NamedTuple):
    """How far a stand-in for a LiDAR detector is off.

    Attributes:
        miss: share of objects missed.
        false: false boxes a frame, on average.
        centre_m: standard deviation of the centre, along x and y.
        growth: mean of the logarithm of the size error (another fleet of cars).
        size: its standard deviation.
        yaw: standard deviation of the heading in radians.
    """

    miss: float
    false: float
    centre_m: float
    growth: float
    size: float
    yaw: float


HOME = Errors(0.10, 1.2, 0.1, 0.0, 0.04, 0.08)
AWAY = Errors(0.35, 3.0, 0.3, 0.08, 0.08, 0.25)
# what the stand-in for a camera detector sees: smallest height in px, share missed, noise of the edges in px
LEAST_HEIGHT, CAMERA_MISS, CAMERA_NOISE = 18.0, 0.12, 1.5


def lidar_stand_in(truth: Detections3D, errors: Errors, rng: np.random.Generator) -> Detections3D:
    """Labels with errors, and false boxes of the first class with lower scores."""
    found = truth[rng.random(len(truth)) > errors.miss]
    n, false = len(found), int(rng.poisson(errors.false))
    boxes = found.boxes.copy()
    boxes[:, :3] += rng.normal(0, errors.centre_m, (n, 3)) * [1, 1, 0.3]
    boxes[:, 3:6] *= np.exp(rng.normal(errors.growth, errors.size, (n, 3)))
    boxes[:, 6] += rng.normal(0, errors.yaw, n)
    invented = np.column_stack(
        [
            rng.uniform([5, -20], [45, 20], (false, 2)),
            np.full(false, -0.9),
            np.tile([4.0, 1.8, 1.6], (false, 1)),
            rng.uniform(-3, 3, false),
        ]
    )
    scores = np.concatenate([rng.beta(6, 3, n), rng.beta(2.5, 4, false)])
    labels = np.concatenate([found.labels, np.zeros(false, dtype=np.int64)])
    return Detections3D(np.concatenate([boxes, invented]), scores, labels, truth.class_names)


def camera_stand_in(truth: Detections3D, camera: Camera, rng: np.random.Generator) -> Detections2D:
    """Projected labels that are large enough, with noise and misses; occlusion is not looked at."""
    boxes, visible = project_boxes(truth.boxes, camera)
    tall = boxes[:, 3] - boxes[:, 1] > LEAST_HEIGHT
    seen = visible & tall & (rng.random(len(truth)) > CAMERA_MISS)
    noisy = boxes[seen] + rng.normal(0, CAMERA_NOISE, (int(seen.sum()), 4))
    noisy = np.clip(noisy, 0, [camera.width, camera.height] * 2)
    whole = (noisy[:, 2:] > noisy[:, :2] + 1).all(axis=1)
    return Detections2D(noisy[whole], rng.beta(7, 2, int(whole.sum())), truth.labels[seen][whole], truth.class_names)


def write_kitti_results(dataset: KittiDataset, out: Path, rng: np.random.Generator) -> None:
    """``k_home``, ``k_away`` and ``k_2d``, a file a frame."""
    for frame in dataset:
        camera, truth = frame.camera("left"), _labels(frame.labels, frame.id)
        for name, errors in (("k_home", HOME), ("k_away", AWAY)):
            found = lidar_stand_in(truth, errors, rng)
            projected, _ = project_boxes(found.boxes, camera)
            objects = objects_from_detections(found, projected, camera.camera_from_lidar)
            write_objects(out / name / f"{frame.id}.txt", objects)
        write_objects(out / "k_2d" / f"{frame.id}.txt", objects_from_detections_2d(camera_stand_in(truth, camera, rng)))


def write_nuscenes_results(dataset: NuscenesDataset, out: Path, rng: np.random.Generator) -> None:
    """``n_home.json``, ``n_away.json`` and ``n_2d.json``."""
    truths = {frame.id: _labels(frame.labels, frame.id) for frame in dataset}
    for name, errors in (("n_home", HOME), ("n_away", AWAY)):
        found = {token: lidar_stand_in(truth, errors, rng) for token, truth in truths.items()}
        dataset.write_results(out / f"{name}.json", found)
    write_camera_detections(
        out / "n_2d.json",
        {
            (frame.id, "CAM_FRONT"): camera_stand_in(truths[frame.id], frame.camera("CAM_FRONT"), rng)
            for frame in dataset
        },
    )


def _labels(labels: Detections3D | None, frame_id: str) -> Detections3D:
    if labels is None:
        raise Lcf3dError(f"frame {frame_id} has no labels; simulate the folder with 'lcf3d simulate'")
    return labels


def main() -> None:
    """Make the result files, then run the four tasks."""
    parser = argparse.ArgumentParser(description="Domain shift on two simulated folders.")
    parser.add_argument("kitti", type=Path, help="folder in KITTI layout")
    parser.add_argument("nuscenes", type=Path, help="folder in nuScenes layout")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    results, rng = arguments.out / "results", np.random.default_rng(arguments.seed)
    try:
        write_kitti_results(KittiDataset(arguments.kitti), results, rng)
        write_nuscenes_results(NuscenesDataset(arguments.nuscenes), results, rng)
        kitti = f"'kitti:{arguments.kitti}' 'camera=results:{results / 'k_2d'}' 'lidar=results:{results}"
        nuscenes = f"'nuscenes:{arguments.nuscenes}' 'camera=results:{results / 'n_2d.json'}' 'lidar=results:{results}"
        results = run_tasks(
            [
                f"kitti64->kitti64 {kitti}/k_home'",
                f"kitti64->nuscenes32 {nuscenes}/n_away.json'",
                f"nuscenes32->nuscenes32 {nuscenes}/n_home.json'",
                f"nuscenes32->kitti64 {kitti}/k_away'",
            ],
            FusionConfig.preset("kitti"),
            arguments.out,
        )
        print(json.dumps(to_json(results), indent=2))
    except Lcf3dError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()

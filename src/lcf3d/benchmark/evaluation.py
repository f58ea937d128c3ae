"""Speed of the KITTI evaluation: three classes, 2D, orientation, BEV and 3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.benchmark.scenes import kitti_camera, street_objects
from lcf3d.benchmark.timing import Timing, timed
from lcf3d.evaluation.kitti import evaluate, evaluate_folder, split_frame_ids
from lcf3d.formats.kitti import KittiFrames, KittiObjects
from lcf3d.geometry.boxes import kitti_from_lidar, observation_angle
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, FloatArray

# the size of the usual validation split
FRAMES = 3769
BUDGET_MS = 5000.0


def bench_evaluation(seconds: float = 1.0, root: Path | None = None, results: Path | None = None) -> list[Timing]:
    """The evaluation of 3,769 made-up frames in memory, and, if given, of a dataset and its results with loading.

    Args:
        seconds: about how long to measure each.
        root: KITTI-layout folder, or None.
        results: folder of its results, or None.
    """
    truth, found = made_up_frames()
    timings = [
        timed(
            f"KITTI evaluation, {FRAMES} made-up frames in memory",
            lambda: evaluate(truth, found),
            budget_ms=BUDGET_MS,
            seconds=seconds,
            items=FRAMES,
        )
    ]
    if root is not None and results is not None:
        frames = len(split_frame_ids(root))
        timings.append(
            timed(
                f"KITTI evaluation, {frames} frames of {root.name}, load included",
                lambda: evaluate_folder(root, results),
                budget_ms=BUDGET_MS * frames / FRAMES,
                seconds=seconds,
                items=frames,
            )
        )
    return timings


def made_up_frames(count: int = FRAMES, seed: int = 0) -> tuple[KittiFrames, KittiFrames]:
    """Labels and noisy results of ``count`` frames with three to eleven objects each."""
    rng = np.random.default_rng(seed)
    pool = street_objects(40, rng)
    truth, results = [], []
    for _ in range(count):
        chosen = pool[rng.choice(len(pool), rng.integers(3, 12), replace=False)]
        names = np.array(KITTI_CLASSES)[rng.choice(3, len(chosen), p=(0.7, 0.2, 0.1))]
        truth.append(_objects(chosen, names, None))
        noisy = np.concatenate([chosen, chosen[:3]]) + rng.normal(0, 0.1, (len(chosen) + 3, 7))
        results.append(_objects(noisy, np.concatenate([names, names[:3]]), rng.uniform(0, 1, len(noisy))))
    ids = [f"{i:06d}" for i in range(count)]
    return KittiFrames.from_frames(ids, truth), KittiFrames.from_frames(ids, results)


def _objects(boxes: FloatArray, names: NDArray[np.str_], scores: FloatArray | None) -> KittiObjects:
    camera = kitti_camera()
    locations, dimensions, rotation_y = kitti_from_lidar(boxes, camera.camera_from_lidar)
    boxes2d, _ = project_boxes(boxes, camera)
    n = len(boxes)
    return KittiObjects(
        names,
        np.zeros(n),
        np.zeros(n, dtype=np.int64),
        observation_angle(locations, rotation_y),
        boxes2d,
        dimensions,
        locations,
        rotation_y,
        scores,
    )

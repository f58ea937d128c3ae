"""Made-up scans for the tests of LiDAR training: ground, and boxes filled with points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcf3d.detectors.lidar.presets import COMPACT_KITTI
from lcf3d.training.lidar_scans import LabelledScan, ScanSource

AREA = (0.0, -10.24, -3.0, 20.48, 10.24, 1.0)
CONFIG = replace(
    COMPACT_KITTI,
    voxels=replace(COMPACT_KITTI.voxels, area=AREA),
    centers=replace(COMPACT_KITTI.centers, limits=AREA),
)
SIZES = ((3.9, 1.6, 1.5), (0.8, 0.6, 1.7), (1.8, 0.6, 1.7))


def scene(number: int, objects: int = 4) -> LabelledScan:
    """A scan all around with ``objects`` objects, some of every class, each with 40 returns."""
    rng = np.random.default_rng([7, number])
    ground = np.column_stack([rng.uniform(-20, 20, (2000, 2)), rng.normal(-1.7, 0.02, 2000), rng.uniform(0, 0.3, 2000)])
    labels = np.arange(objects) % 3
    boxes = np.zeros((objects, 7))
    parts = [ground]
    for k in range(objects):
        azimuth, distance = 2 * np.pi * (k + rng.uniform(0.1, 0.9)) / objects, rng.uniform(6, 14)
        size = np.array(SIZES[labels[k]])
        yaw = rng.uniform(-np.pi, np.pi)
        center = [distance * np.cos(azimuth), distance * np.sin(azimuth), -1.7 + size[2] / 2]
        boxes[k] = [*center, *size, yaw]
        local = rng.uniform(-0.49, 0.49, (40, 3)) * size
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = np.column_stack(
            [local[:, 0] * cos - local[:, 1] * sin, local[:, 0] * sin + local[:, 1] * cos, local[:, 2]]
        )
        parts.append(np.column_stack([turned + center, np.full(40, 0.8)]))
    points = np.concatenate(parts).astype(np.float32)
    return LabelledScan(points, boxes, labels.astype(np.int64), np.full(objects, 40))


SCENES = ScanSource(scene, 6, np.pi)
EMPTY = ScanSource(lambda i: scene(i, 0), 3, np.pi)

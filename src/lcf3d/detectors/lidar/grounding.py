"""What the ground under a scan does for a network: levels the scan before it is looked at, carries the boxes after.

A network of points in the sensor's frame has to guess how high things stand from what it has seen in training; on a
road that rises or falls, or under a sensor that is mounted otherwise, it guesses wrong. The ground itself can be
measured in every scan.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.geometry.ground import GroundField, ground_field
from lcf3d.structures import Detections3D

LEVEL_M = -1.73
"""Where the ground of a levelled scan lies: KITTI's sensor stands so high above the road."""


def ground_of(points: NDArray[np.floating], config: LidarConfig) -> GroundField | None:
    """The ground under the network's range in (N, 3 or more) points; None where the configuration has no use for it."""
    if config.ground == "ignored":
        return None
    x0, y0, _, x1, y1, _ = config.voxels.area
    return ground_field(points, (x0, y0, x1, y1), LEVEL_M)


def levelled(points: NDArray[np.floating], ground: GroundField | None, config: LidarConfig) -> NDArray[np.floating]:
    """The points with their heights above the ground, which lies at `LEVEL_M`, if the network wants them so."""
    return points if ground is None or config.ground != "level" else level_points(points, ground)


def level_points(points: NDArray[np.floating], ground: GroundField) -> NDArray[np.floating]:
    """(N, C) points with z relative to a ground at `LEVEL_M`."""
    level = points.copy()
    level[:, 2] -= (ground.heights(points) - LEVEL_M).astype(points.dtype)
    return level


def grounded(found: Detections3D, ground: GroundField | None, config: LidarConfig) -> Detections3D:
    """Detections of a network set on the ground (``rest``), or brought back from a levelled scan (``level``)."""
    if ground is None or not len(found):
        return found
    boxes, heights = found.boxes.copy(), ground.heights(found.boxes)
    boxes[:, 2] = heights + boxes[:, 5] / 2 if config.ground == "rest" else boxes[:, 2] + heights - LEVEL_M
    return replace(found, boxes=boxes)

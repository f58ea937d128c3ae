"""From a point cloud to the input arrays of a network, and from its output maps to detections; numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.decoding import decode_anchor_maps, decode_center_maps, detections, select_by_class
from lcf3d.detectors.lidar.frames import turned_points
from lcf3d.detectors.lidar.statistics import painted_statistics, pillar_statistics
from lcf3d.detectors.lidar.suppression import NmsMode
from lcf3d.detectors.lidar.voxelization import Voxels, decorate, in_area, select_channels, voxelize
from lcf3d.structures import Detections3D

Inputs = dict[str, NDArray[Any]]


def network_points(points: NDArray[np.floating], config: LidarConfig) -> NDArray[np.float32]:
    """(M, C) the points a network sees: its channels, in its own frame, inside its range, finite."""
    selected = turned_points(select_channels(points, config.channels), config.frame)
    return in_area(selected, config.voxels.area, config.tall)


def pillar_inputs(points: NDArray[np.floating], config: LidarConfig) -> Inputs | None:
    """Inputs of a pillar network by name, or None when no point lies in its range.

    ``features`` (M, D) decorated points, ``pillar`` (M,) int64 pillar of each, ``padded`` (P, 1) 1 where a pillar
    has room for more points, ``cells`` (P,) int64 flat cell of each pillar in the bird's-eye-view map.
    """
    voxels = voxelize(network_points(points, config), config.voxels)
    if not len(voxels):
        return None
    width = config.voxels.grid[0]
    return {
        "features": decorate(voxels, config.voxels, config.offsets_replace_position),
        "pillar": voxels.voxel_of_point,
        "padded": (voxels.counts < config.voxels.max_points).astype(np.float32)[:, None],
        "cells": voxels.coordinates[:, 1] * width + voxels.coordinates[:, 2],
    }


def encoder_inputs(points: NDArray[np.floating], config: LidarConfig) -> Inputs | None:
    """Inputs of a pillar network by name, in the encoding of its configuration: points or statistics of pillars.

    None when no point lies in its range.
    """
    if config.encoding == "points":
        return pillar_inputs(points, config)
    features, cells = statistics_of(points, config)
    return {"features": features, "cells": cells} if len(cells) else None


def statistics_of(points: NDArray[np.floating], config: LidarConfig) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Statistics of the pillars, of painted points too, and the flat cell of each.

    Raises:
        ShapeError: the points have too few columns, or are not painted as the network wants it.
    """
    if not config.painted:
        return pillar_statistics(points, config.voxels)
    if config.only_painted and points.shape[1] > 4:
        points = points[(points[:, 4:] > 0).any(axis=1)]
    return painted_statistics(points, config.voxels, len(config.painted))


def voxel_inputs(voxels: Voxels) -> Inputs:
    """Inputs of a sparse-convolution network: ``features`` (V, C) voxel means, ``coordinates`` (V, 3) ``z, y, x``."""
    return {"features": voxels.means(), "coordinates": voxels.coordinates}


def map_detections(maps: Sequence[Any], config: LidarConfig, score_threshold: float, nms: NmsMode) -> Detections3D:
    """Detections of a one-stage network.

    Args:
        maps: the head's output maps as arrays without the batch axis: for anchors a triple a level, for centres a
            mapping a task.
        config: the network's configuration.
        score_threshold: boxes need a higher score.
        nms: the mode of suppression.
    """
    if config.anchors is None:
        return detections(*decode_center_maps(maps, config, score_threshold, nms), config)
    classes = len(config.class_names)
    candidates = decode_anchor_maps(maps, config.anchors, classes, config.suppression.candidates)
    selected = select_by_class(candidates, config.anchors, config.suppression, score_threshold, nms)
    return detections(*selected, config)

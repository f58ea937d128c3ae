"""Joining several LiDAR sweeps into the cloud that a multi-sweep network takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ShapeError
from lcf3d.structures import FloatArray

CLOSE_M = 1.0
"""Points of a sweep nearer than this along both x and y are the vehicle's own (as in the published training)."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """One sweep before the key frame.

    Attributes:
        points: (N, 4 or more) ``x, y, z, intensity, ...`` in the LiDAR frame at the moment of the sweep.
        lidar_from_sweep: (4, 4) LiDAR coordinates of the key frame from those of the sweep.
        time_lag_s: seconds from the sweep to the key frame, positive for the past.
    """

    points: NDArray[np.floating]
    lidar_from_sweep: FloatArray
    time_lag_s: float


def accumulate_sweeps(points: NDArray[np.floating], sweeps: Sequence[Sweep]) -> NDArray[np.float32]:
    """(M, 5) float32 ``x, y, z, intensity, time lag`` of the key frame and of earlier sweeps, in its LiDAR frame.

    Args:
        points: (N, 4 or more) of the key frame; further columns, such as a ring index, are left out.
        sweeps: as many as the network was trained with (nuScenes: 10 for PointPillars and SSN, 9 for CenterPoint).

    Raises:
        ShapeError: fewer than four columns, or a transform that is not 4 x 4.
    """
    parts = [_columns(points, 0.0)]
    for sweep in sweeps:
        transform = np.asarray(sweep.lidar_from_sweep, np.float64)
        if transform.shape != (4, 4):
            raise ShapeError(f"Sweep.lidar_from_sweep must have shape (4, 4), got {transform.shape}")
        part = _columns(sweep.points, sweep.time_lag_s)
        part = part[(np.abs(part[:, :2]) >= CLOSE_M).any(axis=1)]
        part[:, :3] = part[:, :3].astype(np.float64) @ transform[:3, :3].T + transform[:3, 3]
        parts.append(part)
    return np.concatenate(parts)


def _columns(points: NDArray[np.floating], time_lag_s: float) -> NDArray[np.float32]:
    if points.ndim != 2 or points.shape[1] < 4:
        raise ShapeError(f"points must have shape (N, 4 or more), got {points.shape}")
    result = np.full((len(points), 5), time_lag_s, np.float32)
    result[:, :4] = points[:, :4]
    return result

"""From a point cloud to voxels: channel selection, range filter, grouping, and what a pillar encoder adds to a point.

All in numpy, outside the networks, so that the torch and the ONNX form of a network share it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import CHANNELS, VoxelSpec
from lcf3d.errors import ShapeError

MAX_TIME_LAG_S = 5.0
"""A fifth column above this is no time lag (nuScenes files carry the ring index there)."""


@dataclass(frozen=True)
class Voxels:
    """Points grouped by voxel.

    Attributes:
        points: (M, C) float32 kept points; those of one voxel follow one another, in input order.
        voxel_of_point: (M,) int64 index of each point's voxel, ascending.
        coordinates: (V, 3) int64 voxel indices ``(z, y, x)``, in order of the voxel's first point.
        counts: (V,) int64 points in each voxel.
    """

    points: NDArray[np.float32]
    voxel_of_point: NDArray[np.int64]
    coordinates: NDArray[np.int64]
    counts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def starts(self) -> NDArray[np.int64]:
        """(V,) index of each voxel's first point."""
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(self.counts)[:-1]])

    def means(self) -> NDArray[np.float32]:
        """(V, C) mean of each voxel's points (the voxel features of SECOND, section 3.1.2 of its paper)."""
        if not len(self):
            return np.zeros((0, self.points.shape[1]), np.float32)
        sums = np.add.reduceat(self.points, self.starts, axis=0)
        return (sums / self.counts[:, None].astype(np.float32)).astype(np.float32)


def select_channels(points: NDArray[np.floating], channels: tuple[str, ...]) -> NDArray[np.float32]:
    """(N, len(channels)) float32 columns a network takes, of points ``x, y, z, intensity[, time lag in seconds, ...]``.

    A cloud of four columns is one sweep: its time lag is zero.

    Raises:
        ShapeError: fewer than four columns, or a fifth that is no time lag although the network takes one.
    """
    if points.ndim != 2 or points.shape[1] < 4:
        raise ShapeError(
            f"points must have shape (N, 4 or more) with columns {', '.join(CHANNELS)}, got {points.shape}"
        )
    if "time" in channels and points.shape[1] > 4 and len(points) and np.nanmax(points[:, 4]) > MAX_TIME_LAG_S:
        raise ShapeError(
            f"column 5 of the points must be the time lag in seconds, got values up to {np.nanmax(points[:, 4]):g} "
            "(a ring index?); drop it or join sweeps with lcf3d.detectors.lidar.accumulate_sweeps"
        )
    selected = np.zeros((len(points), len(channels)), np.float32)
    for i, name in enumerate(channels):
        column = CHANNELS.index(name)
        if column < points.shape[1]:
            selected[:, i] = points[:, column]
    return selected


def in_area(points: NDArray[np.float32], area: tuple[float, ...], tall: bool = False) -> NDArray[np.float32]:
    """Those of the (N, 3 or more) points whose values are finite and that lie strictly inside the (6,) volume.

    With ``tall``, the volume has no floor and no ceiling.
    """
    low, high = np.array(area[:3], np.float32), np.array(area[3:], np.float32)
    inside = np.isfinite(points).all(axis=1)
    for axis in range(2 if tall else 3):
        inside &= (points[:, axis] > low[axis]) & (points[:, axis] < high[axis])
    return points[inside]


def voxelize(points: NDArray[np.float32], spec: VoxelSpec) -> Voxels:
    """Group (N, C) points by voxel, keeping the first points of a voxel and the first voxels, in input order."""
    nx, ny, nz = spec.grid
    low, size = np.array(spec.area[:3], np.float32), np.array(spec.size, np.float32)
    cells = np.floor((points[:, :3] - low) / size).astype(np.int64)
    inside = ((cells >= 0) & (cells < (nx, ny, nz))).all(axis=1)
    points, cells = points[inside], cells[inside]
    if not len(points):
        return Voxels(points, np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros(0, np.int64))
    keys = (cells[:, 2] * ny + cells[:, 1]) * nx + cells[:, 0]
    order = np.argsort(keys, kind="stable")
    sorted_keys = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], sorted_keys[1:] != sorted_keys[:-1]]))
    sizes = np.diff(np.append(starts, len(order)))
    # voxels in order of their first point, which the stable sort put first in its group
    voxel_order = np.argsort(order[starts])[: spec.max_voxels]
    counts = np.minimum(sizes[voxel_order], spec.max_points)
    offsets = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    kept = order[np.repeat(starts[voxel_order], counts) + offsets]
    coordinates = cells[order[starts[voxel_order]]][:, ::-1]
    return Voxels(points[kept], np.repeat(np.arange(len(counts)), counts), np.ascontiguousarray(coordinates), counts)


def decorate(voxels: Voxels, spec: VoxelSpec, offsets_replace_position: bool) -> NDArray[np.float32]:
    """(M, C + 6) point features of a pillar encoder (section 2.1 of the PointPillars paper).

    To a point's own values come its offsets from the mean of the pillar's points and from the centre of the pillar.

    Args:
        voxels: the pillars.
        spec: their voxelization.
        offsets_replace_position: whether the position itself is replaced by the offset from the pillar's centre, as
            in the published KITTI weights of OpenMMLab.
    """
    position = voxels.points[:, :3]
    from_mean = position - voxels.means()[voxels.voxel_of_point, :3]
    size = np.array(spec.size, np.float32)
    first_center = size / 2 + np.array(spec.area[:3], np.float32)
    centers = voxels.coordinates[:, ::-1].astype(np.float32) * size + first_center
    from_center = position - centers[voxels.voxel_of_point]
    own = np.concatenate([from_center, voxels.points[:, 3:]], axis=1) if offsets_replace_position else voxels.points
    return np.concatenate([own, from_mean, from_center], axis=1)

"""What the small network sees of a pillar: statistics of its points instead of the points.

Counts, means, extremes and spreads of the points of a pillar, of its four quarters and of its height slices. One pass
over the scan, so that neither the number of points nor their order costs the network anything: a network for a laptop
spends its time on the map, where the objects are found.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import VoxelSpec
from lcf3d.detectors.lidar.voxelization import select_channels
from lcf3d.errors import ShapeError
from lcf3d.kernels import kernel

QUARTERS = 4
SLICES = 8
OWN = 15
"""Values of a pillar as a whole; see `pillar_statistics`."""
OF_QUARTER = 4
FEATURES = OWN + QUARTERS * OF_QUARTER + SLICES
"""Values of a pillar in all."""
OF_PAINT = 2
"""Values of a pillar of each score that its points are painted with: mean and highest."""
FAR_M = 70.0


def pillar_statistics(points: NDArray[np.floating], spec: VoxelSpec) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Statistics of every pillar that holds a point.

    Of the whole pillar: log count; mean offset from its centre along x and y in half pillars; mean, lowest, highest
    and standard deviation of z; mean and highest intensity; distance, x and y of the centre over 70 m; standard
    deviations along x and y and correlation of both. Of each quarter: log count, mean and highest z, mean intensity.
    Of each of eight equal height slices: log count. Heights are relative to the middle of the volume, in metres.

    Args:
        points: (N, 4 or more) ``x, y, z, intensity, ...`` in the LiDAR frame. Points that are not finite or outside
            the volume are left out.
        spec: pillar size and volume; `VoxelSpec.max_points` and `VoxelSpec.max_voxels` do not matter here.

    Returns:
        (P, FEATURES) float32 values, and the (P,) int64 flat cell of each pillar in the bird's-eye-view map.

    Raises:
        ShapeError: fewer than four columns.
    """
    values = select_channels(points, ("x", "y", "z", "intensity")) if _must_copy(points) else points
    features, cells = _gather(values, np.array(spec.area), np.array(spec.size), np.array(spec.grid))
    return features, cells


def painted_statistics(
    points: NDArray[np.floating], spec: VoxelSpec, painted: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """`pillar_statistics`, and mean and highest of each score that the points are painted with.

    Args:
        points: (N, 4 + painted) ``x, y, z, intensity`` and scores.
        spec: pillar size and volume.
        painted: number of scores.

    Returns:
        (P, FEATURES + OF_PAINT * painted) float32 values, and the (P,) int64 flat cell of each pillar.

    Raises:
        ShapeError: another number of columns.
    """
    if points.ndim != 2 or points.shape[1] != 4 + painted:
        raise ShapeError(
            f"the network takes points with {painted} class scores each, (N, {4 + painted}), got {points.shape}; "
            "give its file to a detector that paints them, painted:FILE or frustum-pillars:FILE"
        )
    features, cells = pillar_statistics(np.ascontiguousarray(points[:, :4], dtype=np.float32), spec)
    values = np.ascontiguousarray(points, dtype=np.float32)
    paint = _gather_paint(values, np.array(spec.area), np.array(spec.size), np.array(spec.grid), cells, painted)
    return np.concatenate([features, paint], axis=1), cells


def _must_copy(points: NDArray[np.floating]) -> bool:
    return points.ndim != 2 or points.shape[1] < 4 or points.dtype != np.float32 or not points.flags.c_contiguous


@kernel
def _gather(points, area, size, grid):  # type: ignore[no-untyped-def]
    nx, ny = grid[0], grid[1]
    row_of = np.full(nx * ny, -1, np.int32)
    cells = np.empty(min(nx * ny, len(points)), np.int64)
    sums = np.zeros((len(cells), FEATURES), np.float32)
    half_x, half_y, middle = 0.5 * size[0], 0.5 * size[1], 0.5 * (area[2] + area[5])
    per_slice = SLICES / (area[5] - area[2])
    count = 0
    for i in range(len(points)):
        x, y, z, intensity = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        # comparisons with NaN are false
        if not (area[0] < x < area[3] and area[1] < y < area[4] and area[2] < z < area[5]):
            continue
        if not math.isfinite(intensity):
            continue
        column, row = int((x - area[0]) / size[0]), int((y - area[1]) / size[1])
        if column >= nx or row >= ny:
            continue
        cell = row * nx + column
        k = row_of[cell]
        if k < 0:
            k = count
            row_of[cell] = k
            cells[k] = cell
            sums[k, 4], sums[k, 5] = np.float32(1e9), np.float32(-1e9)
            for quarter in range(QUARTERS):
                sums[k, OWN + OF_QUARTER * quarter + 2] = np.float32(-1e9)
            count += 1
        dx = (x - area[0] - (column + 0.5) * size[0]) / half_x
        dy = (y - area[1] - (row + 0.5) * size[1]) / half_y
        up = z - middle
        _add(sums[k], dx, dy, up, intensity, min(int((z - area[2]) * per_slice), SLICES - 1))
    for k in range(count):
        cell = cells[k]
        center_x = area[0] + (cell % nx + 0.5) * size[0]
        center_y = area[1] + (cell // nx + 0.5) * size[1]
        _finish(sums[k], center_x, center_y)
    return sums[:count].copy(), cells[:count].copy()


@kernel(inline="always")
def _add(row, dx, dy, up, intensity, height_slice):  # type: ignore[no-untyped-def]
    """Add a point to the sums of its pillar."""
    row[0] += 1
    row[1] += dx
    row[2] += dy
    row[3] += up
    row[4] = min(row[4], up)
    row[5] = max(row[5], up)
    row[6] += up * up
    row[7] += intensity
    row[8] = max(row[8], intensity)
    row[12] += dx * dx
    row[13] += dy * dy
    row[14] += dx * dy
    first = OWN + OF_QUARTER * ((dx >= 0) + 2 * (dy >= 0))
    row[first] += 1
    row[first + 1] += up
    row[first + 2] = max(row[first + 2], up)
    row[first + 3] += intensity
    row[OWN + QUARTERS * OF_QUARTER + height_slice] += 1


@kernel
def _finish(row, center_x, center_y):  # type: ignore[no-untyped-def]
    """Turn the sums of a pillar into its statistics."""
    n = row[0]
    for column in (1, 2, 3, 6, 7, 12, 13, 14):
        row[column] /= n
    variance_x = max(row[12] - row[1] * row[1], 0.0)
    variance_y = max(row[13] - row[2] * row[2], 0.0)
    covariance = row[14] - row[1] * row[2]
    row[0] = math.log1p(n)
    row[6] = math.sqrt(max(row[6] - row[3] * row[3], 0.0))
    row[9] = math.hypot(center_x, center_y) / FAR_M
    row[10], row[11] = center_x / FAR_M, center_y / FAR_M
    row[12], row[13] = math.sqrt(variance_x), math.sqrt(variance_y)
    row[14] = covariance / (row[12] * row[13] + 1e-2)
    for quarter in range(QUARTERS):
        first = OWN + OF_QUARTER * quarter
        m = row[first]
        if m == 0:
            row[first + 2] = 0.0
            continue
        row[first] = math.log1p(m)
        row[first + 1] /= m
        row[first + 3] /= m
    for column in range(OWN + QUARTERS * OF_QUARTER, FEATURES):
        row[column] = math.log1p(row[column])


@kernel
def _gather_paint(points, area, size, grid, cells, painted):  # type: ignore[no-untyped-def]
    """(P, OF_PAINT * painted) means, then maxima, of the scores of the pillars in ``cells``."""
    nx, ny = grid[0], grid[1]
    row_of = np.full(nx * ny, -1, np.int32)
    for k in range(len(cells)):
        row_of[cells[k]] = k
    values = np.zeros((len(cells), OF_PAINT * painted), np.float32)
    counts = np.zeros(len(cells), np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        # comparisons with NaN are false
        if not (area[0] < x < area[3] and area[1] < y < area[4] and area[2] < z < area[5]):
            continue
        if not math.isfinite(points[i, 3]):
            continue
        column, row = int((x - area[0]) / size[0]), int((y - area[1]) / size[1])
        if column >= nx or row >= ny:
            continue
        k = row_of[row * nx + column]
        counts[k] += 1
        for j in range(painted):
            values[k, j] += points[i, 4 + j]
            values[k, painted + j] = max(values[k, painted + j], points[i, 4 + j])
    for k in range(len(cells)):
        for j in range(painted):
            values[k, j] /= counts[k]
    return values

"""A cheap ground model: the lowest returns on a coarse grid, and planes fitted to them where they are asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ShapeError
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray

CELL = 2.0
REACH = 100.0
SIDE = int(2 * REACH / CELL)
# of larger clouds only every second, third, ... point is looked at
ENOUGH_POINTS = 80_000
# how many cells' worth of belief a plane starts with: in the slope and in the height that are expected
SLOPE_BELIEF = 2.0
HEIGHT_BELIEF = 0.3
# distance of the places at which `ground_field` fits planes, and the radius of the returns that take part
FIELD_STEP = 4.0
FIELD_RADIUS = 8.0


@kernel
def ordered(values):  # type: ignore[no-untyped-def]
    """A sorted copy of a short array (numba); one compiled sort serves all of the localizer."""
    result = np.empty(len(values))
    for i in range(len(values)):
        result[i] = values[i]
    for i in range(1, len(result)):
        value, j = result[i], i - 1
        while j >= 0 and result[j] > value:
            result[j + 1] = result[j]
            j -= 1
        result[j + 1] = value
    return result


@kernel
def lowest_returns(cloud):  # type: ignore[no-untyped-def]
    """Lowest point in each cell of a grid around the sensor (numba).

    Args:
        cloud: (N, 3 or more) points in the LiDAR frame; non-finite ones are passed over.

    Returns:
        (SIDE, SIDE, 3) x, y, z in metres, indexed by x then y, cells of `CELL` metres from -`REACH`; z is inf where
        nothing was hit.
    """
    grid, reach, per_metre = np.empty((SIDE, SIDE, 3), np.float32), np.float32(REACH), np.float32(1 / CELL)
    for a in range(SIDE):
        for b in range(SIDE):
            for c in range(3):
                grid[a, b, c] = np.inf
    for n in range(0, len(cloud), 1 + len(cloud) // ENOUGH_POINTS):
        i, j = (cloud[n, 0] + reach) * per_metre, (cloud[n, 1] + reach) * per_metre
        if 0.0 <= i < SIDE and 0.0 <= j < SIDE:
            a, b = int(i), int(j)
            # not a number fails the comparison, minus infinity must not win it
            if -reach < cloud[n, 2] < grid[a, b, 2]:
                for c in range(3):
                    grid[a, b, c] = cloud[n, c]
    return grid


@kernel
def fit_plane(grid, x, y, radius, plane):  # type: ignore[no-untyped-def]
    """Ground plane around a place, by least squares that believes low points and distrusts high ones (numba).

    Points above the plane are objects and walls; one far below it is a stray reflection. The fit starts from the plane
    that is expected and is repeated with weights that fall off quickly above and slowly below the last plane.

    Args:
        grid: from `lowest_returns`.
        x: place in the LiDAR frame.
        y: place in the LiDAR frame.
        radius: lowest points nearer than this take part.
        plane: (3,) height at (x, y) and slopes along x and y; the expected ones (height NaN if nothing is known) are
            replaced by the fitted ones, and stay where nothing was hit.
    """
    reach = int(radius / CELL) + 1
    ci, cj = int((x + REACH) / CELL), int((y + REACH) / CELL)
    side = 2 * reach + 1
    cells, above = np.empty((side * side, 3)), np.empty(side * side)
    n = 0
    for i in range(max(ci - reach, 0), min(ci + reach + 1, SIDE)):
        for j in range(max(cj - reach, 0), min(cj + reach + 1, SIDE)):
            u, v = grid[i, j, 0] - x, grid[i, j, 1] - y
            if grid[i, j, 2] < np.inf and u * u + v * v <= radius * radius:
                cells[n, 0], cells[n, 1], cells[n, 2] = u, v, grid[i, j, 2]
                above[n] = grid[i, j, 2] - plane[1] * u - plane[2] * v
                n += 1
    if n == 0:
        return
    expected = np.empty(3)
    for i in range(3):
        expected[i] = plane[i]
    level = ordered(above[:n])[n // 4]
    # where even the lowest quarter is higher than a plausible slope allows, only walls and objects were hit
    if not level > expected[0] + 0.5 + 0.1 * radius:
        plane[0] = level
    for step in range(6):
        scale = 0.6 if step < 2 else (0.3 if step < 4 else 0.15)
        _solve_plane(cells[:n], scale, SLOPE_BELIEF * 0.25 * radius * radius, expected, plane)


@kernel
def _solve_plane(cells, scale, slope_belief, expected, plane):  # type: ignore[no-untyped-def]
    """One step of the reweighted least squares of `fit_plane`, from ``plane`` to ``plane``."""
    sw = su = sv = sz = suv = 0.0
    suu = svv = slope_belief
    suz, svz = slope_belief * expected[1], slope_belief * expected[2]
    if expected[0] == expected[0]:
        sw, sz = HEIGHT_BELIEF, HEIGHT_BELIEF * expected[0]
    for k in range(len(cells)):
        u, v, z = cells[k, 0], cells[k, 1], cells[k, 2]
        residual = (z - (plane[0] + plane[1] * u + plane[2] * v)) / scale
        if residual < 0.0:
            residual *= 0.5
        square = 1.0 + residual * residual
        weight = 1.0 / (square * square)
        sw += weight
        su += weight * u
        sv += weight * v
        sz += weight * z
        suu += weight * u * u
        suv += weight * u * v
        svv += weight * v * v
        suz += weight * u * z
        svz += weight * v * z
    a, b, c = suu * svv - suv * suv, suv * sv - su * svv, su * suv - suu * sv
    determinant = sw * a + su * b + sv * c
    if determinant > 1e-9:
        plane[0] = (a * sz + b * suz + c * svz) / determinant
        plane[1] = (b * sz + (sw * svv - sv * sv) * suz + (su * sv - sw * suv) * svz) / determinant
        plane[2] = (c * sz + (su * sv - sw * suv) * suz + (sw * suu - su * su) * svz) / determinant


@dataclass(frozen=True, eq=False)
class GroundField:
    """Height of the ground over an area, from planes fitted at the nodes of a grid.

    Attributes:
        low: (2,) x and y of the first node, metres, LiDAR frame.
        planes: (I, J, 3) height at each node and slopes along x and y; nodes are `FIELD_STEP` apart.
    """

    low: FloatArray
    planes: FloatArray

    def heights(self, places: NDArray[np.floating]) -> FloatArray:
        """(N,) z of the ground at (N, 2 or more) places ``x, y``, metres, LiDAR frame.

        Between nodes their planes are blended; outside the area the nearest node's plane goes on. NaN where a place is
        not finite.
        """
        heights: FloatArray = _blend(places, self.low, self.planes)
        return heights


def ground_field(points: NDArray[np.floating], area: tuple[float, float, float, float], level: float) -> GroundField:
    """The ground under an area (x and y of two corners, metres) of a scan.

    Args:
        points: (N, 3 or more) LiDAR frame; points that are not finite are passed over.
        area: x and y of the lower, then the upper corner.
        level: height of the ground where nothing tells it.

    Raises:
        ShapeError: fewer than three columns.
    """
    if points.ndim != 2 or points.shape[1] < 3:
        raise ShapeError(f"points must be (N, 3 or more) x, y, z, got {points.shape}")
    low = np.floor(np.array(area[:2]) / FIELD_STEP) * FIELD_STEP
    counts = np.ceil((np.array(area[2:]) - low) / FIELD_STEP).astype(np.int64) + 1
    grid = lowest_returns(points)
    foot = np.array([np.nan, 0.0, 0.0])
    fit_plane(grid, 0.0, 0.0, 2 * FIELD_RADIUS, foot)
    expected = foot[0] if np.isfinite(foot[0]) else level
    return GroundField(low, _fit_nodes(grid, low, counts, expected))


@kernel
def _fit_nodes(grid, low, counts, expected):  # type: ignore[no-untyped-def]
    """(I, J, 3) planes at the nodes, each expected to go on from the node beside it that is nearer the sensor."""
    planes = np.empty((counts[0], counts[1], 3))
    middle_x = min(max(int(np.rint(-low[0] / FIELD_STEP)), 0), counts[0] - 1)
    middle_y = min(max(int(np.rint(-low[1] / FIELD_STEP)), 0), counts[1] - 1)
    for ring in range(max(counts[0], counts[1])):
        for i in range(max(middle_x - ring, 0), min(middle_x + ring + 1, counts[0])):
            for j in range(max(middle_y - ring, 0), min(middle_y + ring + 1, counts[1])):
                if max(abs(i - middle_x), abs(j - middle_y)) != ring:
                    continue
                plane = np.array([expected, 0.0, 0.0])
                if ring > 0:
                    a = i - min(max(i - middle_x, -1), 1)
                    b = j - min(max(j - middle_y, -1), 1)
                    before = planes[a, b]
                    plane[0] = before[0] + FIELD_STEP * ((i - a) * before[1] + (j - b) * before[2])
                    plane[1:] = 0.7 * before[1:]
                fit_plane(grid, low[0] + i * FIELD_STEP, low[1] + j * FIELD_STEP, FIELD_RADIUS, plane)
                planes[i, j] = plane
    return planes


@kernel
def _blend(places, low, planes):  # type: ignore[no-untyped-def]
    """See `GroundField.heights`."""
    heights = np.empty(len(places))
    for k in range(len(places)):
        u, v = (places[k, 0] - low[0]) / FIELD_STEP, (places[k, 1] - low[1]) / FIELD_STEP
        if not (abs(u) < 1e6 and abs(v) < 1e6):
            heights[k] = np.nan
            continue
        i = min(max(int(u), 0), max(planes.shape[0] - 2, 0))
        j = min(max(int(v), 0), max(planes.shape[1] - 2, 0))
        across, along = min(max(u - i, 0.0), 1.0), min(max(v - j, 0.0), 1.0)
        total = 0.0
        for a in range(min(2, planes.shape[0])):
            for b in range(min(2, planes.shape[1])):
                plane = planes[i + a, j + b]
                here = plane[0] + FIELD_STEP * ((u - i - a) * plane[1] + (v - j - b) * plane[2])
                total += here * (across if a else 1 - across) * (along if b else 1 - along)
        heights[k] = total
    return heights

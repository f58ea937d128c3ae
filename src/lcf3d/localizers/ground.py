"""A cheap ground model: the lowest returns on a coarse grid, and planes fitted to them where they are asked for."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

CELL = 2.0
REACH = 100.0
SIDE = int(2 * REACH / CELL)
# cells around a place that take part in its plane
RADIUS = 10.0
# how many cells' worth of belief a plane starts with: that the ground is level, and that it is as high as elsewhere
LEVEL_BELIEF = 2.0
HEIGHT_BELIEF = 0.3
# ranges, in geometric steps, at which the ground along a frustum is modelled
STATIONS = 8
FIRST_STATION = 4.0
STATION_STEP = 1.5


@njit(cache=True, nogil=True)
def ordered(values):  # type: ignore[no-untyped-def]
    """A sorted copy of a short array (numba); one compiled sort serves all of the localizer."""
    result = values.copy()
    for i in range(1, len(result)):
        value, j = result[i], i - 1
        while j >= 0 and result[j] > value:
            result[j + 1] = result[j]
            j -= 1
        result[j + 1] = value
    return result


@njit(cache=True, nogil=True)
def lowest_returns(cloud):  # type: ignore[no-untyped-def]
    """Lowest height in each cell of a grid around the sensor (numba).

    Args:
        cloud: (N, 3 or more) points in the LiDAR frame; non-finite ones are passed over.

    Returns:
        (SIDE, SIDE) metres, indexed by x then y, cells of `CELL` metres from -`REACH`; inf where nothing was hit.
    """
    grid = np.full((SIDE, SIDE), np.float32(np.inf), np.float32)
    reach, per_metre = np.float32(REACH), np.float32(1 / CELL)
    for n in range(len(cloud)):
        i, j = (cloud[n, 0] + reach) * per_metre, (cloud[n, 1] + reach) * per_metre
        if 0.0 <= i < SIDE and 0.0 <= j < SIDE:
            a, b = int(i), int(j)
            z = cloud[n, 2]
            # not a number fails the comparison, minus infinity must not win it
            if -reach < z < grid[a, b]:
                grid[a, b] = z
    return grid


@njit(cache=True, nogil=True)
def fit_plane(grid, x, y, radius, expected, plane):  # type: ignore[no-untyped-def]
    """Ground plane around a place, by least squares that believes low cells and distrusts high ones (numba).

    Cells above the plane hold objects and walls; a cell far below it holds a stray reflection. The fit starts level
    and is repeated with weights that fall off quickly above and slowly below the last plane.

    Args:
        grid: from `lowest_returns`.
        x: place in the LiDAR frame.
        y: place in the LiDAR frame.
        radius: cells whose middles are nearer than this take part.
        expected: height of the ground that is expected, NaN if nothing is known.
        plane: (3,) filled with the height at (x, y) and the slopes along x and y; ``expected`` and level without cells.
    """
    reach = int(radius / CELL) + 1
    ci, cj = int((x + REACH) / CELL), int((y + REACH) / CELL)
    cells = np.empty(((2 * reach + 1) ** 2, 3))
    n = 0
    for i in range(max(ci - reach, 0), min(ci + reach + 1, SIDE)):
        for j in range(max(cj - reach, 0), min(cj + reach + 1, SIDE)):
            u, v = (i + 0.5) * CELL - REACH - x, (j + 0.5) * CELL - REACH - y
            if grid[i, j] < np.inf and u * u + v * v <= radius * radius:
                cells[n, 0], cells[n, 1], cells[n, 2] = u, v, grid[i, j]
                n += 1
    plane[0], plane[1], plane[2] = expected, 0.0, 0.0
    if n == 0:
        return
    level = ordered(cells[:n, 2])[n // 4]
    # a quarter of the cells lower than a plausible slope allows: only walls and objects were hit
    if not level > expected + 0.5 + 0.1 * radius:
        plane[0] = level
    for step in range(6):
        scale = 0.6 if step < 2 else (0.3 if step < 4 else 0.15)
        _solve_plane(cells, n, scale, LEVEL_BELIEF * 0.25 * radius * radius, expected, plane)


@njit(cache=True, nogil=True)
def _solve_plane(cells, n, scale, level_belief, expected, plane):  # type: ignore[no-untyped-def]
    """One step of the reweighted least squares of `fit_plane`, from ``plane`` to ``plane``."""
    sw = su = sv = sz = suu = suv = svv = suz = svz = 0.0
    for k in range(n):
        u, v, z = cells[k, 0], cells[k, 1], cells[k, 2]
        residual = (z - (plane[0] + plane[1] * u + plane[2] * v)) / scale
        if residual < 0.0:
            residual *= 0.5
        weight = 1.0 / (1.0 + residual * residual) ** 2
        sw += weight
        su += weight * u
        sv += weight * v
        sz += weight * z
        suu += weight * u * u
        suv += weight * u * v
        svv += weight * v * v
        suz += weight * u * z
        svz += weight * v * z
    suu += level_belief
    svv += level_belief
    if expected == expected:
        sw += HEIGHT_BELIEF
        sz += HEIGHT_BELIEF * expected
    a, b, c = suu * svv - suv * suv, suv * sv - su * svv, su * suv - suu * sv
    determinant = sw * a + su * b + sv * c
    if determinant > 1e-9:
        plane[0] = (a * sz + b * suz + c * svz) / determinant
        plane[1] = (b * sz + (sw * svv - sv * sv) * suz + (su * sv - sw * suv) * svz) / determinant
        plane[2] = (c * sz + (su * sv - sw * suv) * suz + (sw * suu - su * su) * svz) / determinant


@njit(cache=True, nogil=True)
def ground_along(grid, yaw, expected, planes):  # type: ignore[no-untyped-def]
    """Ground planes along the ray of heading ``yaw`` (numba).

    Fills ``planes`` (STATIONS, 3): row s holds z = a + b x + c y, x along the ray, around range
    ``FIRST_STATION * STATION_STEP ** s``.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    plane = np.empty(3)
    for s in range(STATIONS):
        reach = FIRST_STATION * STATION_STEP**s
        if s > 0:
            # a hill goes on: the next plane is expected where the last one leads
            expected = planes[s - 1, 0] + planes[s - 1, 1] * reach
        fit_plane(grid, reach * cos, reach * sin, RADIUS, expected, plane)
        planes[s, 1] = plane[1] * cos + plane[2] * sin
        planes[s, 2] = plane[2] * cos - plane[1] * sin
        planes[s, 0] = plane[0] - planes[s, 1] * reach


@njit(cache=True, nogil=True)
def station_of(reach):  # type: ignore[no-untyped-def]
    """Row of `ground_along` for a range in metres."""
    steps = math.log(max(reach, FIRST_STATION) / FIRST_STATION) / math.log(STATION_STEP)
    return min(int(steps + 0.5), STATIONS - 1)

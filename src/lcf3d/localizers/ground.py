"""A cheap ground model: the lowest returns on a coarse grid, and planes fitted to them where they are asked for."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

CELL = 2.0
REACH = 100.0
SIDE = int(2 * REACH / CELL)
# of larger clouds only every second, third, ... point is looked at
ENOUGH_POINTS = 80_000
# cells around a place that take part in its plane
RADIUS = 10.0
# how many cells' worth of belief a plane starts with: in the slope and in the height that are expected
SLOPE_BELIEF = 2.0
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
    """Lowest point in each cell of a grid around the sensor (numba).

    Args:
        cloud: (N, 3 or more) points in the LiDAR frame; non-finite ones are passed over.

    Returns:
        (SIDE, SIDE, 3) x, y, z in metres, indexed by x then y, cells of `CELL` metres from -`REACH`; z is inf where
        nothing was hit.
    """
    grid = np.full((SIDE, SIDE, 3), np.float32(np.inf), np.float32)
    reach, per_metre = np.float32(REACH), np.float32(1 / CELL)
    for n in range(0, len(cloud), 1 + len(cloud) // ENOUGH_POINTS):
        i, j = (cloud[n, 0] + reach) * per_metre, (cloud[n, 1] + reach) * per_metre
        if 0.0 <= i < SIDE and 0.0 <= j < SIDE:
            a, b = int(i), int(j)
            # not a number fails the comparison, minus infinity must not win it
            if -reach < cloud[n, 2] < grid[a, b, 2]:
                for c in range(3):
                    grid[a, b, c] = cloud[n, c]
    return grid


@njit(cache=True, nogil=True)
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
    cells, above = np.empty(((2 * reach + 1) ** 2, 3)), np.empty((2 * reach + 1) ** 2)
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
    expected = plane.copy()
    level = ordered(above[:n])[n // 4]
    # where even the lowest quarter is higher than a plausible slope allows, only walls and objects were hit
    if not level > expected[0] + 0.5 + 0.1 * radius:
        plane[0] = level
    for step in range(6):
        scale = 0.6 if step < 2 else (0.3 if step < 4 else 0.15)
        _solve_plane(cells, n, scale, SLOPE_BELIEF * 0.25 * radius * radius, expected, plane)


@njit(cache=True, nogil=True)
def _solve_plane(cells, n, scale, slope_belief, expected, plane):  # type: ignore[no-untyped-def]
    """One step of the reweighted least squares of `fit_plane`, from ``plane`` to ``plane``."""
    sw = su = sv = sz = suv = 0.0
    suu = svv = slope_belief
    suz, svz = slope_belief * expected[1], slope_belief * expected[2]
    if expected[0] == expected[0]:
        sw, sz = HEIGHT_BELIEF, HEIGHT_BELIEF * expected[0]
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
    a, b, c = suu * svv - suv * suv, suv * sv - su * svv, su * suv - suu * sv
    determinant = sw * a + su * b + sv * c
    if determinant > 1e-9:
        plane[0] = (a * sz + b * suz + c * svz) / determinant
        plane[1] = (b * sz + (sw * svv - sv * sv) * suz + (su * sv - sw * suv) * svz) / determinant
        plane[2] = (c * sz + (su * sv - sw * suv) * suz + (sw * suu - su * su) * svz) / determinant


@njit(cache=True, nogil=True)
def ground_along(grid, yaw, expected, planes):  # type: ignore[no-untyped-def]
    """Ground planes along the ray of heading ``yaw``, each expected to go on from the last (numba).

    Fills ``planes`` (STATIONS, 3): row s holds z = a + b x + c y, x along the ray, around range
    ``FIRST_STATION * STATION_STEP ** s``. ``expected`` is the height at the sensor's foot.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    plane = np.array([expected, 0.0, 0.0])
    before = 0.0
    for s in range(STATIONS):
        reach = FIRST_STATION * STATION_STEP**s
        plane[0] += (plane[1] * cos + plane[2] * sin) * (reach - before)
        fit_plane(grid, reach * cos, reach * sin, RADIUS, plane)
        planes[s, 1] = plane[1] * cos + plane[2] * sin
        planes[s, 2] = plane[2] * cos - plane[1] * sin
        planes[s, 0] = plane[0] - planes[s, 1] * reach
        before = reach


@njit(cache=True, nogil=True)
def station_of(reach):  # type: ignore[no-untyped-def]
    """Row of `ground_along` for a range in metres."""
    s, limit = 0, FIRST_STATION * math.sqrt(STATION_STEP)
    while reach > limit and s < STATIONS - 1:
        s += 1
        limit *= STATION_STEP
    return s

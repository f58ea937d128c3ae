"""The ground along a frustum, from the planes of `lcf3d.geometry.ground`."""

from __future__ import annotations

import math

import numpy as np

from lcf3d.geometry.ground import fit_plane
from lcf3d.kernels import kernel

# cells around a place that take part in its plane
RADIUS = 10.0
# ranges, in geometric steps, at which the ground along a frustum is modelled
STATIONS = 8
FIRST_STATION = 4.0
STATION_STEP = 1.5


@kernel
def ground_along(grid, yaw, expected, planes):  # type: ignore[no-untyped-def]
    """Ground planes along the ray of heading ``yaw``, each expected to go on from the last (numba).

    Fills ``planes`` (STATIONS, 3): row s holds z = a + b x + c y, x along the ray, around range
    ``FIRST_STATION * STATION_STEP ** s``. ``expected`` is the height at the sensor's foot.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    plane = np.empty(3)
    plane[0], plane[1], plane[2] = expected, 0.0, 0.0
    before, reach = 0.0, FIRST_STATION
    for s in range(STATIONS):
        plane[0] += (plane[1] * cos + plane[2] * sin) * (reach - before)
        fit_plane(grid, reach * cos, reach * sin, RADIUS, plane)
        planes[s, 1] = plane[1] * cos + plane[2] * sin
        planes[s, 2] = plane[2] * cos - plane[1] * sin
        planes[s, 0] = plane[0] - planes[s, 1] * reach
        before = reach
        reach *= STATION_STEP


@kernel
def station_of(reach):  # type: ignore[no-untyped-def]
    """Row of `ground_along` for a range in metres."""
    s, limit = 0, FIRST_STATION * math.sqrt(STATION_STEP)
    while reach > limit and s < STATIONS - 1:
        s += 1
        limit *= STATION_STEP
    return s

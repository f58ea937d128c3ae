"""Fits a box to a cluster of points, to its 2D box, to the ground and to the sizes of its class.

A fit has seven parameters: x, y, lift over the ground plane, length, width, height, yaw, all in the frustum frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

PARAMETERS = 7
X, Y, LIFT, LENGTH, WIDTH, HEIGHT, YAW = range(PARAMETERS)

# yaws tried over half a turn, how many of them are refined, and for how long
YAWS = 16
STARTS = 4
FIRST_ROUNDS = 4
LAST_ROUNDS = 10
# solid bodies: how far a point may lie outside and inside of a visible side, in metres, and the most that one inside
# (seen through a window, or on the roof) costs beside one outside
OUTSIDE = 0.07
INSIDE = 0.3
INSIDE_COST = 0.4
SOLID_STRENGTH = 50.0
# open bodies: spread of the points in lengths and widths, and how far the far side, which is seen less, shifts them
SPREAD = 0.25
SHIFT = 0.06
OPEN_STRENGTH = 20.0
# points that suffice for the full strength of their term
FULL_COUNT = 30.0
# error of a 2D box's upper and lower edge as a share of its height, and of every edge in pixels
EDGE_DEVIATION = 0.035
PIXEL_DEVIATION = 1.0
# deviation of an object's foot from the ground plane in metres
LIFT_DEVIATION = 0.1


class Evidence(NamedTuple):
    """What a fit has to agree with; arrays are float64, lengths in metres, in the frustum frame.

    Attributes:
        points: (N, 3) x, y and weight of the cluster.
        strength: weight of the points beside the other terms.
        ground: (3,) a, b, c of the plane z = a + b x + c y.
        projection: (3, 4) pixels from the frustum frame.
        image_size: (2,) width and height in pixels.
        box2d: (4,) pixels.
        edge_sigma: (2,) deviation of the 2D box's vertical and horizontal edges in pixels.
        mean: (3,) length, width, height of the class.
        deviation: (3,) their deviations.
        solid: whether beams stop at the sides of the body.
    """

    points: NDArray[np.float64]
    strength: float
    ground: NDArray[np.float64]
    projection: NDArray[np.float64]
    image_size: NDArray[np.float64]
    box2d: NDArray[np.float64]
    edge_sigma: NDArray[np.float64]
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]
    solid: bool


@njit(cache=True, nogil=True)
def image_cost(q, evidence):  # type: ignore[no-untyped-def]
    """Squares (linear beyond two sigma) of the distances of the projection's edges, clipped to the image, to the 2D box's."""
    ground, projection, box2d = evidence.ground, evidence.projection, evidence.box2d
    cos, sin = math.cos(q[YAW]), math.sin(q[YAW])
    bottom = ground[0] + ground[1] * q[X] + ground[2] * q[Y] + q[LIFT]
    x1 = y1 = 1e9
    x2 = y2 = -1e9
    for c in range(4):
        along = 0.5 * q[LENGTH] if c < 2 else -0.5 * q[LENGTH]
        across = 0.5 * q[WIDTH] if c % 2 == 0 else -0.5 * q[WIDTH]
        x, y = q[X] + cos * along - sin * across, q[Y] + sin * along + cos * across
        u = projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * bottom + projection[0, 3]
        v = projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * bottom + projection[1, 3]
        w = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * bottom + projection[2, 3]
        for top in range(2):
            if top == 1:
                u += projection[0, 2] * q[HEIGHT]
                v += projection[1, 2] * q[HEIGHT]
                w += projection[2, 2] * q[HEIGHT]
            # a corner behind the camera ends far outside the image, on its side
            depth = max(w, 0.1)
            x1, x2 = min(x1, u / depth), max(x2, u / depth)
            y1, y2 = min(y1, v / depth), max(y2, v / depth)
    width, height = evidence.image_size[0], evidence.image_size[1]
    across_sigma, down_sigma = evidence.edge_sigma[0], evidence.edge_sigma[1]
    total = _robust((min(max(x1, 0.0), width) - box2d[0]) / across_sigma)
    total += _robust((min(max(x2, 0.0), width) - box2d[2]) / across_sigma)
    total += _robust((min(max(y1, 0.0), height) - box2d[1]) / down_sigma)
    return total + _robust((min(max(y2, 0.0), height) - box2d[3]) / down_sigma)


@njit(cache=True, nogil=True, inline="always")
def _robust(off):  # type: ignore[no-untyped-def]
    return off * off if abs(off) < 2.0 else 4.0 * abs(off) - 4.0


@njit(cache=True, nogil=True)
def solid_cost(q, points):  # type: ignore[no-untyped-def]
    """Mean cost, 0 to 1, of points that are not on the visible sides of a closed body, seen from above (numba).

    Args:
        q: (7,) parameters.
        points: (N, 3) x, y and weight; the sensor is at the origin.
    """
    cos, sin = math.cos(q[YAW]), math.sin(q[YAW])
    half_length, half_width = 0.5 * q[LENGTH], 0.5 * q[WIDTH]
    sensor_u, sensor_v = -q[X] * cos - q[Y] * sin, q[X] * sin - q[Y] * cos
    total = mass = 0.0
    for n in range(len(points)):
        dx, dy = points[n, 0] - q[X], points[n, 1] - q[Y]
        u, v = dx * cos + dy * sin, dy * cos - dx * sin
        out_u, out_v = abs(u) - half_length, abs(v) - half_width
        if out_u > 0.0 or out_v > 0.0:
            out_u, out_v = max(out_u, 0.0), max(out_v, 0.0)
            square = (out_u * out_u + out_v * out_v) / (OUTSIDE * OUTSIDE)
            cost = square / (4.0 + square)
        else:
            off = 1e9
            if sensor_u > half_length:
                off = half_length - u
            elif sensor_u < -half_length:
                off = half_length + u
            if sensor_v > half_width:
                off = min(off, half_width - v)
            elif sensor_v < -half_width:
                off = min(off, half_width + v)
            square = off * off / (INSIDE * INSIDE)
            cost = INSIDE_COST * square / (4.0 + square)
        total += points[n, 2] * cost
        mass += points[n, 2]
    return total / mass if mass > 0.0 else 1.0


@njit(cache=True, nogil=True)
def open_cost(q, points):  # type: ignore[no-untyped-def]
    """Mean cost, 0 to 1, of points far from the middle of a body that beams enter, seen from above (numba)."""
    cos, sin = math.cos(q[YAW]), math.sin(q[YAW])
    nearer = 1.0 - SHIFT / max(math.hypot(q[X], q[Y]), SHIFT)
    x, y = q[X] * nearer, q[Y] * nearer
    per_length, per_width = 1.0 / (SPREAD * q[LENGTH]), 1.0 / (SPREAD * q[WIDTH])
    total = mass = 0.0
    for n in range(len(points)):
        dx, dy = points[n, 0] - x, points[n, 1] - y
        u, v = (dx * cos + dy * sin) * per_length, (dy * cos - dx * sin) * per_width
        square = u * u + v * v
        total += points[n, 2] * square / (4.0 + square)
        mass += points[n, 2]
    return total / mass if mass > 0.0 else 1.0


@njit(cache=True, nogil=True)
def energy(q, evidence):  # type: ignore[no-untyped-def]
    """What a good fit makes small: disagreement with points, 2D box, class sizes and ground (numba)."""
    surface = solid_cost(q, evidence.points) if evidence.solid else open_cost(q, evidence.points)
    total = evidence.strength * surface + 0.5 * image_cost(q, evidence)
    for i in range(3):
        off = (q[LENGTH + i] - evidence.mean[i]) / evidence.deviation[i]
        total += 0.5 * off * off
    off = q[LIFT] / LIFT_DEVIATION
    return total + 0.5 * min(off * off, 9.0)


@njit(cache=True, nogil=True)
def refine(q, rounds, evidence):  # type: ignore[no-untyped-def]
    """Pattern search, one parameter after the other, from ``q`` (changed in place); returns the energy reached."""
    step = np.empty(PARAMETERS)
    step[X], step[Y], step[LIFT], step[YAW] = 0.3, 0.2, 0.05, 0.12
    if not evidence.solid:
        step[X], step[Y], step[YAW] = 0.1, 0.1, 0.2
    for i in range(3):
        step[LENGTH + i] = 0.5 * evidence.deviation[i]
    best = energy(q, evidence)
    for _ in range(rounds):
        for i in range(PARAMETERS):
            kept = q[i]
            for _ in range(2):
                q[i] = kept + step[i]
                if LENGTH <= i <= HEIGHT:
                    q[i] = max(q[i], 0.1)
                value = energy(q, evidence)
                if value < best:
                    break
                step[i] = -step[i]
            if value < best:
                best = value
                step[i] *= 1.3
            else:
                q[i] = kept
                step[i] *= 0.5
    return best


@njit(cache=True, nogil=True)
def search(near, evidence):  # type: ignore[no-untyped-def]
    """The best box for the evidence (numba).

    All yaws over half a turn are tried at their likeliest places: on the near corner of the points (the closeness
    criterion then is the energy's first term) and centred on the frustum's axis behind the range ``near``. The best
    few are refined a little, the best one of these to the end.

    Returns:
        (7,) parameters and the energy.
    """
    points = evidence.points
    energies, starts = np.full(STARTS, np.inf), np.empty((STARTS, PARAMETERS))
    q = np.zeros(PARAMETERS)
    q[LENGTH : HEIGHT + 1] = evidence.mean
    us, vs = np.empty(len(points)), np.empty(len(points))
    middle_x, middle_y = np.median(points[:, 0]), np.median(points[:, 1])
    for t in range(YAWS):
        q[YAW] = math.pi * t / YAWS
        cos, sin = math.cos(q[YAW]), math.sin(q[YAW])
        if not evidence.solid:
            q[X], q[Y] = middle_x + SHIFT, middle_y
            _keep_best(energies, starts, energy(q, evidence), q)
            continue
        for i in range(len(points)):
            us[i], vs[i] = points[i, 0] * cos + points[i, 1] * sin, points[i, 1] * cos - points[i, 0] * sin
        u, v = _completed_centre(us, q[LENGTH]), _completed_centre(vs, q[WIDTH])
        q[X], q[Y] = u * cos - v * sin, u * sin + v * cos
        _keep_best(energies, starts, energy(q, evidence), q)
        depth = 0.5 * (abs(cos) * q[LENGTH] + abs(sin) * q[WIDTH])
        for share in (0.8, 1.1):
            q[X], q[Y] = near + share * depth, 0.0
            _keep_best(energies, starts, energy(q, evidence), q)
    for k in range(STARTS):
        if energies[k] < np.inf:
            energies[k] = refine(starts[k], FIRST_ROUNDS, evidence)
    best = np.argmin(energies)
    return starts[best], refine(starts[best], LAST_ROUNDS, evidence)


@njit(cache=True, nogil=True)
def _completed_centre(values, size):  # type: ignore[no-untyped-def]
    """Centre along one axis of a body of known size whose near side is seen; the third outermost points bound it."""
    order = np.sort(values)
    trim = min(2, (len(order) - 1) // 4)
    low, high = order[trim], order[len(order) - 1 - trim]
    if high - low > size or low < 0.0 < high:
        return 0.5 * (low + high)
    return low + 0.5 * size if low >= 0.0 else high - 0.5 * size


@njit(cache=True, nogil=True)
def _keep_best(energies, starts, value, q):  # type: ignore[no-untyped-def]
    """Enter ``q`` among the best starts, of which no two have the same yaw."""
    place = np.argmax(energies)
    for k in range(len(energies)):
        if energies[k] < np.inf and starts[k, YAW] == q[YAW]:
            place = k
    if value < energies[place]:
        energies[place] = value
        starts[place] = q

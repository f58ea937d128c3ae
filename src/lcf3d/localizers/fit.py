"""Fits a box to a cluster of points, to its 2D box, to the ground and to the sizes of its class.

A fit has seven parameters: x, y, lift over the ground plane, length, width, height, yaw, all in the frustum frame.
"""

from __future__ import annotations

import math

import numpy as np

from lcf3d.geometry.ground import ordered
from lcf3d.kernels import kernel

PARAMETERS = 7
X, Y, LIFT, LENGTH, WIDTH, HEIGHT, YAW = range(PARAMETERS)

# yaws tried over half a turn, how many of them are refined, and for how long
YAWS = 12
STARTS = 3
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
EDGE_DEVIATION = 0.05
PIXEL_DEVIATION = 1.0
# deviation of an object's foot from the ground plane in metres
LIFT_DEVIATION = 0.1


# What a fit has to agree with beside the points, in one array of numbers (numba compiles that fastest), each at its
# place; lengths in metres, in the frustum frame:
STRENGTH = 0  # weight of the points beside the other terms
GROUND = 1  # a, b, c of the plane z = a + b x + c y
PROJECTION = 4  # the 12 numbers, row by row, of pixels from the frustum frame
IMAGE_SIZE = 16  # width, height
BOX2D = 18  # x1, y1, x2, y2
EDGE_SIGMA = 22  # deviation of the 2D box's vertical and of its horizontal edges in pixels
MEAN = 24  # length, width, height of the class
DEVIATION = 27  # their deviations
SOLID = 30  # 1 where beams stop at the sides of the body
EVIDENCE = 31


@kernel
def image_cost(q, evidence):  # type: ignore[no-untyped-def]
    """How far the edges of the projection, clipped to the image, are from those of the 2D box (numba).

    Squares in units of one sigma, linear beyond two, over the four edges.
    """
    p, box2d = evidence[PROJECTION:IMAGE_SIZE], evidence[BOX2D:EDGE_SIGMA]
    cos, sin = math.cos(q[YAW]), math.sin(q[YAW])
    bottom = evidence[GROUND] + evidence[GROUND + 1] * q[X] + evidence[GROUND + 2] * q[Y] + q[LIFT]
    x1 = y1 = 1e9
    x2 = y2 = -1e9
    for c in range(4):
        along = 0.5 * q[LENGTH] if c < 2 else -0.5 * q[LENGTH]
        across = 0.5 * q[WIDTH] if c % 2 == 0 else -0.5 * q[WIDTH]
        x, y = q[X] + cos * along - sin * across, q[Y] + sin * along + cos * across
        u = p[0] * x + p[1] * y + p[2] * bottom + p[3]
        v = p[4] * x + p[5] * y + p[6] * bottom + p[7]
        w = p[8] * x + p[9] * y + p[10] * bottom + p[11]
        for top in range(2):
            if top == 1:
                u += p[2] * q[HEIGHT]
                v += p[6] * q[HEIGHT]
                w += p[10] * q[HEIGHT]
            # a corner behind the camera ends far outside the image, on its side
            depth = max(w, 0.1)
            x1, x2 = min(x1, u / depth), max(x2, u / depth)
            y1, y2 = min(y1, v / depth), max(y2, v / depth)
    width, height = evidence[IMAGE_SIZE], evidence[IMAGE_SIZE + 1]
    across_sigma, down_sigma = evidence[EDGE_SIGMA], evidence[EDGE_SIGMA + 1]
    total = _robust((min(max(x1, 0.0), width) - box2d[0]) / across_sigma)
    total += _robust((min(max(x2, 0.0), width) - box2d[2]) / across_sigma)
    total += _robust((min(max(y1, 0.0), height) - box2d[1]) / down_sigma)
    return total + _robust((min(max(y2, 0.0), height) - box2d[3]) / down_sigma)


@kernel
def _robust(off):  # type: ignore[no-untyped-def]
    return off * off if abs(off) < 2.0 else 4.0 * abs(off) - 4.0


@kernel
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


@kernel
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


@kernel
def energy(q, points, evidence):  # type: ignore[no-untyped-def]
    """What a good fit makes small: disagreement with points, 2D box, class sizes and ground (numba)."""
    surface = solid_cost(q, points) if evidence[SOLID] > 0.0 else open_cost(q, points)
    total = evidence[STRENGTH] * surface + 0.5 * image_cost(q, evidence)
    for i in range(3):
        off = (q[LENGTH + i] - evidence[MEAN + i]) / evidence[DEVIATION + i]
        total += 0.5 * off * off
    off = q[LIFT] / LIFT_DEVIATION
    return total + 0.5 * min(off * off, 9.0)


@kernel
def refine(q, rounds, points, evidence):  # type: ignore[no-untyped-def]
    """Pattern search, one parameter after the other, from ``q`` (changed in place); returns the energy reached."""
    step = np.empty(PARAMETERS)
    step[X], step[Y], step[LIFT], step[YAW] = 0.3, 0.2, 0.05, 0.12
    if evidence[SOLID] == 0.0:
        step[X], step[Y], step[YAW] = 0.1, 0.1, 0.2
    for i in range(3):
        step[LENGTH + i] = 0.5 * evidence[DEVIATION + i]
    best = energy(q, points, evidence)
    for _ in range(rounds):
        for i in range(PARAMETERS):
            kept = q[i]
            for _ in range(2):
                q[i] = kept + step[i]
                if LENGTH <= i <= HEIGHT:
                    q[i] = max(q[i], 0.1)
                value = energy(q, points, evidence)
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


@kernel
def search(points, evidence):  # type: ignore[no-untyped-def]
    """The best box for the evidence (numba).

    Yaws over half a turn are tried, a solid body with its near sides on the outermost points (the energy's first term
    is the closeness criterion then), an open one around the middle of the points. The best few are refined a little,
    the best one of these to the end.

    Args:
        points: (N, 3) x, y and weight of the cluster.
        evidence: (`EVIDENCE`,) what else the fit has to agree with.

    Returns:
        (7,) parameters and the energy.
    """
    energies, starts, q = np.empty(STARTS), np.empty((STARTS, PARAMETERS)), np.empty(PARAMETERS)
    for k in range(STARTS):
        energies[k] = np.inf
    q[LIFT] = 0.0
    for i in range(3):
        q[LENGTH + i] = evidence[MEAN + i]
    us, vs = np.empty(len(points)), np.empty(len(points))
    half = len(points) // 2
    for i in range(len(points)):
        us[i], vs[i] = points[i, 0], points[i, 1]
    middle_x, middle_y = ordered(us)[half], ordered(vs)[half]
    for t in range(YAWS):
        q[YAW] = math.pi * t / YAWS
        cos, sin = math.cos(q[YAW]), math.sin(q[YAW])
        q[X], q[Y] = middle_x + SHIFT, middle_y
        if evidence[SOLID] > 0.0:
            for i in range(len(points)):
                us[i], vs[i] = points[i, 0] * cos + points[i, 1] * sin, points[i, 1] * cos - points[i, 0] * sin
            u, v = _completed_centre(us, q[LENGTH]), _completed_centre(vs, q[WIDTH])
            q[X], q[Y] = u * cos - v * sin, u * sin + v * cos
        _keep_best(energies, starts, energy(q, points, evidence), q)
    best = 0
    for k in range(STARTS):
        if energies[k] < np.inf:
            energies[k] = refine(starts[k], int(FIRST_ROUNDS), points, evidence)
        if energies[k] < energies[best]:
            best = k
    return starts[best], refine(starts[best], int(LAST_ROUNDS), points, evidence)


@kernel
def _completed_centre(values, size):  # type: ignore[no-untyped-def]
    """Centre along one axis of a body of known size whose near side is seen; the third outermost points bound it."""
    order = ordered(values)
    trim = min(2, (len(order) - 1) // 4)
    low, high = order[trim], order[len(order) - 1 - trim]
    if high - low > size or low < 0.0 < high:
        return 0.5 * (low + high)
    return low + 0.5 * size if low >= 0.0 else high - 0.5 * size


@kernel
def _keep_best(energies, starts, value, q):  # type: ignore[no-untyped-def]
    """Enter ``q`` among the best starts."""
    place = 0
    for k in range(len(energies)):
        if energies[k] > energies[place]:
            place = k
    if value < energies[place]:
        energies[place] = value
        for i in range(PARAMETERS):
            starts[place, i] = q[i]

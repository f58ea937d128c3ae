"""Small compiled functions for textures and patterns, shared by the camera and the LiDAR."""

from __future__ import annotations

import math

from lcf3d.kernels import kernel
from lcf3d.simulation.textures import LEVEL_OFFSET, LEVELS, SIZE

_OFFSETS = tuple(int(v) for v in LEVEL_OFFSET)


@kernel(inline="always")
def _hash(a, b):  # type: ignore[no-untyped-def]
    """A number in [0, 1) for a pair of integers."""
    h = (a * 374761393 + b * 668265263) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


@kernel
def value_noise(x, y):  # type: ignore[no-untyped-def]
    """Smooth noise in [0, 1) with cells of size 1."""
    ix, iy = math.floor(x), math.floor(y)
    fx, fy = x - ix, y - iy
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    low = _hash(ix, iy) * (1 - fx) + _hash(ix + 1, iy) * fx
    high = _hash(ix, iy + 1) * (1 - fx) + _hash(ix + 1, iy + 1) * fx
    return low * (1 - fy) + high * fy


@kernel
def sample(textures, texture, x, y, texels, albedo):  # type: ignore[no-untyped-def]
    """Multiply ``albedo`` by a texture at tile coordinates; ``texels`` is the width of the pixel on the texture."""
    level = 0
    while texels > 1.42 and level < LEVELS - 1:
        texels *= 0.5
        level += 1
    size = SIZE >> level
    gx, gy = x * size - 0.5, y * size - 0.5
    ix, iy = math.floor(gx), math.floor(gy)
    fx, fy = gx - ix, gy - iy
    xa, xb = ix & (size - 1), (ix + 1) & (size - 1)
    ya, yb = (iy & (size - 1)) * size, ((iy + 1) & (size - 1)) * size
    start = _OFFSETS[level]
    tile = textures[texture]
    for k in range(3):
        low = tile[start + ya + xa, k] * (1 - fx) + tile[start + ya + xb, k] * fx
        high = tile[start + yb + xa, k] * (1 - fx) + tile[start + yb + xb, k] * fx
        albedo[k] *= low * (1 - fy) + high * fy


@kernel(inline="always")
def _band(x, half, blur):  # type: ignore[no-untyped-def]
    """Coverage of a line of half width ``half`` at distance ``x``, seen with a pixel ``blur`` wide."""
    edge = max(blur, 0.01)
    return min(max((half - x) / edge + 0.5, 0.0), 1.0) * min(1.0, 2 * half / edge)


@kernel
def road_mark(s, t, road, blur):  # type: ignore[no-untyped-def]
    """Share of paint, 0 to 1, at arc length ``s`` and offset ``t`` of the road described by ``road``.

    See `Site.markings` for the numbers in ``road``.
    """
    half = road[0]
    paint = 0.0
    zebra = s - road[4]
    if abs(zebra) < 2.0 and abs(t) < half - 0.2:
        return _band(abs((t + 100.0) % 1.0 - 0.5), 0.25, blur) * 0.95
    for k in range(3):
        gap = abs(s - road[6 + 2 * k])
        if gap < road[7 + 2 * k] + 3.0:
            if (
                abs(gap - road[7 + 2 * k] - 2.6) < 0.25
                and (
                    (s < road[6 + 2 * k] and t < -0.15 and t > -half + road[5])
                    or (s > road[6 + 2 * k] and t > 0.15 and t < half - road[5])
                )
                and road[1] > 0
            ):
                return 0.9
            return 0.0
    if abs(zebra) < 4.0:
        return 0.0
    if road[1] > 0:
        dash = 1.0 if road[1] == 2 else _band(abs(s % 9.0 - 1.5), 1.5, blur)
        paint = max(paint, _band(abs(t), 0.07, blur) * dash)
    if road[2] > 0:
        paint = max(paint, _band(abs(abs(t) - (half - 0.22)), 0.08, blur))
    if road[3] > 0:
        paint = max(paint, _band(abs(abs(t) - road[3]), 0.07, blur) * _band(abs(s % 9.0 - 1.5), 1.5, blur))
    if road[5] > 0:
        edge = half - road[5]
        paint = max(paint, _band(abs(abs(t) - edge), 0.05, blur) * 0.8)
        if abs(t) > edge:
            paint = max(paint, _band(abs(s % 6.0 - 3.0), 0.05, blur) * 0.8)
    return paint * 0.9


@kernel
def facade(x, y, seed, blur, night, albedo):  # type: ignore[no-untyped-def]
    """Windows, doors and shops on a wall whose cells are one unit wide and high; changes ``albedo`` in place.

    Returns how far the point is window glass (0 to 1), or minus the brightness of a lit window at night.
    """
    number = int(seed * 9973)
    column, floor = math.floor(x), math.floor(y)
    fx, fy = x - column, y - floor
    wide = 0.19 + 0.10 * _hash(number, 3)
    low, high = 0.26 + 0.08 * _hash(number, 5), 0.80 + 0.08 * _hash(number, 7)
    shop = floor == 0 and _hash(number, 11) > 0.62
    door = floor == 0 and not shop and _hash(number + column, 13) > 0.78
    if shop:
        wide, low, high = 0.43, 0.10, 0.80
    if door:
        wide, low, high = 0.17, 0.0, 0.74
    dx = abs(fx - 0.5)
    inside = min(wide - dx, min(fy - low, high - fy))
    soft = min(max(inside / max(blur, 0.02) + 0.5, 0.0), 1.0)
    trim = 0.075
    if _hash(number, 17) > 0.45 and soft < 1:  # light surround of the window
        ring = min(max((inside + trim) / max(blur, 0.02) + 0.5, 0.0), 1.0) - soft
        for k in range(3):
            albedo[k] = albedo[k] * (1 - ring) + 0.62 * ring
    stain = 1.0 - 0.10 * max(0.0, 1.0 - (y * 0.6)) - 0.05 * value_noise(x * 2.3, y * 0.7)
    for k in range(3):
        albedo[k] *= stain
    if shop and fy > 0.83:
        band = min(max((fy - 0.83) / max(blur, 0.02), 0.0), 1.0)
        albedo[0] = albedo[0] * (1 - band) + band * (0.1 + 0.5 * _hash(number, 19))
        albedo[1] = albedo[1] * (1 - band) + band * (0.1 + 0.3 * _hash(number, 23))
        albedo[2] = albedo[2] * (1 - band) + band * (0.1 + 0.4 * _hash(number, 29))
    if soft <= 0:
        return 0.0
    if door:
        shade = 0.05 + 0.10 * _hash(number, 31)
        panel = 0.8 if min(abs(fx - 0.42), abs(fx - 0.58)) < 0.012 else 1.0
        albedo[0] = albedo[0] * (1 - soft) + shade * 1.2 * panel * soft
        albedo[1] = albedo[1] * (1 - soft) + shade * 0.9 * panel * soft
        albedo[2] = albedo[2] * (1 - soft) + shade * 0.7 * panel * soft
        return 0.0
    bar = dx < 0.014 or (shop and (abs(dx - 0.22) < 0.012 or abs(fy - 0.62) < 0.014))
    frame = 1.0 if inside < 0.035 or bar else 0.0
    frame *= soft * min(1.0, 0.04 / max(blur, 0.04))
    light = _hash(number + 7 * column, 37 + floor)
    curtain = 0.0
    if light > 0.45 and not shop:
        reach = 0.05 + 0.12 * _hash(column + number, 41 + floor)
        curtain = 0.55 if dx > wide - reach else 0.0
        if light > 0.85 and fy > high - 0.5 * (high - low):
            curtain = 0.5
    reveal = 0.5 if high - fy < 0.06 else 1.0
    if shop:  # something dim on display, darker towards the ceiling
        curtain = 0.22 * value_noise(x * 6.0 + seed * 50.0, y * 9.0) * max(0.62 - fy, 0.0) / 0.5
    glass = (0.012 + 0.03 * _hash(number + column, 43 + floor)) * reveal + 0.30 * curtain * reveal
    for k in range(3):
        pane = glass * (1 - frame) + 0.55 * frame
        albedo[k] = albedo[k] * (1 - soft) + pane * soft
    if night > 0 and light > 0.62:
        for k in range(3):
            albedo[k] = max(albedo[k], (0.9 - 0.25 * k) * soft * (1 - frame))
        return -0.14 * soft
    return soft * (1 - frame) * (1 - 0.7 * curtain)

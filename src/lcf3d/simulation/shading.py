"""Colour of what a camera ray has hit: textures, light, mirror images and haze, compiled with numba."""

from __future__ import annotations

import math

import numpy as np

from lcf3d.kernels import kernel
from lcf3d.simulation.light import SKY_HEIGHT, SKY_WIDTH
from lcf3d.simulation.patterns import facade, road_mark, sample, value_noise
from lcf3d.simulation.textures import SIZE

_HALF_PI = math.pi / 2


@kernel(inline="always")
def _sky(sky, x, y, z, out):  # type: ignore[no-untyped-def]
    """Radiance of the sky in a direction, into ``out``."""
    row = math.asin(min(max(z, 0.0), 1.0)) / _HALF_PI * SKY_HEIGHT - 0.5
    column = (math.atan2(y, x) + math.pi) / (2 * math.pi) * SKY_WIDTH - 0.5
    r0 = math.floor(row)
    c0 = math.floor(column)
    fr = row - r0
    fc = column - c0
    ra, rb = min(max(r0, 0), SKY_HEIGHT - 1), min(max(r0 + 1, 0), SKY_HEIGHT - 1)
    ca, cb = c0 % SKY_WIDTH, (c0 + 1) % SKY_WIDTH
    for k in range(3):
        low = sky[ra, ca, k] * (1 - fc) + sky[ra, cb, k] * fc
        high = sky[rb, ca, k] * (1 - fc) + sky[rb, cb, k] * fc
        out[k] = low * (1 - fr) + high * fr


@kernel(inline="always")
def _mirror(sky, light, x, y, z, out):  # type: ignore[no-untyped-def]
    """What is seen in a mirror that looks that way: sky, a dim row of houses at the horizon, or the road."""
    azimuth = math.atan2(y, x)
    skyline = 0.10 + 0.12 * value_noise(azimuth * 4.0, 3.7) + 0.08 * value_noise(azimuth * 13.0, 9.1)
    bright = 0.16 + 0.22 * value_noise(azimuth * 9.0, 1.3)
    above = min(max((z - skyline) / 0.06 + 0.5, 0.0), 1.0)
    below = min(max(0.5 - z / 0.16, 0.0), 1.0)
    if above > 0:
        _sky(sky, x, y, z, out)
    for k in range(3):
        houses = bright * (light[6 + k] + 0.35 * light[3 + k])
        low = houses * (1 - below) + 0.8 * light[9 + k] * below
        out[k] = out[k] * above + low * (1 - above) if above > 0 else low


@kernel
def locate(triangle, u, v, distance, direction, origin, corners, normals, sun, position, normal, towards_sun):  # type: ignore[no-untyped-def]
    """World position and shading normal of N hits; returns how many of them can see the sun at all.

    ``position`` and ``normal`` (N, 3) and ``towards_sun`` (N,) bool are filled; normals look against the ray.
    """
    count = 0
    for i in range(len(triangle)):
        t = triangle[i]
        towards_sun[i] = False
        if t < 0:
            continue
        w = 1.0 - u[i] - v[i]
        ex0, ey0, ez0 = (
            corners[t, 1, 0] - corners[t, 0, 0],
            corners[t, 1, 1] - corners[t, 0, 1],
            corners[t, 1, 2] - corners[t, 0, 2],
        )
        ex1, ey1, ez1 = (
            corners[t, 2, 0] - corners[t, 0, 0],
            corners[t, 2, 1] - corners[t, 0, 1],
            corners[t, 2, 2] - corners[t, 0, 2],
        )
        gx, gy, gz = ey0 * ez1 - ez0 * ey1, ez0 * ex1 - ex0 * ez1, ex0 * ey1 - ey0 * ex1
        length = math.sqrt(gx * gx + gy * gy + gz * gz) + 1e-20
        gx, gy, gz = gx / length, gy / length, gz / length
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        nx = w * normals[t, 0, 0] + u[i] * normals[t, 1, 0] + v[i] * normals[t, 2, 0]
        ny = w * normals[t, 0, 1] + u[i] * normals[t, 1, 1] + v[i] * normals[t, 2, 1]
        nz = w * normals[t, 0, 2] + u[i] * normals[t, 1, 2] + v[i] * normals[t, 2, 2]
        if nx * gx + ny * gy + nz * gz < 0:
            nx, ny, nz = -nx, -ny, -nz
        if gx * dx + gy * dy + gz * dz > 0:
            gx, gy, gz, nx, ny, nz = -gx, -gy, -gz, -nx, -ny, -nz
        length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-20
        normal[i, 0], normal[i, 1], normal[i, 2] = nx / length, ny / length, nz / length
        lift = 2e-3 + 2e-5 * distance[i]
        position[i, 0] = origin[0] + dx * distance[i] + gx * lift
        position[i, 1] = origin[1] + dy * distance[i] + gy * lift
        position[i, 2] = origin[2] + dz * distance[i] + gz * lift
        if normal[i, 0] * sun[0] + normal[i, 1] * sun[1] + normal[i, 2] * sun[2] > -0.35:
            towards_sun[i] = True
            count += 1
    return count


@kernel
def shade(  # type: ignore[no-untyped-def]
    triangle,
    u,
    v,
    distance,
    direction,
    position,
    normal,
    lit,
    open_sky,
    uv,
    material,
    colour,
    seed,
    table,
    textures,
    road,
    sky,
    light,
    pixel_angle,
    out,
):
    """Linear radiance (N, 3) of N camera rays into ``out``.

    ``lit`` (N,) is 1 where the sun reaches, ``open_sky`` (N,) the share of the surroundings that is open, ``table`` the
    materials, ``road`` the markings, ``light`` the numbers of `Light.numbers`, ``pixel_angle`` radians a pixel.
    """
    albedo = np.empty(3, np.float32)
    mirror = np.empty(3, np.float32)
    for i in range(len(triangle)):
        t = triangle[i]
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        if t < 0:
            _sky(sky, dx, dy, dz, mirror)
            for k in range(3):
                out[i, k] = mirror[k]
            continue
        w = 1.0 - u[i] - v[i]
        s = w * uv[t, 0, 0] + u[i] * uv[t, 1, 0] + v[i] * uv[t, 2, 0]
        r = w * uv[t, 0, 1] + u[i] * uv[t, 1, 1] + v[i] * uv[t, 2, 1]
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        px, py, pz = position[i, 0], position[i, 1], position[i, 2]
        facing = max(-(dx * nx + dy * ny + dz * nz), 0.03)
        small = distance[i] * pixel_angle
        for k in range(3):
            albedo[k] = colour[t, k]
        row = table[material[t]]
        kind = int(row[0])
        specular, gloss, glow = _surface(
            row, textures, road, light, s, r, px, py, dx, dy, small, min(small / facing, 60.0), seed[t], albedo
        )
        _light_surface(
            kind,
            albedo,
            specular,
            gloss,
            nx,
            ny,
            nz,
            dx,
            dy,
            dz,
            px,
            py,
            pz,
            lit[i],
            open_sky[i],
            glow,
            facing,
            sky,
            light,
            mirror,
            out[i],
        )
        far = 1 - math.exp(-distance[i] / light[15])
        for k in range(3):
            out[i, k] = out[i, k] * (1 - far) + light[12 + k] * far


@kernel(inline="always")
def _surface(row, textures, road, light, s, r, px, py, dx, dy, small, large, seed, albedo):  # type: ignore[no-untyped-def]
    """Colour of a material at texture position (s, r) and place (px, py), into ``albedo``.

    ``row`` is the material's of the table, ``small`` and ``large`` are the sides of the pixel's patch on the surface in
    metres. Returns what it mirrors, how sharply, and how much it glows.
    """
    kind, texture, tile = int(row[0]), int(row[1]), row[2]
    specular, gloss, glow = row[3], row[4], 0.0
    if kind == 3 or kind == 8:
        _ground(textures, texture, tile, px, py, dx, dy, small, large, albedo)
        if kind == 3:
            specular = _carriageway(textures, texture, road, s, r, small, large, dx, dy, albedo, specular)
        if light[16] > 0:
            puddle = value_noise(px * 0.35, py * 0.35)
            for k in range(3):
                albedo[k] *= 1 - 0.45 * light[16]
            specular += light[16] * (0.02 + 0.10 * max(puddle - 0.45, 0.0))
            gloss = 0.6
    elif kind == 4:
        sample(textures, texture, s * 2.7 / tile, r * 3.0 / tile, large / tile * SIZE, albedo)
        window = facade(s, r, seed, large / 2.8, light[17], albedo)
        if window > 0:
            specular, gloss = 0.10 * window, 0.97
        if window < 0:
            glow = -window
    elif kind == 6:
        shade_k = 0.8 + 0.4 * seed
        for k in range(3):
            albedo[k] *= shade_k
    elif texture > 0:
        sample(textures, texture, s / tile, r / tile, large / tile * SIZE, albedo)
    return specular, gloss, glow


@kernel(inline="always")
def _ground(textures, texture, tile, x, y, dx, dy, small, large, albedo):  # type: ignore[no-untyped-def]
    """Texture of a horizontal surface by world position, filtered along the view, with large-scale variation."""
    flat = math.sqrt(dx * dx + dy * dy) + 1e-9
    taps = 4
    step = large / taps
    red, green, blue = 0.0, 0.0, 0.0
    keep0, keep1, keep2 = albedo[0], albedo[1], albedo[2]
    for j in range(taps):
        d = (j - 1.5) * step
        albedo[0], albedo[1], albedo[2] = keep0, keep1, keep2
        sample(
            textures,
            texture,
            (x + dx / flat * d) / tile,
            (y + dy / flat * d) / tile,
            max(small, step) / tile * SIZE,
            albedo,
        )
        red += albedo[0]
        green += albedo[1]
        blue += albedo[2]
    broad = 0.86 + 0.28 * (0.6 * value_noise(x * 0.13, y * 0.13) + 0.4 * value_noise(x * 0.55 + 7.3, y * 0.55))
    albedo[0], albedo[1], albedo[2] = red / taps * broad, green / taps * broad, blue / taps * broad


@kernel(inline="always")
def _carriageway(textures, texture, road, s, t, small, large, dx, dy, albedo, specular):  # type: ignore[no-untyped-def]
    """Wheel tracks, repairs and painted lines on the road; returns its mirror share."""
    half = road[0] - road[5]
    lane = half / 2 if road[3] == 0 else half / 4
    within = abs(abs(t) % (2 * lane) - lane)
    track = math.exp(-(((within - 0.75) / 0.28) ** 2))
    cell_s, cell_t = math.floor(s / 7.3), math.floor((t + 20.0) / 1.9)
    patch = value_noise(cell_s * 17.31, cell_t * 9.77)
    dark = 1.0 - 0.10 * track
    if patch > 0.86:
        inset = min(
            min(s / 7.3 - cell_s, 1 - (s / 7.3 - cell_s)) * 7.3,
            min((t + 20) / 1.9 - cell_t, 1 - ((t + 20) / 1.9 - cell_t)) * 1.9,
        )
        if inset > 0.12:
            dark *= 0.74
    paint = road_mark(s, t, road, max(small, large * 0.7))
    worn = 0.75 + 0.25 * value_noise(s * 3.1, t * 3.7)
    for k in range(3):
        albedo[k] = albedo[k] * dark * (1 - paint) + 0.62 * worn * paint
    return specular


@kernel(inline="always")
def _light_surface(  # type: ignore[no-untyped-def]
    kind,
    albedo,
    specular,
    gloss,
    nx,
    ny,
    nz,
    dx,
    dy,
    dz,
    px,
    py,
    pz,
    lit,
    open_sky,
    glow,
    facing,
    sky,
    light,
    mirror,
    out,
):
    """Radiance that leaves a surface towards the eye, into ``out``."""
    cosine = nx * light[0] + ny * light[1] + nz * light[2]
    direct = lit * (0.38 + 0.62 * max(cosine, 0.0) + 0.3 * max(-cosine, 0.0)) if kind == 6 else lit * max(cosine, 0.0)
    up = 0.5 + 0.5 * nz
    near = _lamps(px, py, pz, nx, ny, nz, light)
    fresnel = specular + (1 - specular) * (1 - facing) ** 5 * gloss * gloss if specular > 0 else 0.0
    back = 2 * (dx * nx + dy * ny + dz * nz)
    rx, ry, rz = dx - back * nx, dy - back * ny, dz - back * nz
    if fresnel > 0.004:
        _mirror(sky, light, rx, ry, rz, mirror)
        for k in range(3):
            mirror[k] = mirror[k] * gloss + (1 - gloss) * (light[6 + k] * up + light[9 + k] * (1 - up))
    else:
        mirror[0], mirror[1], mirror[2] = 0.0, 0.0, 0.0
    towards = max(rx * light[0] + ry * light[1] + rz * light[2], 0.0)
    sharp = 6.0 + 500.0 * gloss * gloss * gloss
    spot = lit * fresnel * (sharp + 2) * 0.12 * towards**sharp if fresnel > 0.004 else 0.0
    shield = 0.35 + 0.65 * open_sky
    for k in range(3):
        ambient = (light[6 + k] * up + light[9 + k] * (1 - up)) * open_sky
        body = albedo[k] * (direct * light[3 + k] + ambient + near * (1.0 - 0.12 * k))
        tint = albedo[k] * 1.6 if kind == 7 else 1.0
        out[k] = (
            body * (1 - fresnel)
            + tint * (fresnel * shield * mirror[k] + min(spot, 12.0) * light[3 + k])
            + glow * albedo[k]
        )
    if kind == 5 and light[17] > 0:
        for k in range(3):
            out[k] += albedo[k] * 2.2


@kernel(inline="always")
def _lamps(px, py, pz, nx, ny, nz, light):  # type: ignore[no-untyped-def]
    """Light from the car's headlamps and the street lamps at night."""
    if light[17] == 0:
        return 0.0
    total = 0.0
    vx, vy, vz = px - light[18], py - light[19], pz - (light[20] - 0.9)
    distance = math.sqrt(vx * vx + vy * vy + vz * vz) + 1e-6
    ahead = (vx * light[21] + vy * light[22] + vz * light[23]) / distance
    if ahead > 0.5:
        beam = math.exp(-(((ahead - 1.0) / 0.075) ** 2)) * 60.0 + 4.0 * ahead
        dip = 1.0 / (1.0 + math.exp((vz / distance - 0.012) * 90.0))
        facing = max(-(vx * nx + vy * ny + vz * nz) / distance, 0.0)
        total += beam * (0.12 + 0.88 * dip) * (0.15 + 0.85 * facing) / (distance * distance + 16.0)
    count = int(light[24])
    for j in range(count):
        b = 26 + 4 * j
        vx, vy, vz = light[b] - px, light[b + 1] - py, light[b + 2] - pz
        distance = math.sqrt(vx * vx + vy * vy + vz * vz) + 1e-6
        facing = max((vx * nx + vy * ny + vz * nz) / distance, 0.0)
        total += light[b + 3] * facing * max(vz / distance, 0.05) / (distance * distance + 2.0)
    return total

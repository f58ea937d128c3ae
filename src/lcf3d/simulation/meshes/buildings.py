"""Houses, and the fences and walls of their gardens."""

from __future__ import annotations

import numpy as np

from lcf3d.simulation.meshes.primitives import Mesh, box, make_mesh, quad, tube

Colour = tuple[float, float, float]
_STEEL: Colour = (0.33, 0.34, 0.35)
_DARK: Colour = (0.05, 0.055, 0.06)


def house(
    width: float,
    depth: float,
    floors: int,
    gable: bool,
    brick: bool,
    colour: Colour,
    roof: Colour,
    rng: np.random.Generator,
) -> Mesh:
    """A building centred on x = 0 whose front wall is at y = 0 and looks towards -y; it reaches back to y = depth."""
    storey = float(rng.uniform(2.8, 3.3))
    height = floors * storey + 0.5
    seed = float(rng.random())
    w = width / 2
    corners = [(-w, 0.0), (w, 0.0), (w, depth), (-w, depth)]
    material = "brick_front" if brick else "plaster"
    parts = []
    for k, (a, b) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
        run = float(np.hypot(b[0] - a[0], b[1] - a[1]))
        cells = max(1, round(run / 2.7))
        soup = quad((*a, 0.5), (*b, 0.5), (*b, height), (*a, height))
        uv = np.array([[[0, 0], [cells, 0], [cells, floors]], [[0, 0], [cells, floors], [0, floors]]], dtype=np.float32)
        parts.append(make_mesh(soup, material, colour, uv, seed=(seed + 0.137 * k) % 1.0))
    parts.append(box((0, depth / 2, 0.0), (width + 0.06, depth + 0.06, 1.0), "concrete", (0.30, 0.29, 0.28)))
    trim = tuple(min(1.0, 1.25 * c) for c in colour)
    if floors > 2 and not brick:
        for level in range(1, floors):
            parts.append(box((0, -0.04, 0.5 + level * storey), (width + 0.02, 0.1, 0.14), "wall", trim))
    if gable:
        parts += _gable_roof(w, depth, height, float(rng.uniform(0.55, 0.95)), colour, roof)
        parts.append(box((0.4 * w, depth * 0.6, height + depth * 0.35), (0.6, 0.6, 1.8), "brick", (0.25, 0.10, 0.07)))
    else:
        parts.append(box((0, depth / 2, height + 0.15), (width + 0.5, depth + 0.5, 0.3), "wall", trim))
        parts.append(box((0, depth / 2, height + 0.8), (width * 0.4, depth * 0.5, 1.4), "concrete", (0.35, 0.35, 0.35)))
    if rng.random() < 0.45 and floors > 1:
        for level in range(1, floors):
            at = float(rng.choice([-0.25, 0.25])) * width
            parts += _balcony(at, 0.5 + level * storey)
    return Mesh.join(parts)


def _gable_roof(w: float, depth: float, height: float, slope: float, wall: Colour, roof: Colour) -> list[Mesh]:
    """A roof whose ridge runs along x, with the triangular ends of the wall below it."""
    ridge = height + depth / 2 * slope
    over, drop = 0.45, 0.45 * slope
    parts = []
    for y0, sign in ((-over, 1.0), (depth + over, -1.0)):
        soup = quad(
            (-w - over, y0, height - drop),
            (w + over, y0, height - drop),
            (w + over, depth / 2, ridge),
            (-w - over, depth / 2, ridge),
        )
        run = float(np.hypot(depth / 2 + over, ridge - height + drop))
        uv = np.array([[[0, 0], [2 * w, 0], [2 * w, run]], [[0, 0], [2 * w, run], [0, run]]], dtype=np.float32)
        parts.append(make_mesh(soup, "roof", roof, uv))
        parts.append(
            tube(
                [(-w - over, y0 + 0.02 * sign, height - drop), (w + over, y0 + 0.02 * sign, height - drop)],
                [0.07, 0.07],
                "galvanised",
                _STEEL,
                5,
            )
        )
    for x in (-w, w):
        parts.append(make_mesh([[(x, 0, height), (x, depth, height), (x, depth / 2, ridge)]], "wall", wall))
    return parts


def _balcony(x: float, z: float) -> list[Mesh]:
    parts = [box((x, -0.6, z), (2.6, 1.2, 0.16), "concrete", (0.45, 0.44, 0.42))]
    parts.append(box((x, -1.17, z + 0.95), (2.6, 0.05, 0.06), "galvanised", _DARK))
    for k in range(9):
        parts.append(box((x - 1.25 + k * 2.5 / 8, -1.17, z + 0.5), (0.03, 0.03, 0.9), "galvanised", _DARK))
    return parts


def fence(length: float, height: float, wooden: bool) -> Mesh:
    """A fence along x."""
    material, colour = ("wood", (0.25, 0.16, 0.09)) if wooden else ("galvanised", (0.10, 0.11, 0.11))
    parts = [box((0, 0, z * height), (length, 0.04, 0.05), material, colour) for z in (0.25, 0.92)]
    step = 0.24 if wooden else 0.16
    thick = (0.10, 0.02) if wooden else (0.018, 0.018)
    for x in np.arange(-length / 2 + 0.1, length / 2, step):
        parts.append(box((x, 0, height / 2), (*thick, height), material, colour))
    return Mesh.join(parts)


def garden_wall(length: float, height: float, brick: bool) -> Mesh:
    """A low wall along x with a coping."""
    material, colour = ("brick", (0.36, 0.17, 0.11)) if brick else ("wall", (0.48, 0.46, 0.42))
    return Mesh.join(
        [
            box((0, 0, height / 2), (length, 0.22, height), material, colour),
            box((0, 0, height + 0.03), (length + 0.04, 0.3, 0.06), "concrete", (0.42, 0.41, 0.40)),
        ]
    )

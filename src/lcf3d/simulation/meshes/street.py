"""What stands along a street: houses, trees, hedges, walls, poles, signs and street furniture."""

# ruff: noqa: RUF005 - the vectors that lists are added to are numpy arrays
from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.meshes.primitives import Mesh, box, ellipsoid, grid, make_mesh, panel, quad, tube

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


def leaf_cloud(
    centre: NDArray[np.float64],
    radii: NDArray[np.float64],
    count: int,
    size: float,
    colour: Colour,
    rng: np.random.Generator,
) -> Mesh:
    """``count`` leaf-sized triangles near the surface of an ellipsoid, shaded as a round volume."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lump = 1.0 + 0.22 * np.sin(direction @ rng.normal(size=(3, 4)) * 4.0 + rng.uniform(0, 6, 4)).mean(axis=1)
    depth = rng.random(count) ** 0.45 * lump
    at = centre + direction * depth[:, None] * radii
    spread = rng.normal(size=(count, 3, 3))
    spread -= spread.mean(axis=1, keepdims=True)
    spread *= size / np.linalg.norm(spread, axis=2, keepdims=True)
    normals = direction / radii + rng.normal(scale=0.25, size=(count, 3)) / radii.mean()
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = make_mesh(
        at[:, None] + spread,
        "leaves",
        colour,
        uv=np.tile(np.array([[0, 0], [1, 0], [0, 1.0]]), (count, 1, 1)),
        normals=np.repeat(normals[:, None], 3, axis=1),
    )
    shade = (0.35 + 0.65 * np.clip(depth, 0, 1.1)) * rng.uniform(0.75, 1.25, count)
    tint = 1 + rng.normal(scale=0.10, size=(count, 3)) * [1.0, 0.4, 0.6]
    return replace(
        mesh,
        colour=(mesh.colour * shade[:, None] * tint).astype(np.float32).clip(0, 1),
        seed=rng.random(count).astype(np.float32),
    )


def tree(height: float, spread: float, colour: Colour, detail: int, leaf: float, rng: np.random.Generator) -> Mesh:
    """A broad-leaved tree on z = 0 with leaf clumps ``leaf`` metres large."""
    trunk = height * rng.uniform(0.28, 0.36)
    lean = rng.normal(scale=0.03 * height, size=2)
    radius = 0.028 * height
    bark = (0.13, 0.10, 0.075)
    top = np.array([lean[0], lean[1], height * 0.75])
    parts = [
        tube(
            np.array([(0, 0, -0.1), (0, 0, 0.3), (lean[0] * 0.3, lean[1] * 0.3, trunk), top]),
            [radius * 1.5, radius * 1.1, radius * 0.85, radius * 0.2],
            "bark",
            bark,
            8,
        )
    ]
    blobs = int(rng.integers(5, 8))
    for k in range(blobs):
        angle = 2 * np.pi * k / blobs + rng.uniform(-0.4, 0.4)
        out = spread * rng.uniform(0.30, 0.48)
        z = rng.uniform(trunk + 0.17 * height, height * 0.78)
        centre = np.array([np.cos(angle) * out + lean[0], np.sin(angle) * out + lean[1], z])
        parts.append(
            tube(
                np.array([(lean[0] * 0.3, lean[1] * 0.3, trunk * 0.95), centre]),
                [radius * 0.45, radius * 0.12],
                "bark",
                bark,
                5,
            )
        )
        radii = np.array([spread * 0.36, spread * 0.36, height * 0.17]) * rng.uniform(0.8, 1.2)
        parts.append(leaf_cloud(centre, radii, detail, leaf, colour, rng))
    crown = np.array([lean[0], lean[1], height * 0.74])
    parts.append(
        leaf_cloud(crown, np.array([spread * 0.42, spread * 0.42, height * 0.26]), detail * 2, leaf, colour, rng)
    )
    return Mesh.join(parts)


def conifer(height: float, spread: float, colour: Colour, detail: int, rng: np.random.Generator) -> Mesh:
    """A fir on z = 0."""
    parts = [tube([(0, 0, -0.1), (0, 0, height * 0.9)], [0.02 * height, 0.005 * height], "bark", (0.11, 0.08, 0.06), 7)]
    for level in np.linspace(0.16, 0.93, 8):
        r = spread * 0.55 * (1.02 - level) + 0.15
        parts.append(
            leaf_cloud(np.array([0, 0, level * height]), np.array([r, r, height * 0.075]), detail, 0.14, colour, rng)
        )
    return Mesh.join(parts)


def bush(length: float, width: float, height: float, colour: Colour, detail: int, rng: np.random.Generator) -> Mesh:
    """A rounded bush on z = 0."""
    radii = np.array([length / 2, width / 2, height * 0.55])
    core = ellipsoid((0, 0, height * 0.42), radii * 0.72, "leaves", tuple(0.45 * c for c in colour), 7)
    return Mesh.join([core, leaf_cloud(np.array([0, 0, height * 0.45]), radii, detail, 0.16, colour, rng)])


def hedge(length: float, height: float, colour: Colour, rng: np.random.Generator) -> Mesh:
    """A trimmed hedge along x, 0.8 m thick."""
    core = box((0, 0, height / 2 - 0.05), (length - 0.1, 0.62, height - 0.1), "leaves", tuple(0.5 * c for c in colour))
    count = int(length * (height + 0.8) * 75)
    p = rng.uniform(-0.5, 0.5, size=(count, 3))
    face = rng.integers(0, 3, count)
    p[face == 0, 1] = 0.5 * np.sign(p[face == 0, 1])
    p[face == 1, 2] = 0.5
    p[face == 2, 1] = 0.5 * np.sign(rng.random((face == 2).sum()) - 0.5)
    at = (p + [0, 0, 0.5]) * [length, 0.8, height] + rng.normal(scale=0.03, size=(count, 3))
    normals = np.where((face == 1)[:, None], [0, 0.3, 1.0], p * [0, 2.0, 0] + [0, 0, 0.3])
    normals = normals + rng.normal(scale=0.35, size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spread = rng.normal(size=(count, 3, 3))
    spread -= spread.mean(axis=1, keepdims=True)
    spread *= 0.065 / np.linalg.norm(spread, axis=2, keepdims=True)
    mesh = make_mesh(
        at[:, None] + spread,
        "leaves",
        colour,
        uv=np.zeros((count, 3, 2)),
        normals=np.repeat(normals[:, None], 3, axis=1),
    )
    shade = rng.uniform(0.6, 1.35, (count, 1))
    return Mesh.join(
        [
            core,
            replace(mesh, colour=(mesh.colour * shade).astype(np.float32), seed=rng.random(count).astype(np.float32)),
        ]
    )


def undergrowth(
    length: float, depth: float, height: float, count: int, leaf: float, colour: Colour, rng: np.random.Generator
) -> Mesh:
    """Loose shrubs and high grass along x in ``count`` clumps ``leaf`` metres large, for the edge of a wood."""
    at = rng.random((count, 3)) * [length, depth, 1] - [length / 2, 0, 0]
    ceiling = height * (0.35 + 0.65 * np.abs(np.sin(at[:, 0] * 0.9 + np.sin(at[:, 1] * 1.7) * 2)))
    at[:, 2] = rng.random(count) ** 0.7 * ceiling
    spread = rng.normal(size=(count, 3, 3))
    spread -= spread.mean(axis=1, keepdims=True)
    spread *= leaf / np.linalg.norm(spread, axis=2, keepdims=True)
    normals = rng.normal(scale=0.4, size=(count, 3)) + [0, -0.5, 0.8]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = make_mesh(
        at[:, None] + spread,
        "leaves",
        colour,
        uv=np.zeros((count, 3, 2)),
        normals=np.repeat(normals[:, None], 3, axis=1),
    )
    shade = (0.3 + 0.8 * at[:, 2:] / height) * rng.uniform(0.7, 1.3, (count, 1))
    return replace(mesh, colour=(mesh.colour * shade).astype(np.float32), seed=rng.random(count).astype(np.float32))


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


def street_lamp(height: float, arm: float) -> Mesh:
    """A lamp post whose arm reaches towards -y."""
    return Mesh.join(
        [
            tube([(0, 0, 0), (0, 0, height * 0.6), (0, 0, height)], [0.09, 0.07, 0.05], "galvanised", _STEEL, 8),
            tube(
                [(0, 0, height - 0.05), (0, -arm * 0.5, height + 0.25), (0, -arm, height + 0.3)],
                [0.045, 0.04, 0.035],
                "galvanised",
                _STEEL,
                6,
            ),
            box((0, -arm - 0.25, height + 0.28), (0.22, 0.6, 0.10), "plastic", (0.4, 0.4, 0.4)),
        ]
    )


def sign_post(kind: int) -> Mesh:
    """A traffic sign looking towards -x: no parking (0), priority (1), warning triangle (2), direction arrow (3)."""
    parts = [tube([(0, 0, 0), (0, 0, 2.6)], [0.03, 0.03], "galvanised", _STEEL, 7)]
    angle = np.arange(20) * 2 * np.pi / 20
    circle = np.stack([np.zeros(20), np.cos(angle), np.sin(angle)], axis=1)

    def disc(radius: float, x: float, colour: Colour, sides: int = 20, turn: float = 0.0) -> Mesh:
        a = np.arange(sides) * 2 * np.pi / sides + turn
        ring = circle[:1] * 0 + np.stack([np.zeros(sides), np.cos(a), np.sin(a)], axis=1) * radius
        return grid(np.stack([ring * 0, ring]) + [x, 0, 2.3], "sign", colour, closed=True)

    if kind == 0:
        parts += [disc(0.30, -0.035, (0.55, 0.02, 0.02)), disc(0.24, -0.038, (0.02, 0.08, 0.42))]
    elif kind == 1:
        parts += [disc(0.36, -0.035, (0.7, 0.7, 0.7), 4), disc(0.27, -0.038, (0.75, 0.48, 0.02), 4)]
    elif kind == 2:
        parts += [
            disc(0.42, -0.035, (0.55, 0.02, 0.02), 3, np.pi / 2),
            disc(0.27, -0.038, (0.72, 0.72, 0.72), 3, np.pi / 2),
        ]
    else:
        parts += [
            disc(0.30, -0.035, (0.02, 0.08, 0.42)),
            panel(
                (-0.04, -0.05, 2.1),
                (-0.04, 0.05, 2.1),
                (-0.04, 0.05, 2.5),
                (-0.04, -0.05, 2.5),
                "sign",
                (0.75, 0.75, 0.75),
            ),
        ]
    parts.append(disc(0.29, -0.028, (0.3, 0.3, 0.3)))
    return Mesh.join(parts)


def traffic_light() -> Mesh:
    """A signal on a post, looking towards -x."""
    parts = [
        tube([(0, 0, 0), (0, 0, 3.4)], [0.06, 0.05], "galvanised", _STEEL, 8),
        box((-0.1, 0, 2.95), (0.2, 0.30, 0.92), "plastic", (0.02, 0.025, 0.02)),
    ]
    for z, colour in ((3.24, (0.9, 0.06, 0.03)), (2.95, (0.10, 0.06, 0.01)), (2.66, (0.01, 0.06, 0.03))):
        parts.append(ellipsoid((-0.2, 0, z), (0.02, 0.1, 0.1), "tail_lamp" if z > 3.2 else "plastic", colour, 6))
    return Mesh.join(parts)


def bench() -> Mesh:
    """A bench 1.8 m long across y whose seat is 0.45 m high and looks towards +x."""
    parts = [
        box((0.1, 0, 0.43), (0.42, 1.8, 0.05), "wood", (0.28, 0.17, 0.09)),
        box((-0.14, 0, 0.70), (0.05, 1.8, 0.32), "wood", (0.28, 0.17, 0.09)),
    ]
    for y in (-0.75, 0.75):
        parts.append(box((0.08, y, 0.21), (0.4, 0.06, 0.42), "galvanised", _DARK))
    return Mesh.join(parts)


def litter_bin() -> Mesh:
    """A round bin."""
    return tube([(0, 0, 0.15), (0, 0, 0.9)], [0.20, 0.22], "plastic", (0.12, 0.20, 0.12), 10)


def bollard() -> Mesh:
    """A post against parking."""
    return Mesh.join(
        [
            tube([(0, 0, 0), (0, 0, 0.85)], [0.055, 0.05], "galvanised", _STEEL, 8),
            tube([(0, 0, 0.62), (0, 0, 0.74)], [0.057, 0.057], "sign", (0.7, 0.7, 0.7), 8),
        ]
    )


def delineator() -> Mesh:
    """A white roadside post with a dark band."""
    return Mesh.join(
        [
            box((0, 0, 0.5), (0.09, 0.12, 1.0), "plain", (0.7, 0.7, 0.7)),
            box((0, 0, 0.82), (0.095, 0.125, 0.2), "sign", (0.05, 0.05, 0.05)),
        ]
    )


def bus_shelter() -> Mesh:
    """A shelter along x, open towards -y."""
    glass = (0.05, 0.06, 0.06)
    parts = [
        box((0, 0.6, 2.4), (4.2, 1.5, 0.10), "plastic", (0.25, 0.26, 0.27)),
        panel((-2, 1.25, 0.3), (2, 1.25, 0.3), (2, 1.25, 2.2), (-2, 1.25, 2.2), "glass", glass),
        box((0, 1.0, 0.45), (2.6, 0.35, 0.05), "wood", (0.25, 0.16, 0.1)),
    ]
    for x in (-2.0, 0.0, 2.0):
        parts.append(box((x, 1.25, 1.2), (0.07, 0.07, 2.4), "galvanised", _STEEL))
    parts.append(panel((2, 0.0, 0.3), (2, 1.2, 0.3), (2, 1.2, 2.0), (2, 0.0, 2.0), "sign", (0.5, 0.42, 0.2)))
    return Mesh.join(parts)


def guard_rail(length: float) -> Mesh:
    """A steel crash barrier along x."""
    wave = np.array([(0.0, 0.45), (-0.06, 0.52), (0.0, 0.60), (-0.06, 0.68), (0.0, 0.75)])
    rows = [np.concatenate([np.full((5, 1), x), wave], axis=1) for x in np.linspace(-length / 2, length / 2, 3)]
    parts = [grid(np.stack(rows), "galvanised", (0.40, 0.41, 0.42))]
    parts += [
        box((x, 0.08, 0.35), (0.1, 0.06, 0.7), "galvanised", _STEEL)
        for x in np.arange(-length / 2 + 1, length / 2, 4.0)
    ]
    return Mesh.join(parts)


def billboard(colour: Colour) -> Mesh:
    """A hoarding that looks towards -x."""
    parts = [
        box((0.05, 0, 2.9), (0.12, 3.8, 2.7), "plastic", (0.2, 0.2, 0.2)),
        panel((-0.02, 1.75, 1.7), (-0.02, -1.75, 1.7), (-0.02, -1.75, 4.1), (-0.02, 1.75, 4.1), "plain", colour),
        panel(
            (-0.025, 1.3, 2.2), (-0.025, -0.2, 2.2), (-0.025, -0.2, 3.6), (-0.025, 1.3, 3.6), "checks", (0.7, 0.66, 0.5)
        ),
    ]
    parts += [tube([(0.1, y, 0), (0.1, y, 2.0)], [0.07, 0.07], "galvanised", _STEEL, 6) for y in (-1.2, 1.2)]
    return Mesh.join(parts)

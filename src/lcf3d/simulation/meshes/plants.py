"""Trees, bushes, hedges and undergrowth."""

# ruff: noqa: RUF005 - the vectors that lists are added to are numpy arrays
from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.meshes.primitives import Mesh, box, ellipsoid, make_mesh, tube

Colour = tuple[float, float, float]


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
    spread = _corners(count, size, rng)
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
    spread = _corners(count, 0.065, rng)
    shade = rng.uniform(0.6, 1.35, (count, 1))
    return Mesh.join([core, _leaves(at[:, None] + spread, normals, colour, shade, rng)])


def undergrowth(
    length: float, depth: float, height: float, count: int, leaf: float, colour: Colour, rng: np.random.Generator
) -> Mesh:
    """Loose shrubs and high grass along x in ``count`` clumps ``leaf`` metres large, for the edge of a wood."""
    at = rng.random((count, 3)) * [length, depth, 1] - [length / 2, 0, 0]
    ceiling = height * (0.35 + 0.65 * np.abs(np.sin(at[:, 0] * 0.9 + np.sin(at[:, 1] * 1.7) * 2)))
    at[:, 2] = rng.random(count) ** 0.7 * ceiling
    spread = _corners(count, leaf, rng)
    normals = rng.normal(scale=0.4, size=(count, 3)) + [0, -0.5, 0.8]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shade = (0.3 + 0.8 * at[:, 2:] / height) * rng.uniform(0.7, 1.3, (count, 1))
    return _leaves(at[:, None] + spread, normals, colour, shade, rng)


def _corners(count: int, size: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """(count, 3, 3) corners of triangles about the origin, each ``size`` away from their middle."""
    spread = rng.normal(size=(count, 3, 3))
    spread -= spread.mean(axis=1, keepdims=True)
    spread *= size / np.linalg.norm(spread, axis=2, keepdims=True)
    return spread


def _leaves(
    triangles: NDArray[np.float64],
    normals: NDArray[np.float64],
    colour: Colour,
    shade: NDArray[np.float64],
    rng: np.random.Generator,
) -> Mesh:
    """A mesh of (N, 3, 3) leaves, each with one of (N, 3) normals and (N, 1) shades of a colour."""
    count = len(triangles)
    mesh = make_mesh(
        triangles, "leaves", colour, uv=np.zeros((count, 3, 2)), normals=np.repeat(normals[:, None], 3, axis=1)
    )
    return replace(mesh, colour=(mesh.colour * shade).astype(np.float32), seed=rng.random(count).astype(np.float32))

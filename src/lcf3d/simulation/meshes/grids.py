"""Triangles and smooth normals of a grid of points, compiled: a street has hundreds of small grids."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.kernels import kernel

Doubles = NDArray[np.float64]


def grid_triangles(points: Doubles, uv: Doubles, closed: bool, crease: float) -> tuple[Doubles, Doubles, Doubles]:
    """Triangles of a grid: of each cell a, b, c and a, c, d.

    Args:
        points: (R, C, 3) positions.
        uv: (R, C, 2) texture coordinates.
        closed: the last column is the first again.
        crease: cosine of the largest angle between a face and the averaged normal that is still smooth.

    Returns:
        Corners (T, 3, 3), their texture coordinates (T, 3, 2) and unit normals (T, 3, 3), averaged over touching
        triangles unless they bend more than the crease; T = 2 (R - 1) (C - 1).
    """
    found: tuple[Doubles, Doubles, Doubles] = _fill(np.ascontiguousarray(points), uv, closed, crease)
    return found


@kernel
def _fill(points: Any, uv: Any, closed: Any, crease: Any) -> Any:
    faces = _faces(points)
    smooth = _averaged(faces, closed)
    _make_unit(smooth.reshape(-1, 3))
    _make_unit(faces.reshape(-1, 3))
    rows, columns = points.shape[0] - 1, points.shape[1] - 1
    count = 2 * rows * columns
    corners, normals, places = np.empty((count, 3, 3)), np.empty((count, 3, 3)), np.empty((count, 3, 2))
    t = 0
    for i in range(rows):
        for j in range(columns):
            for half in range(2):
                face = faces[i, j, half]
                for corner in range(3):
                    y = i + (corner == 2 or (corner == 1 and half == 1))
                    x = j + (corner == 1 or (corner == 2 and half == 0))
                    normal = smooth[y, x]
                    along = normal[0] * face[0] + normal[1] * face[1] + normal[2] * face[2]
                    corners[t, corner] = points[y, x]
                    normals[t, corner] = normal if along > crease else face
                    places[t, corner] = uv[y, x]
                t += 1
    return corners, places, normals


@kernel
def _faces(points: Any) -> Any:
    """(R - 1, C - 1, 2, 3) normals of the two triangles of each cell, as long as the triangles are large."""
    rows, columns = points.shape[0] - 1, points.shape[1] - 1
    faces = np.empty((rows, columns, 2, 3))
    for i in range(rows):
        for j in range(columns):
            a, c = points[i, j], points[i + 1, j + 1]
            _cross(a, points[i, j + 1], c, faces[i, j, 0])
            _cross(a, c, points[i + 1, j], faces[i, j, 1])
    return faces


@kernel(inline="always")
def _cross(a: Any, b: Any, c: Any, out: Any) -> None:
    """Put (b - a) x (c - a) into ``out``."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    out[0], out[1], out[2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@kernel
def _averaged(faces: Any, closed: Any) -> Any:
    """(R, C, 3) sums of the normals around each point, corner by corner, so that sums are the same everywhere."""
    rows, columns = faces.shape[0], faces.shape[1]
    sums = np.zeros((rows + 1, columns + 1, 3))
    for corner in range(4):
        down, right = corner >= 2, corner in (1, 2)
        for i in range(rows):
            for j in range(columns):
                for k in range(3):
                    first, second = faces[i, j, 0, k], faces[i, j, 1, k]
                    value = first + second if corner % 2 == 0 else (first if corner == 1 else second)
                    sums[i + down, j + right, k] += value
    if closed:
        for i in range(rows + 1):
            for k in range(3):
                sums[i, 0, k] += sums[i, columns, k]
                sums[i, columns, k] = sums[i, 0, k]
    return sums


@kernel
def _make_unit(vectors: Any) -> None:
    """Bring (N, 3) vectors to length one; those without length stay."""
    for i in range(len(vectors)):
        x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        vectors[i, 0], vectors[i, 1], vectors[i, 2] = x / length, y / length, z / length

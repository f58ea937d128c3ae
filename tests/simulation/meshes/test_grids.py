"""Triangles and normals of grids of points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.simulation.meshes.grids import grid_triangles


def flat(rows: int, columns: int) -> np.ndarray:
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def test_one_cell_by_hand() -> None:
    points = flat(2, 2)
    corners, places, normals = grid_triangles(points, points[..., :2] / 10, False, 0.75)
    np.testing.assert_array_equal(corners[0], [[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    np.testing.assert_array_equal(corners[1], [[0, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(places, corners[..., :2] / 10)
    np.testing.assert_array_equal(normals, np.broadcast_to([0.0, 0.0, 1.0], (2, 3, 3)))


@pytest.mark.parametrize(("crease", "smooth"), [(0.75, True), (0.95, False)])
def test_a_fold_is_smooth_below_its_crease(crease: float, smooth: bool) -> None:
    # a roof of two slopes of 30 degrees, whose normals m and n are 60 degrees apart; a point of the ridge has two
    # triangles of one and one of the other: (2 m + n) / sqrt(7) is 2.5 / sqrt(7) = 0.945 along m, 0.756 along n
    rise = np.tan(np.deg2rad(30))
    points = np.array([[[0.0, y, 0], [1, y, rise], [2, y, 0]] for y in (0.0, 1.0)])
    corners, _, normals = grid_triangles(points, np.zeros((2, 3, 2)), False, crease)
    ridge = normals[corners[..., 0] == 1]
    # (2 sin 30 - sin 30) / sqrt(7), or the faces' own sin 30
    np.testing.assert_allclose(np.abs(ridge[:, 0]), 0.5 / np.sqrt(7) if smooth else 0.5)


def test_a_closed_grid_is_smooth_over_its_seam() -> None:
    angle = np.linspace(0, 2 * np.pi, 13)
    points = np.stack([[np.cos(angle), np.sin(angle), np.full(13, z)] for z in (0.0, 1.0)]).transpose(0, 2, 1)
    points[:, -1] = points[:, 0]
    _, _, normals = grid_triangles(points, np.zeros((2, 13, 2)), True, 0.5)
    corners, _, _ = grid_triangles(points, np.zeros((2, 13, 2)), False, 0.5)
    # all normals of a cylinder look outwards, those of the seam too; faces are 15 degrees off at most
    outwards = corners[..., :2] / np.linalg.norm(corners[..., :2], axis=-1, keepdims=True)
    assert (np.einsum("tij,tij->ti", normals[..., :2], outwards) > np.cos(np.deg2rad(15))).all()


@given(st.integers(2, 6), st.integers(2, 6), st.booleans(), st.sampled_from([-1.0, 0.5, 0.75]), st.integers(0, 99))
def test_against_plain_numpy(rows: int, columns: int, closed: bool, crease: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(rows, columns, 3))
    if closed:
        points = np.concatenate([points, points[:, :1]], axis=1)
    columns = points.shape[1]
    corners, places, normals = grid_triangles(points, points[..., :2].copy(), closed, crease)
    np.testing.assert_array_equal(places, corners[..., :2])
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    index = np.arange(rows * columns).reshape(rows, columns)
    cells = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    triangles = cells[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    sums = np.zeros((rows * columns, 3))
    np.add.at(sums, triangles.ravel(), np.repeat(face, 3, axis=0))
    if closed:
        sums[index[:, 0]] += sums[index[:, -1]]
        sums[index[:, -1]] = sums[index[:, 0]]
    mean = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    unit = face / np.linalg.norm(face, axis=1, keepdims=True)
    along = np.einsum("tij,tj->ti", mean[triangles], unit)
    clear = np.abs(along - crease) > 1e-6
    expected = np.where((along > crease)[..., None], mean[triangles], unit[:, None])
    np.testing.assert_allclose(normals[clear], expected[clear], atol=1e-7)

"""Lift and splat, by hand and against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.fusion import view_transform as vt  # noqa: E402

# a camera at the origin that looks along y (the network's forward): right is x, down is -z
CAMERA_FROM_RAW = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
INTRINSICS = np.array([[1000, 0, 800], [0, 1000, 450], [0, 0, 1]], np.float64)
RESIZE = np.array([0.48, 32, 176], np.float32)


def rays():
    raw_from_camera = np.linalg.inv(CAMERA_FROM_RAW)
    return vt.ray_points(*(torch.from_numpy(a[None]).float() for a in (INTRINSICS, raw_from_camera, RESIZE)))[0]


def test_points_of_rays_project_to_their_pixels():
    points = rays().double().numpy()
    assert points.shape == (118, 32, 88, 3)
    # depth is along y
    np.testing.assert_allclose(points[:, 5, 7, 1], np.arange(1, 60, 0.5), rtol=1e-5)
    camera = points @ CAMERA_FROM_RAW[:3, :3].T
    pixels = camera[..., :2] / camera[..., 2:] * 1000 + [800, 450]
    cut = pixels * 0.48 - [32, 176]
    np.testing.assert_allclose(cut[3, 0, 0], [0, 0], atol=1e-3)
    np.testing.assert_allclose(cut[50, 31, 87], [703, 255], atol=1e-3)


def test_cells_are_truncated_toward_zero():
    points = torch.tensor(
        [
            [-54.0, -54.0, 0.0],
            [-54.2, -53.6, 0.0],  # less than a cell outside: still the first
            [-54.4, 0.0, 0.0],
            [53.9, 53.9, 0.0],
            [54.1, 0.0, 0.0],
            [0.0, 0.0, 11.0],
        ]
    )
    last = 359 * 360 + 359
    assert vt.bev_cells(points).tolist() == [0, 0 * 360 + 1, -1, last, -1, -1]


def test_pooling_is_a_sum_over_points():
    torch.manual_seed(0)
    depth, features = torch.rand(2, 3, 2, 4), torch.randn(2, 5, 2, 4)
    cells = torch.randint(-1, 6, (2, 3, 2, 4))
    expected = np.zeros((5, 360 * 360))
    for n, d, row, column in np.ndindex(2, 3, 2, 4):
        if (cell := int(cells[n, d, row, column])) >= 0:
            expected[:, cell] += (depth[n, d, row, column] * features[n, :, row, column]).numpy()
    pooled = vt.bev_pool(depth, features, cells)
    assert pooled.shape == (1, 5, 360, 360)
    np.testing.assert_allclose(pooled.reshape(5, -1).numpy(), expected, atol=1e-5)


def test_depth_map_keeps_the_last_point_of_a_pixel():
    matrix = (np.concatenate([INTRINSICS, np.zeros((3, 1))], axis=1) @ CAMERA_FROM_RAW).astype(np.float32)
    # straight ahead: pixel (800, 450), which is column 800 * 0.48 - 32 = 352 and row 450 * 0.48 - 176 = 40
    points = np.array([[0, 10, 0], [0, 20, 0], [0, -5, 0], [100, 10, 0]], np.float32)
    depth = vt.depth_map(points, matrix, RESIZE)
    assert depth.shape == (1, 256, 704)
    assert depth[0, 40, 352] == 20
    assert np.count_nonzero(depth) == 1

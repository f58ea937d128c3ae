"""Sparse convolution against dense convolution, and the point operations against loops."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.lidar.fusing import fuse_batch_norm  # noqa: E402
from lcf3d.detectors.lidar.point_ops import (  # noqa: E402
    ball_query,
    ball_query_in_torch,
    bilinear,
    farthest_in_torch,
    farthest_point_sampling,
    three_nn_interpolation,
)
from lcf3d.detectors.lidar.roi import pool_in_regions, pooled_maximum, pooled_mean, region_grid  # noqa: E402
from lcf3d.detectors.lidar.sparse import (  # noqa: E402
    InverseConv,
    SparseBlock,
    SparseTensor,
    StridedConv,
    SubmanifoldConv,
)
from lcf3d.detectors.lidar.sparse_sites import Sites  # noqa: E402

SHAPE = (7, 9, 8)


@pytest.fixture
def cloud():
    generator = torch.Generator().manual_seed(3)
    cells = torch.nonzero(torch.rand((2, *SHAPE), generator=generator) < 0.2)
    cells = cells[torch.randperm(len(cells), generator=generator)]
    return SparseTensor(torch.randn(len(cells), 5, generator=generator), Sites(cells, SHAPE))


def dense_weight(conv):
    return conv.weight.permute(4, 3, 0, 1, 2)


def at_sites(dense, sites):
    batch, z, y, x = sites.coordinates.unbind(1)
    return dense[batch, :, z, y, x]


@torch.inference_mode()
def test_submanifold_convolution_is_dense_convolution_at_the_sites(cloud):
    conv = SubmanifoldConv(5, 6)
    expected = torch.nn.functional.conv3d(cloud.dense(2), dense_weight(conv), padding=1)
    torch.testing.assert_close(conv(cloud).features, at_sites(expected, cloud.sites), rtol=1e-4, atol=1e-5)


@torch.inference_mode()
@pytest.mark.parametrize(
    ("kernel", "stride", "padding"),
    [((3, 3, 3), (2, 2, 2), (1, 1, 1)), ((3, 3, 3), (2, 2, 2), (0, 1, 1)), ((3, 1, 1), (2, 1, 1), (0, 0, 0))],
)
def test_strided_convolution_is_dense_convolution_where_inputs_reach(cloud, kernel, stride, padding):
    conv = StridedConv(5, 6, kernel, stride, padding)
    result = conv(cloud)
    expected = torch.nn.functional.conv3d(cloud.dense(2), dense_weight(conv), stride=stride, padding=padding)
    torch.testing.assert_close(result.dense(2), expected, rtol=1e-4, atol=1e-5)
    occupied = cloud.with_features(torch.ones(len(cloud.sites), 1)).dense(2)
    reached = torch.nn.functional.conv3d(occupied, torch.ones(1, 1, *kernel), stride=stride, padding=padding) > 0.5
    assert len(result.sites) == int(reached.sum())


@torch.inference_mode()
def test_inverse_convolution_is_the_transpose_of_the_strided_one(cloud):
    strided, inverse = StridedConv(5, 6), InverseConv(6, 5)
    coarse = strided(cloud)
    inverse.weight.copy_(strided.weight.transpose(3, 4))
    back = inverse(coarse, cloud.sites, strided)
    # <strided(x), y> = <x, inverse(y)> for transposed weights
    torch.testing.assert_close((coarse.features**2).sum(), (cloud.features * back.features).sum(), rtol=1e-4, atol=1e-4)


@torch.inference_mode()
def test_folding_the_normalization_changes_nothing(cloud):
    block = SparseBlock(SubmanifoldConv(5, 6)).eval()
    block[1].running_mean.uniform_(-1, 1)
    block[1].running_var.uniform_(0.5, 2)
    expected = block(cloud).features.clone()
    torch.testing.assert_close(fuse_batch_norm(block)(cloud).features, expected, rtol=1e-4, atol=1e-5)
    assert isinstance(block[1], torch.nn.Identity)


def test_no_sites():
    nothing = SparseTensor(torch.zeros(0, 5), Sites(torch.zeros(0, 4, dtype=torch.int64), SHAPE))
    assert SubmanifoldConv(5, 6)(nothing).features.shape == (0, 6)
    assert StridedConv(5, 6)(nothing).features.shape == (0, 6)


def test_farthest_point_sampling_on_a_line():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [10, 0, 0], [4, 0, 0]])
    assert farthest_point_sampling(points, 3).tolist() == [0, 2, 3]
    assert farthest_point_sampling(points[:2], 5).tolist() == [0, 1, 0, 1, 0]


def test_ball_query_takes_the_first_in_order():
    points = torch.tensor([[0.5, 0, 0], [9, 0, 0], [0.2, 0, 0], [0.1, 0, 0]])
    centers = torch.tensor([[0.0, 0, 0], [9, 0, 0], [50, 0, 0]])
    assert ball_query(centers, points, 1.0, 2).tolist() == [[0, 2], [1, 1], [-1, -1]]
    assert ball_query(centers[:1], points, 1.0, 6).tolist() == [[0, 2, 3, 0, 0, 0]]


def test_the_compiled_and_the_vectorised_forms_agree():
    generator = torch.Generator().manual_seed(5)
    points, centers = (torch.randn(n, 3, generator=generator) for n in (700, 90))
    for radius, count in ((0.2, 4), (0.9, 16), (9.0, 800)):
        expected = ball_query_in_torch(centers, points, radius, count)
        assert torch.equal(ball_query(centers, points, radius, count), expected)
    assert torch.equal(farthest_point_sampling(points, 64), farthest_in_torch(points, 64))


def test_three_nearest_neighbours_by_hand():
    sources = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 6, 0], [100, 0, 0]])
    features = torch.tensor([[1.0], [2], [4], [1000]])
    # distances 1, 2 and sqrt(37)
    weights = np.array([1, 1 / 2, 1 / np.sqrt(37)])
    expected = (weights * [1, 2, 4]).sum() / weights.sum()
    assert three_nn_interpolation(torch.tensor([[1.0, 0, 0]]), sources, features).item() == pytest.approx(expected)


def test_bilinear_interpolation_by_hand():
    image = torch.tensor([[[0.0, 1, 2], [10, 11, 12]]])
    result = bilinear(image, torch.tensor([0.25, 1.0]), torch.tensor([0.5, 0.0]))
    assert result[:, 0].tolist() == pytest.approx([5.25, 1.0])


def test_pooling_in_a_turned_region_against_a_loop():
    generator = np.random.default_rng(0)
    regions = np.array([[1.0, 2, -1, 4, 2, 2, 0.7], [0, 0, 0, 3, 3, 3, -2.0]])
    points = generator.uniform(-3, 4, (400, 3))
    features = generator.standard_normal((400, 2))
    point, cell = pool_in_regions(torch.from_numpy(regions), torch.from_numpy(points), 3)
    values = torch.from_numpy(features)[point]
    maximum = pooled_maximum(values, cell, 54).reshape(2, 3, 3, 3, 2).numpy()
    mean = pooled_mean(values, cell, 54).reshape(2, 3, 3, 3, 2).numpy()
    cells: dict[tuple[int, ...], list[int]] = {}
    for (r, (x, y, z, length, width, height, yaw)), (p, position) in itertools.product(
        enumerate(regions), enumerate(points)
    ):
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        u, v = turn @ (position[:2] - [x, y])
        place = (u / length + 0.5, v / width + 0.5, (position[2] - z) / height)
        if all(0 < c < 1 for c in place):
            cells.setdefault((r, *(int(c * 3) for c in place)), []).append(p)
    assert len(cells) > 20
    for index, inside in cells.items():
        np.testing.assert_allclose(maximum[index], features[inside].max(axis=0))
        np.testing.assert_allclose(mean[index], features[inside].mean(axis=0))
    assert np.count_nonzero(mean.any(axis=-1)) == len(cells)


def test_region_grid_by_hand():
    grid = region_grid(torch.tensor([[1.0, 2, 3, 4, 2, 6, np.pi / 2]]), 2)[0]
    # cells of 2 x 1 x 3 m; the length points along +y
    torch.testing.assert_close(grid[0], torch.tensor([1.5, 1.0, 4.5]))
    torch.testing.assert_close(grid[-1], torch.tensor([0.5, 3.0, 7.5]))

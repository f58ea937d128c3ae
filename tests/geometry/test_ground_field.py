"""The ground field on roads whose height is known everywhere."""

import numpy as np
import pytest

from lcf3d.errors import ShapeError
from lcf3d.geometry.ground import ground_field

AREA = (0.0, -40.0, 70.0, 40.0)


def road(height, seed=0, count=40_000):
    rng = np.random.default_rng(seed)
    places = rng.uniform((0, -40), (70, 40), (count, 2))
    return np.column_stack([places, height(places) + rng.normal(0, 0.01, count), np.zeros(count)]).astype(np.float32)


def test_plane_is_found_exactly_enough_between_and_beyond_nodes():
    def height(xy):
        return -1.5 + 0.03 * xy[:, 0] - 0.02 * xy[:, 1]

    field = ground_field(road(height), AREA, -1.73)
    asked = np.random.default_rng(1).uniform((5, -35), (65, 35), (200, 2))
    # the lowest of the noisy returns of a cell lie a little below the road
    assert np.abs(field.heights(asked) - height(asked)).max() < 0.06


def test_hill_is_followed():
    def height(xy):
        return -1.7 + np.maximum(xy[:, 0] - 30, 0) * 0.08

    field = ground_field(road(height), AREA, -1.73)
    asked = np.array([[10.0, 0.0], [50.0, 10.0], [60.0, -20.0]])
    np.testing.assert_allclose(field.heights(asked), height(asked), atol=0.12)


def test_things_on_the_road_are_not_ground():
    def height(xy):
        return np.full(len(xy), -1.73)

    cloud = road(height)
    car = np.random.default_rng(2).uniform((20, -1, -1.6), (24, 1, -0.2), (3000, 3))
    under = (np.abs(cloud[:, 0] - 22) < 2) & (np.abs(cloud[:, 1]) < 1)
    cloud = np.concatenate([cloud[~under], np.column_stack([car, np.zeros(len(car))]).astype(np.float32)])
    assert abs(ground_field(cloud, AREA, -1.73).heights(np.array([[22.0, 0.0]]))[0] + 1.73) < 0.1


def test_without_returns_the_ground_is_where_it_is_expected():
    field = ground_field(np.zeros((0, 4), np.float32), AREA, -1.73)
    np.testing.assert_allclose(field.heights(np.array([[10.0, 3.0], [200.0, -90.0]])), -1.73)
    assert np.isnan(field.heights(np.array([[np.nan, 0.0]])))[0]


def test_two_columns_are_refused():
    with pytest.raises(ShapeError, match="x, y, z"):
        ground_field(np.zeros((5, 2), np.float32), AREA, -1.73)

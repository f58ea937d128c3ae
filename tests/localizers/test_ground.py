import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.geometry.ground import CELL, REACH, fit_plane, lowest_returns, ordered
from lcf3d.localizers.ground import STATIONS, ground_along, station_of
from tests.localizers.scenes import SENSOR_HEIGHT, scan, standing


def plane_at(cloud, x, y, expected=np.nan, radius=10.0):
    plane = np.array([expected, 0, 0])
    fit_plane(lowest_returns(cloud), x, y, radius, plane)
    return plane


def test_lowest_return_of_each_cell():
    cloud = np.array(
        [[1, 1, 5], [1.5, 0.5, -2], [1, 1, np.nan], [np.nan, 1, -9], [2.5, 1, 0], [500, 0, -9]], np.float32
    )
    cloud = np.vstack([cloud, [[1, 1, -np.inf]]]).astype(np.float32)
    grid = lowest_returns(cloud)
    i, j = int((1 + REACH) / CELL), int((1 + REACH) / CELL)
    np.testing.assert_array_equal(grid[i, j], [1.5, 0.5, -2])
    np.testing.assert_array_equal(grid[i + 1, j], [2.5, 1, 0])
    assert np.isfinite(grid[..., 2]).sum() == 2


@settings(deadline=None)
@given(st.lists(st.floats(-5, 5), max_size=30))
def test_ordered_sorts_a_copy(values):
    array = np.array(values)
    np.testing.assert_array_equal(ordered(array), np.sort(array))
    np.testing.assert_array_equal(array, values)


@settings(deadline=None, max_examples=20)
@given(st.floats(-0.1, 0.1), st.floats(8, 25), st.floats(-5, 5))
def test_slopes_are_found(slope, x, y):
    height, along, across = plane_at(scan([], slope=slope), x, y)
    assert height == pytest.approx(-SENSOR_HEIGHT + slope * x, abs=0.1)
    assert along == pytest.approx(slope, abs=0.04)
    assert across == pytest.approx(0, abs=0.03)


def test_cars_walls_and_stray_reflections_do_not_move_the_ground():
    objects = [standing(14, y, 4, 1.7, 1.5, 0.3) for y in (-6, -2, 2, 6)] + [standing(24, 0, 1, 40, 6, 0)]
    cloud = scan(objects)
    cloud = np.vstack([cloud, [[16.0, 1, -9, 0], [13, -3, -6, 0]]]).astype(np.float32)
    assert plane_at(cloud, 15, 0)[0] == pytest.approx(-SENSOR_HEIGHT, abs=0.1)


def test_without_returns_the_expected_height_is_kept():
    np.testing.assert_array_equal(plane_at(np.zeros((0, 4), np.float32), 10, 0, expected=-1.5), [-1.5, 0, 0])
    assert np.isnan(plane_at(np.zeros((0, 4), np.float32), 10, 0)[0])


def test_only_a_roof_hit_does_not_lift_the_ground():
    x, y = np.random.default_rng(0).uniform(-4, 4, (2, 500))
    cloud = np.column_stack([x + 30, y, np.full(500, 4.0)])
    assert plane_at(cloud.astype(np.float32), 30, 0, expected=-1.7)[0] == pytest.approx(-1.7, abs=0.1)


@pytest.mark.parametrize("slope", [0.0, 0.06, 0.12, 0.18])
def test_ground_along_a_ray_follows_a_hill(slope):
    planes = np.empty((STATIONS, 3))
    ground_along(lowest_returns(scan([], slope=slope)), 0.2, -SENSOR_HEIGHT, planes)
    for reach in (6.0, 12.0, 22.0, 45.0):
        a, b, _ = planes[station_of(reach)]
        assert a + b * reach == pytest.approx(-SENSOR_HEIGHT + slope * np.cos(0.2) * reach, abs=0.25)

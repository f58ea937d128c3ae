import numpy as np
import pytest

from lcf3d.geometry.camera import project_boxes
from lcf3d.localizers.cluster import (
    BIN,
    BINS,
    MOST_POINTS,
    image_height_score,
    range_profile,
    take_cluster,
    weigh_points,
)
from lcf3d.localizers.ground import STATIONS
from tests.localizers.scenes import SENSOR_HEIGHT, camera, standing

PROJECTION = np.array(camera().pixels_from_lidar)
IMAGE_SIZE = np.array([1240.0, 375.0])


def box2d_at(distance, height=1.5):
    """2D box of a thin upright object on the axis."""
    return project_boxes(standing(distance, 0, 0.01, 1.6, height, 0)[None], camera())[0][0]


def level_planes(height=-SENSOR_HEIGHT):
    return np.tile([height, 0.0, 0.0], (STATIONS, 1))


@pytest.mark.parametrize("distance", [8.0, 20.0, 60.0])
def test_height_score_is_highest_at_the_true_range(distance):
    reaches = np.arange(4, 90, 0.5)
    scores = [image_height_score(r, -SENSOR_HEIGHT, 1.5, PROJECTION, IMAGE_SIZE, box2d_at(distance)) for r in reaches]
    assert abs(reaches[np.argmax(scores)] - distance) <= 0.5
    assert max(scores) > 0.95
    assert min(scores) >= 0.02


def test_height_score_of_unknown_height_is_level():
    assert image_height_score(10.0, -1.7, np.nan, PROJECTION, IMAGE_SIZE, box2d_at(30)) == 1


@pytest.mark.parametrize("distance", [10.0, 20.0])
def test_the_2d_box_decides_between_clusters(distance):
    # three times as many points at 10 m as at 20 m; an object of 1.5 m fills the 2D box at one of the two ranges
    reaches = np.concatenate([np.full(300, 10.1), np.full(100, 20.1)])
    profile = np.empty(BINS)
    arguments = (reaches, np.ones(400), 1.0, level_planes(), 1.5, PROJECTION, IMAGE_SIZE, box2d_at(distance), profile)
    range_profile(*arguments)
    assert abs(np.argmax(profile) * BIN - distance) < 1


def test_weights_leave_out_ground_sky_and_what_is_not_a_number():
    points = np.array([[10, 0, -1.6], [10, 0, -0.9], [10, 0, 1.5], [np.nan, 0, -1], [10, 0, np.nan], [200, 0, -1.0]])
    reaches, weights = np.empty(6), np.empty(6)
    weigh_points(points, np.full(6, 0.9), level_planes(), 1.5, reaches, weights)
    np.testing.assert_allclose(weights, [0, 0.9**4, 0, 0, 0, 0])
    weigh_points(points, np.full(6, 0.9), level_planes(), np.nan, reaches, weights)
    np.testing.assert_allclose(weights, [0, 0.9**4, 0.9**4, 0, 0, 0])


def test_the_heaviest_connected_group_is_taken():
    # five light points 0.2 m apart, then, 1 m away, three heavy ones
    x = np.array([10, 10.2, 10.4, 10.6, 10.8, 11.8, 12.0, 12.2])
    points = np.column_stack([x, np.zeros(8), np.zeros(8)])
    weights = np.array([0.1] * 5 + [1.0] * 3)
    taken = np.empty((MOST_POINTS, 3))
    used, count = take_cluster(points, x, weights, 0.0, 50.0, 0.5, taken)
    assert (used, count) == (3, 3)
    np.testing.assert_allclose(taken[:3, 0], x[5:])
    assert take_cluster(points, x, weights, 0.0, 50.0, 1.5, taken)[0] == 8
    assert take_cluster(points, x, weights, 10.1, 10.7, 1.5, taken)[0] == 3
    assert take_cluster(points, x, weights, 60.0, 70.0, 1.5, taken) == (0, 0)


def test_many_points_are_thinned_evenly():
    points = np.column_stack([np.linspace(10, 12, 1000), np.zeros(1000), np.zeros(1000)])
    taken = np.empty((MOST_POINTS, 3))
    used, count = take_cluster(points, points[:, 0], np.ones(1000), 0.0, 50.0, 0.5, taken)
    assert MOST_POINTS * 0.8 < used <= MOST_POINTS
    assert count == pytest.approx(1000, rel=0.1)
    assert taken[:used, 0].min() == 10
    assert taken[:used, 0].max() > 11.9

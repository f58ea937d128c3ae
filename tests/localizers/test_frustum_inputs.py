import numpy as np
import pytest

from lcf3d.localizers.frustum_inputs import (
    CONTEXT,
    POINT_CHANNELS,
    border_touched,
    first_points,
    frustum_rays,
    network_inputs,
    reference_of,
    spread_points,
)
from lcf3d.localizers.spec import LocalizerSpec
from tests.localizers.scenes import camera, propose, scan, standing, street_proposals


def test_points_are_spread_evenly_and_repeated_where_there_are_few():
    np.testing.assert_array_equal(spread_points(np.array([8, 3]), 4), [[0, 2, 4, 6], [0, 1, 2, 0]])
    np.testing.assert_array_equal(first_points(np.array([8, 3]), 4), [[0, 1, 2, 3], [0, 1, 2, 0]])


def test_the_reference_is_where_a_person_fills_the_box():
    # slopes 0.05 above and -0.05 below the axis: 1.73 m high at 17.3 m, centred on the axis, 1.73 m wide
    rays = np.array([[0.05, -0.05, 0.05, -0.05]])
    reference, context = reference_of(rays, np.array([1.73]), np.array([100]), np.zeros((1, 4), dtype=bool))
    np.testing.assert_allclose(reference, [[17.3, 0, 0]], atol=1e-9)
    expected = [17.3 / 40, 0, 1.73 / 4, np.log(101) / 6, -0.865 / 2, 0, 0, 0, 0]
    np.testing.assert_allclose(context[0], expected, rtol=1e-6, atol=1e-7)
    assert context.shape == (1, CONTEXT)


@pytest.mark.parametrize("yaw", [0.0, 0.4, -0.9])
def test_rays_do_not_depend_on_where_the_camera_looks(yaw):
    # the same box seen by a camera that is turned by yaw, box and all
    c, s = np.cos(yaw), np.sin(yaw)
    box = standing(20, 1, 3.9, 1.6, 1.5, 0.0)
    turned = np.array([c * box[0] - s * box[1], s * box[0] + c * box[1], *box[2:6], yaw])
    ahead = frustum_rays(propose(scan([box]), [box], [0]))
    aside = frustum_rays(propose(scan([box]), [turned], [0], view=camera(yaw), min_points=0))
    np.testing.assert_allclose(aside, ahead, atol=1e-9)
    # the bottom of the front face lies 1.73 m below the sensor
    assert ahead[0, 1] == pytest.approx(-1.73 / (20 - 3.9 / 2), abs=1e-3)


def test_borders():
    boxes = np.array([[0.0, 50, 90, 100], [30, 1, 99, 60]])
    np.testing.assert_array_equal(border_touched(boxes, np.array([[100, 100]] * 2)), [[1, 0, 0, 1], [0, 1, 1, 0]])


def test_inputs_of_both_forms():
    proposals = street_proposals()
    classes = np.array([2, 0, 1])
    inputs = network_inputs(proposals, classes, LocalizerSpec.of("v1", "kitti"))
    assert inputs.points.shape == (3, POINT_CHANNELS, 256)
    np.testing.assert_array_equal(inputs.context[:, :3], np.eye(3)[classes])
    # what is subtracted comes back: the first point of the car
    first = proposals.points[0]
    np.testing.assert_allclose(inputs.points[0, 1:3, 0] + inputs.reference[0, 1:], first[1:3], atol=1e-5)
    assert (inputs.points[:, 5] == 1).all()
    authors = network_inputs(proposals, classes, LocalizerSpec.of("v2", "kitti"))
    assert authors.points.shape == (3, 5, 128)
    np.testing.assert_array_equal(authors.points[0, :4, 0], first)
    np.testing.assert_array_equal(authors.reference, np.zeros((3, 3)))


def test_intensities_of_nuscenes_are_scaled():
    proposals = street_proposals()
    inputs = network_inputs(proposals, np.array([0, 7, 5]), LocalizerSpec.of("v1", "nuscenes"))
    np.testing.assert_allclose(inputs.points[:, 3].max(), proposals.points[:, 3].max() / 255, rtol=1e-6)

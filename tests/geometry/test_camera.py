import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.geometry.boxes import box_corners
from lcf3d.geometry.camera import NEAR, depths_of, project_boxes, project_points
from lcf3d.structures import Camera


def forward_camera(width=1000, height=500, focal=500.0):
    """A camera at the LiDAR's origin that looks along LiDAR x."""
    camera_from_lidar = np.eye(4)
    camera_from_lidar[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    projection = np.array([[focal, 0, width / 2, 0], [0, focal, height / 2, 0], [0, 0, 1, 0]])
    return Camera("front", projection, camera_from_lidar, width, height)


def test_points_by_hand():
    pixels, depths = project_points(np.array([[10.0, 2, 1], [-10, 0, 0]]), forward_camera())
    np.testing.assert_allclose(pixels[0], [400, 200])
    assert np.isnan(pixels[1]).all()
    np.testing.assert_allclose(depths, [10, -10])
    np.testing.assert_allclose(depths_of(np.array([[10.0, 2, 1]]), forward_camera()), [10])


def test_box_by_hand():
    # front face at 8 m, rear at 12 m: the near face bounds the projection
    boxes, visible = project_boxes(np.array([[10.0, 0, 0, 4, 2, 1, 0]]), forward_camera())
    np.testing.assert_allclose(boxes[0], [500 - 500 / 8, 250 - 250 / 8, 500 + 500 / 8, 250 + 250 / 8])
    assert visible[0]


def test_box_behind_is_not_visible():
    boxes, visible = project_boxes(np.array([[-10.0, 0, 0, 4, 2, 1, 0]]), forward_camera())
    assert not visible[0]
    assert boxes[0].tolist() == [0, 0, 0, 0]


def test_truck_right_in_front_covers_the_image_though_all_corners_are_outside():
    boxes, visible = project_boxes(np.array([[8.0, 0, 0, 14, 12, 8, 0]]), forward_camera())
    assert visible[0]
    assert boxes[0].tolist() == [0, 0, 1000, 500]


def test_box_around_the_camera_covers_the_image():
    boxes, visible = project_boxes(np.array([[0.0, 0, 0, 14, 4, 4, 0.3]]), forward_camera())
    assert visible[0]
    assert boxes[0].tolist() == [0, 0, 1000, 500]


def test_box_beside_the_camera_that_reaches_behind_stays_on_its_side():
    # from 10 m behind to 10 m ahead, 3 m to the left: dividing by negative depths would mirror it to the right
    boxes, visible = project_boxes(np.array([[0.0, 4, 0, 20, 2, 2, 0]]), forward_camera())
    assert visible[0]
    assert boxes[0, 0] == 0
    assert boxes[0, 2] == pytest.approx(500 - 500 * 3 / 10)


@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(0.5, 10), st.floats(-4, 4))
def test_clipped_projection_equals_brute_force_over_the_volume(x, y, side, yaw):
    """Every point of the box in front of the near plane and in the image falls into the projected box."""
    camera, rng = forward_camera(), np.random.default_rng(0)
    box = np.array([[x, y, 0, side, side / 2, 2, yaw]])
    corners = box_corners(box)[0]
    t = rng.uniform(0, 1, (4000, 3))
    origin, axes = corners[0], corners[[1, 3, 4]] - corners[0]
    pixels, depths = project_points(origin + t @ axes, camera)
    inside = (depths > NEAR) & (pixels >= 0).all(axis=1) & (pixels <= [1000, 500]).all(axis=1)
    projected, visible = project_boxes(box, camera)
    if inside.any():
        assert visible[0]
        assert (pixels[inside] >= projected[0, :2] - 1e-6).all()
        assert (pixels[inside] <= projected[0, 2:] + 1e-6).all()


def test_no_boxes():
    boxes, visible = project_boxes(np.zeros((0, 7)), forward_camera())
    assert boxes.shape == (0, 4)
    assert visible.shape == (0,)

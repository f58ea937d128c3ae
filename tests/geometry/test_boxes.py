import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.geometry import boxes as g

angles = st.floats(-20, 20)
ROTATED = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # camera axes in the LiDAR frame, KITTI's ideal mounting


def camera_from_lidar(tilt: float = 0.0) -> np.ndarray:
    """KITTI-like transform, the camera pitched by ``tilt`` and moved."""
    pitch = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    transform = np.eye(4)
    transform[:3, :3] = pitch @ ROTATED
    transform[:3, 3] = [0.06, -0.08, -0.27]
    return transform


def random_boxes(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-50, 50, (n, 3)), rng.uniform(0.3, 12, (n, 3)), rng.uniform(-np.pi, np.pi, n)])


def test_corners_of_a_box_along_x():
    corners = g.box_corners(np.array([[10.0, 2, 1, 4, 2, 1.5, 0]]))[0]
    assert corners[0].tolist() == [12, 3, 0.25]  # front left bottom
    assert corners[2].tolist() == [8, 1, 0.25]  # rear right bottom
    assert corners[5].tolist() == [12, 1, 1.75]  # front right top


def test_corners_turn_counter_clockwise():
    corners = g.box_corners(np.array([[0.0, 0, 0, 4, 2, 1, np.pi / 2]]))[0]
    np.testing.assert_allclose(corners[0], [-1, 2, -0.5], atol=1e-12)


@given(angles)
def test_wrap_angle_keeps_direction_and_range(angle):
    wrapped = g.wrap_angle(np.array([angle]))[0]
    assert -np.pi <= wrapped < np.pi
    assert np.isclose(np.cos(wrapped), np.cos(angle))
    assert np.isclose(np.sin(wrapped), np.sin(angle))


@pytest.mark.parametrize("angle", [-np.pi, np.pi, np.nextafter(-np.pi, -4), 3 * np.pi])
def test_wrap_angle_at_the_seam(angle):
    assert -np.pi <= g.wrap_angle(np.array([angle]))[0] < np.pi


def test_kitti_object_by_hand():
    # 20 m ahead of an ideal camera, 3 m to its right, standing 1.7 m below it, heading right (ry = 0)
    transform = np.eye(4)
    transform[:3, :3] = ROTATED
    box = g.lidar_from_kitti(np.array([[3.0, 1.7, 20]]), np.array([[1.5, 1.6, 4.0]]), np.zeros(1), transform)[0]
    np.testing.assert_allclose(box, [20, -3, -1.7 + 0.75, 4.0, 1.6, 1.5, -np.pi / 2], atol=1e-12)
    # heading away from the camera is along LiDAR x
    away = g.lidar_from_kitti(np.array([[3.0, 1.7, 20]]), np.ones((1, 3)), np.array([-np.pi / 2]), transform)[0]
    assert abs(away[6]) < 1e-12


@given(st.integers(0, 1000), st.floats(-0.1, 0.1))
def test_kitti_round_trip_is_exact(seed, tilt):
    boxes, transform = random_boxes(5, seed), camera_from_lidar(tilt)
    back = g.lidar_from_kitti(*g.kitti_from_lidar(boxes, transform), transform)
    np.testing.assert_allclose(back[:, :6], boxes[:, :6], atol=1e-9)
    np.testing.assert_allclose(g.wrap_angle(back[:, 6] - boxes[:, 6]), 0, atol=1e-9)


def test_kitti_yaw_uses_the_real_rotation():
    # a camera yawed by 0.1 rad: the plain rule -ry - pi/2 would be off by that much
    yawed = camera_from_lidar()
    turn = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
    yawed[:3, :3] = turn @ yawed[:3, :3]
    box = g.lidar_from_kitti(np.array([[0.0, 1.7, 20]]), np.ones((1, 3)), np.array([0.3]), yawed)[0]
    assert abs(g.wrap_angle(np.array([box[6] - (-0.3 - np.pi / 2)]))[0]) == pytest.approx(0.1, abs=1e-9)


@pytest.mark.parametrize(
    ("to", "back"),
    [
        (g.mmdet3d_from_canonical, g.canonical_from_mmdet3d),
        (g.legacy_mmdet3d_from_canonical, g.canonical_from_legacy_mmdet3d),
        (lambda b: b, g.canonical_from_openpcdet),
    ],
)
def test_convention_round_trips(to, back):
    boxes = random_boxes(50)
    np.testing.assert_allclose(back(to(boxes)), boxes, atol=1e-12)


def test_mmdet3d_boxes_stand_on_their_bottom():
    box = g.canonical_from_mmdet3d(np.array([[1.0, 2, -1.6, 4, 1.8, 1.6, 0.2]]))[0]
    np.testing.assert_allclose(box, [1, 2, -0.8, 4, 1.8, 1.6, 0.2])


def test_legacy_mmdet3d_swaps_sides_and_turns_clockwise():
    # before v1.0 yaw 0 looked along -y and sizes came as width, length, height
    box = g.canonical_from_legacy_mmdet3d(np.array([[0.0, 0, -1, 1.6, 4, 2, 0]]))[0]
    np.testing.assert_allclose(box, [0, 0, 0, 4, 1.6, 2, -np.pi / 2])


@given(st.integers(0, 100), angles, st.floats(-50, 50))
def test_transform_moves_corners_rigidly(seed, yaw, shift):
    boxes = random_boxes(3, seed)
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    transform[:3, 3] = [shift, -shift, 1]
    moved = g.box_corners(g.transform_boxes(boxes, transform))
    expected = g.box_corners(boxes) @ transform[:3, :3].T + transform[:3, 3]
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_points_in_boxes_counts_the_border_as_inside():
    box = np.array([[0.0, 0, 0, 4, 2, 2, np.pi / 2]])
    points = np.array([[0.0, 2, 0], [0, 2.01, 0], [1, 0, 1], [1.01, 0, 0], [0, 0, -1.01], [np.nan, 0, 0]])
    assert g.points_in_boxes(points, box)[0].tolist() == [True, False, True, False, False, False]


def test_observation_angle_is_seen_along_the_ray():
    # an object to the right at 45 degrees, heading to camera x
    alpha = g.observation_angle(np.array([[10.0, 1, 10]]), np.zeros(1))
    np.testing.assert_allclose(alpha, -np.pi / 4)

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lcf3d.geometry.rotation import (
    interpolated,
    invert_rigid,
    quaternions_from_matrices,
    quaternions_from_yaws,
    rigid_transforms,
    rotation_matrices,
    transform_points,
    yaws_from_quaternions,
)

component = st.floats(-1, 1)
quaternions = (
    st.tuples(component, component, component, component)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q[None])
)


def test_quarter_turn_by_hand() -> None:
    matrix = rotation_matrices(np.array([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]]))[0]
    np.testing.assert_allclose(matrix, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


@given(quaternions)
def test_matrices_agree_with_scipy_whatever_the_length(q: np.ndarray) -> None:
    expected = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rotation_matrices(q), expected, atol=1e-12)


@given(quaternions)
def test_matrix_to_quaternion_and_back(q: np.ndarray) -> None:
    matrices = rotation_matrices(q)
    found = quaternions_from_matrices(matrices)
    assert found[0, 0] >= 0
    np.testing.assert_allclose(rotation_matrices(found), matrices, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_no_real_part(axis: int) -> None:
    q = np.zeros((1, 4))
    q[0, 1 + axis] = 1
    np.testing.assert_allclose(np.abs(quaternions_from_matrices(rotation_matrices(q))), q, atol=1e-15)


@given(st.floats(-3.14, 3.14))
def test_yaw_to_quaternion_and_back(yaw: float) -> None:
    np.testing.assert_allclose(yaws_from_quaternions(quaternions_from_yaws(np.array([yaw]))), [yaw], atol=1e-12)


@given(quaternions)
def test_yaw_is_the_direction_of_the_rotated_x_axis(q: np.ndarray) -> None:
    x_axis = rotation_matrices(q)[0, :, 0]
    if np.hypot(x_axis[0], x_axis[1]) > 1e-6:
        expected = np.arctan2(x_axis[1], x_axis[0])
        difference = yaws_from_quaternions(q)[0] - expected
        assert abs(np.angle(np.exp(1j * difference))) < 1e-8


@given(quaternions, st.tuples(*[st.floats(-1000, 1000)] * 3))
def test_rigid_transform_and_its_inverse_cancel(q: np.ndarray, translation: tuple[float, ...]) -> None:
    transform = rigid_transforms(q, np.array([translation]))
    np.testing.assert_allclose((invert_rigid(transform) @ transform)[0], np.eye(4), atol=1e-9)
    point = np.array([[1.0, -2.0, 3.0]])
    moved = transform_points(point, transform[0])
    np.testing.assert_allclose(moved, rotation_matrices(q)[0] @ point[0] + translation + np.zeros((1, 3)), atol=1e-9)
    np.testing.assert_allclose(transform_points(moved, invert_rigid(transform)), point, atol=1e-9)


@settings(deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6), st.floats(-0.5, 2))
def test_between_two_poses_the_turn_goes_on_evenly(numbers, share):
    start, turn = Rotation.from_rotvec(numbers[:3]), Rotation.from_rotvec(numbers[3:])
    first, second = np.eye(4), np.eye(4)
    first[:3, :3], second[:3, :3] = start.as_matrix(), (start * turn).as_matrix()
    second[:3, 3] = [1.0, -2.0, 4.0]
    pose = interpolated(first, second, share)
    expected = start * Rotation.from_rotvec(share * np.array(numbers[3:]))
    np.testing.assert_allclose(pose[:3, :3], expected.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(pose[:3, 3], share * second[:3, 3], atol=1e-12)

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lcf3d import Camera, Lcf3dError
from lcf3d.geometry.camera import project_points
from lcf3d.geometry.epipolar import (
    baseline,
    camera_centre,
    epipolar_lines,
    epipole,
    fundamental_matrix,
    inverse_depths,
    line_distances,
)

LOOK_AHEAD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def camera(name="left", position=(0.0, 0, 0), turn=None, focal=500.0, centre=(500.0, 200), column=(0.0, 0, 0)):
    """A camera at a LiDAR-frame position, looking along x but for ``turn``; ``column`` is P's last one."""
    rotation = LOOK_AHEAD if turn is None else turn @ LOOK_AHEAD
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, -rotation @ np.array(position, dtype=float)
    projection = np.array([[focal, 0, centre[0], 0], [0, focal, centre[1], 0], [0, 0, 1, 0]])
    projection[:, 3] = column
    return Camera(name, projection, transform, 1000, 400)


@st.composite
def rigs(draw):
    """Two cameras of different focal length, place and direction, one with a translation column."""
    rng = np.random.default_rng(draw(st.integers(0, 100_000)))
    cameras = [
        camera(
            name,
            position=rng.uniform(-1, 1, 3),
            turn=Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix(),
            focal=rng.uniform(300, 900),
            centre=rng.uniform([400, 150], [600, 250]),
            column=rng.uniform(-1, 1, 3) * [200, 5, 0.01],
        )
        for name in ("left", "right")
    ]
    assume(np.linalg.norm(camera_centre(cameras[1]) - camera_centre(cameras[0])) > 0.05)
    return cameras


points_ahead = st.tuples(st.floats(5, 60), st.floats(-8, 8), st.floats(-3, 3))


@given(rigs(), points_ahead)
def test_images_of_one_point_meet_their_epipolar_lines(rig, point):
    left, right = rig
    pixels = [project_points(np.array([point]), view)[0] for view in rig]
    fundamental = fundamental_matrix(left, right)
    assert line_distances(epipolar_lines(fundamental, pixels[0]), pixels[1])[0, 0] < 1e-5
    assert np.linalg.norm(fundamental) == pytest.approx(1)
    assert abs(np.linalg.det(fundamental)) < 1e-9
    # the other way round it is the transpose
    assert line_distances(epipolar_lines(fundamental.T, pixels[1]), pixels[0])[0, 0] < 1e-5


@given(rigs(), points_ahead)
def test_depth_follows_from_the_place_on_the_line(rig, point):
    left, right = rig
    (left_pixel, depth), (right_pixel, _) = (project_points(np.array([point]), view) for view in rig)
    # where left sees the point near its epipole there is hardly any parallax
    assume(np.linalg.norm(left_pixel[0] - epipole(right, left)[:2] / epipole(right, left)[2]) > 50)
    inverse = inverse_depths(left, right, left_pixel, right_pixel)
    assert inverse[0, 0] == pytest.approx(1 / depth[0], rel=1e-6, abs=1e-8)


@given(rigs())
def test_all_lines_pass_through_the_epipole(rig):
    left, right = rig
    at = epipole(left, right)
    assume(abs(at[2]) > 1e-3)
    lines = epipolar_lines(fundamental_matrix(left, right), np.array([[10.0, 20], [900, 30], [300, 390]]))
    distance = line_distances(lines, (at[:2] / at[2])[None])
    assert (distance < 1e-6 * max(1, np.abs(at[:2] / at[2]).max())).all()


@given(rigs())
def test_formula_with_rotation_and_translation(rig):
    # docs/method.md, stereo: F = K_r^-T [t]x R K_l^-1, for projections without a translation column
    left, right = (replace(v, projection=np.column_stack([v.intrinsics, np.zeros(3)])) for v in rig)
    right_from_left = right.camera_from_lidar @ np.linalg.inv(left.camera_from_lidar)
    x, y, z = right_from_left[:3, 3]
    assume(np.linalg.norm([x, y, z]) > 0.05)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    expected = np.linalg.inv(right.intrinsics).T @ cross @ right_from_left[:3, :3] @ np.linalg.inv(left.intrinsics)
    expected /= np.linalg.norm(expected)
    found = fundamental_matrix(left, right)
    np.testing.assert_allclose(found * np.sign((found * expected).sum()), expected, atol=1e-9)


def test_rectified_pair_by_hand():
    # 0.5 m to the right: lines are the rows, and 25 px of disparity at focal length 500 are 10 m
    left, right = camera("left"), camera("right", position=(0, -0.5, 0))
    fundamental = fundamental_matrix(left, right)
    np.testing.assert_allclose(np.abs(fundamental), np.sqrt([[0, 0, 0], [0, 0, 0.5], [0, 0.5, 0]]), atol=1e-9)
    lines = epipolar_lines(fundamental, np.array([[600.0, 120]]))
    # 3 rows below the line, and any column
    np.testing.assert_allclose(line_distances(lines, np.array([[0.0, 123], [575, 120]])), [[3, 0]], atol=1e-9)
    shifted = np.array([[575.0, 120], [600, 120], [625, 120]])
    np.testing.assert_allclose(
        inverse_depths(left, right, np.array([[600.0, 120]]), shifted), [[0.1, 0, -0.1]], atol=1e-9
    )
    np.testing.assert_allclose(baseline(left, right), [0.5, 0, 0], atol=1e-12)


def test_distance_to_a_slanted_line_by_hand():
    # 3 u + 4 v = 0: the point (5, 0) is 3 away
    line = np.array([[0.6, 0.8, 0.0]])
    np.testing.assert_allclose(line_distances(line, np.array([[5.0, 0], [-4, 3], [0, 10]])), [[3, 0, 8]], atol=1e-12)


def test_translation_column_of_kitti():
    # P2 and P3 of a KITTI calibration: the baseline is (44.85728 + 339.5242) / 721.5377 m, small offsets aside
    matrix = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
    other = matrix.copy()
    other[:, 3] = -339.5242, 2.199936, 0.002729905
    transform = np.eye(4)
    transform[:3, :3] = LOOK_AHEAD
    left, right = Camera("left", matrix, transform, 1242, 375), Camera("right", other, transform, 1242, 375)
    offset = baseline(left, right)
    assert offset[0] == pytest.approx((44.85728 + 339.5242) / 721.5377, abs=1e-4)
    assert abs(offset[1]) < 0.003
    pixels = [project_points(np.array([[20.0, 2, -1]]), view)[0] for view in (left, right)]
    assert line_distances(epipolar_lines(fundamental_matrix(left, right), pixels[0]), pixels[1])[0, 0] < 1e-9


def test_the_epipole_has_no_line():
    # one camera straight ahead of the other: the epipole is the principal point
    left, right = camera("left"), camera("right", position=(1.0, 0, 0))
    lines = epipolar_lines(fundamental_matrix(left, right), np.array([[500.0, 200], [510, 200]]))
    assert np.isnan(lines[0]).all()
    np.testing.assert_allclose(np.abs(lines[1]), [0, 1, 200], atol=1e-6)


def test_directions_that_the_other_camera_cannot_look_in():
    left = camera("left")
    right = camera("right", position=(0, -0.5, 0), turn=Rotation.from_rotvec([0, np.pi, 0]).as_matrix())
    assert np.isnan(inverse_depths(left, right, np.array([[500.0, 200]]), np.array([[500.0, 200]]))).all()


def test_cameras_at_one_place_are_no_pair():
    with pytest.raises(Lcf3dError, match=r"'left' and 'right' must stand apart.*0\.0000 m"):
        fundamental_matrix(camera("left"), camera("right", turn=Rotation.from_rotvec([0, 0.1, 0]).as_matrix()))


def test_camera_without_a_centre():
    flat = camera("flat")
    projection = np.array(flat.projection)
    projection[2] = projection[1]
    with pytest.raises(Lcf3dError, match="camera 'flat' needs a projection whose left 3 x 3 part is invertible"):
        camera_centre(replace(flat, projection=projection))

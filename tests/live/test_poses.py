import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcf3d.live.poses import PoseBuffer, relative_velocities
from lcf3d.structures import Detections3D


def pose(x, yaw):
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    transform[0, 3] = x
    return transform


def test_between_two_poses_half_of_the_way_and_of_the_turn():
    buffer = PoseBuffer()
    buffer.add(1.1, pose(2.0, 0.02))
    buffer.add(1.0, pose(0.0, 0.0))  # the order does not matter
    assert np.allclose(buffer.at(1.05), pose(1.0, 0.01), atol=1e-6)
    assert np.allclose(buffer.at(1.1), pose(2.0, 0.02))


def test_the_last_motion_is_carried_on_for_a_moment_only():
    buffer = PoseBuffer()
    for time in (0.0, 0.1):
        buffer.add(time, pose(20 * time, 0.0))
    assert buffer.at(0.2)[0, 3] == pytest.approx(4.0)
    assert buffer.at(0.6) is None
    assert buffer.at(-0.01) is None
    assert PoseBuffer().at(0.0) is None


def test_a_point_that_stands_comes_nearer_as_the_car_drives():
    buffer = PoseBuffer()
    buffer.add(0.0, pose(0.0, 0.0))
    buffer.add(0.1, pose(1.0, 0.0))
    assert np.allclose(buffer.motion(0.0, 0.1) @ [10, 0, 0, 1], [9, 0, 0, 1])


def test_old_poses_are_forgotten():
    buffer = PoseBuffer()
    for i in range(200):
        buffer.add(0.1 * i, np.eye(4))
    assert len(buffer) <= 52
    assert buffer.newest == pytest.approx(19.9)


def test_velocities_as_seen_from_the_moving_car():
    boxes = np.array([[10.0, 0, 0, 4, 2, 1.5, 0], [20.0, 0, 0, 4, 2, 1.5, 0], [30.0, 0, 0, 4, 2, 1.5, 0]])
    lidar = Detections3D(boxes, np.ones(3), np.zeros(3, int), ("Car",), [[15.0, 0], [0.5, 0], [np.nan, np.nan]])
    # one metre ahead in 0.1 s: what stands comes nearer with 10 m/s; half a metre a second counts as standing
    assert np.allclose(relative_velocities(lidar, pose(-1.0, 0.0), 0.1)[:, 0], [5.0, -10.0, -10.0])


def test_a_motion_is_carried_on_from_poses_that_tell_it():
    buffer, noise = PoseBuffer(), np.random.default_rng(0)
    # poses 200 times a second, off by a millimetre: two neighbours would be off by 0.4 m/s
    for i in range(41):
        buffer.add(0.005 * i, pose(10 * 0.005 * i + noise.normal(0, 0.001), 0.0))
    assert buffer.at(0.4)[0, 3] == pytest.approx(4.0, abs=0.01)

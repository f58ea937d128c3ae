"""Parked cars stay where they are, and poses whose steps are too long are found out by them."""

import numpy as np
import pytest

from lcf3d.fusion.memory import remember
from lcf3d.fusion.memory_config import MemoryConfig

from .scenes import car
from .test_memory import frame, fused, moved, play

PARKED = np.array([[10.0, 4.0], [18.0, -4.0], [25.0, 4.0], [33.0, -4.0], [40.0, 4.0], [48.0, -4.0]])


def jittered(x, y, rng):
    box = np.array(car(x, y))
    box[:2] += rng.normal(0, 0.1, 2)
    return box


@pytest.mark.parametrize("seed", range(5))
def test_a_parked_car_that_nothing_sees_for_a_second_and_a_half_is_where_it_was(seed):
    rng = np.random.default_rng(seed)
    frames = [(frame(0.1 * t), fused([jittered(20, 3, rng)], [0.97]) if t < 20 else fused([], [])) for t in range(36)]
    last = play(frames, MemoryConfig(min_log_odds=-20))[-1]
    assert last.tracks.predicted.tolist() == [True]
    assert np.abs(last.detections.boxes[0, :2] - car(20, 3)[:2]).max() < 0.1
    # it is known to stand, though each measured place is ten centimetres beside the last
    assert np.abs(last.detections.velocities[0]).max() < 0.05


def test_a_car_that_starts_is_followed():
    rng = np.random.default_rng(0)
    x = [20.0] * 15 + [20 + 0.5 * 3 * (0.1 * t) ** 2 for t in range(1, 16)]
    frames = [(frame(0.1 * t), fused([jittered(at, 0, rng)], [0.9])) for t, at in enumerate(x)]
    # unseen for the next frame, in which it goes on by 0.45 m
    results = play([*frames, (frame(3.0), fused([], []))])
    assert [len(result) for result in results] == [1] * 31
    assert len({int(result.tracks.ids[0]) for result in results}) == 1
    assert results[-1].detections.boxes[0, 0] == pytest.approx(x[-1] + 0.45, abs=0.3)
    # measured places are taken with care, so that the speed lags behind by a few tenths of a second
    assert 3.0 < results[-1].detections.velocities[0, 0] < 5.0


def drive(too_long, traffic, hidden_from=99, n=30, speed=10.0):
    """A sensor at 10 m/s past parked cars, or in traffic that moves as it does; each pose's step is ``too_long``."""
    rng = np.random.default_rng(1)
    for t in range(n):
        way = speed * 0.1 * t
        places = PARKED + np.array([20.0 if traffic else 20.0 - way, 0.0])
        boxes = [jittered(*place, rng) for place in places]
        if t >= hidden_from:
            boxes = boxes[:1] + boxes[2:]
        yield frame(0.1 * t, moved(too_long * way)), fused(boxes, [0.95] * len(boxes))


def memory_after(frames):
    memory, results = None, []
    for one, found in frames:
        memory, result = remember(memory, found, one, MemoryConfig())
        results.append(result)
    return memory, results


@pytest.mark.parametrize("too_long", [1.0, 1.03, 0.97])
def test_the_scale_of_the_poses_is_learned_from_what_stands(too_long):
    memory, _ = memory_after(drive(too_long, traffic=False))
    assert memory.odometry.scale == pytest.approx(1 / too_long, abs=0.006)
    assert memory.odometry.variance < 0.01**2


def test_with_poses_too_long_a_hidden_parked_car_does_not_creep():
    _, results = memory_after(drive(1.03, traffic=False, hidden_from=20))
    (row,) = np.flatnonzero(results[-1].tracks.predicted)
    truth = PARKED[1] + np.array([20.0 - 29.0, 0.0])
    # without the scale: 0.3 m for each of the ten hidden frames' second
    assert np.abs(results[-1].detections.boxes[row, :2] - truth).max() < 0.2


def test_traffic_that_moves_along_and_a_sensor_that_stands_teach_nothing():
    memory, _ = memory_after(drive(1.03, traffic=True))
    assert memory.odometry.scale == 1.0
    memory, _ = memory_after(drive(1.03, traffic=False, speed=0.5))
    assert memory.odometry.scale == 1.0


@pytest.mark.parametrize(("speed", "remembered"), [(0.0, True), (10.0, False)])
def test_what_stands_is_remembered_for_longer_than_what_moves(speed, remembered):
    rng = np.random.default_rng(0)
    seen = [(frame(0.1 * t), fused([jittered(10 + speed * 0.1 * t, 3, rng)], [0.97])) for t in range(20)]
    # unseen for 1.7 s, of 1.55 s for what moves and 2.05 s for what stands
    memory, _ = memory_after([*seen, *((frame(0.1 * t), fused([], [])) for t in range(20, 37))])
    assert (len(memory.tracks) == 1) == remembered


def test_poses_that_are_missing_for_a_while_are_told_and_come_again_without_a_jump():
    frames = list(drive(1.0, traffic=False))
    # the second odometry begins at a place of its own, two metres ahead
    other = [one for one, _ in frames]
    other[15:] = [frame(0.1 * t, None if t < 20 else moved(1.0 * t + 2.0)) for t in range(15, 30)]
    _, results = memory_after(zip(other, (found for _, found in frames), strict=True))
    estimated = [any("no pose" in note for note in result.notes) for result in results]
    assert estimated == [15 <= t <= 20 for t in range(30)]
    assert not any("began anew" in note for result in results for note in result.notes)
    assert {tuple(sorted(result.tracks.ids)) for result in results} == {(0, 1, 2, 3, 4, 5)}
    speeds = np.linalg.norm(results[-1].detections.velocities, axis=1)
    assert speeds.max() < 0.5

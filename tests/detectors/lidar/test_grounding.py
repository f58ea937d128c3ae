"""Levelling scans and grounding boxes, on a ramp."""

from dataclasses import replace

import numpy as np
import pytest

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.grounding import LEVEL_M, ground_of, grounded, level_points, levelled
from lcf3d.detectors.lidar.presets import COMPACT_KITTI, PRESETS
from lcf3d.errors import ConfigError
from lcf3d.structures import Detections3D


def ramp():
    rng = np.random.default_rng(0)
    places = rng.uniform((0, -39), (69, 39), (50_000, 2))
    return np.column_stack([places, -1.2 + 0.04 * places[:, 0], np.full(50_000, 0.5)]).astype(np.float32)


def box_at(x, bottom):
    return np.array([[x, 0.0, bottom + 0.75, 4.0, 1.8, 1.5, 0.0]])


def test_levelled_ramp_is_flat():
    points = ramp()
    ground = ground_of(points, COMPACT_KITTI)
    level = levelled(points, ground, COMPACT_KITTI)
    assert np.abs(level[:, 2] - LEVEL_M).max() < 0.2
    np.testing.assert_array_equal(level[:, [0, 1, 3]], points[:, [0, 1, 3]])


def test_boxes_come_back_from_the_levelled_scan():
    points = ramp()
    ground = ground_of(points, COMPACT_KITTI)
    found = Detections3D(box_at(40.0, LEVEL_M), np.ones(1), np.zeros(1, np.int64), ("Car",))
    carried = grounded(found, ground, COMPACT_KITTI)
    assert carried.boxes[0, 2] - 0.75 == pytest.approx(-1.2 + 0.04 * 40, abs=0.1)


def test_resting_boxes_forget_their_own_height():
    points = ramp()
    config = replace(COMPACT_KITTI, ground="rest")
    ground = ground_of(points, config)
    assert levelled(points, ground, config) is points
    found = Detections3D(box_at(40.0, 7.0), np.ones(1), np.zeros(1, np.int64), ("Car",))
    assert grounded(found, ground, config).boxes[0, 2] - 0.75 == pytest.approx(0.4, abs=0.1)


def test_other_networks_see_the_scan_as_it_is():
    config = PRESETS["pointpillars-kitti"]
    points = ramp()
    assert ground_of(points, config) is None
    assert levelled(points, None, config) is points


def test_a_scan_without_returns_has_a_ground_all_the_same():
    ground = ground_of(np.zeros((0, 4), np.float32), COMPACT_KITTI)
    assert level_points(np.zeros((0, 4), np.float32), ground).shape == (0, 4)


def test_unknown_mode_is_refused():
    with pytest.raises(ConfigError, match="ground takes"):
        LidarConfig.from_dict({**COMPACT_KITTI.to_dict(), "ground": "flat"})

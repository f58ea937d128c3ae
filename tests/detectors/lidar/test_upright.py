"""Persons and what only looks like one from above: ends of things beside ends of boxes."""

from dataclasses import replace

import numpy as np
import pytest

from lcf3d.detectors.lidar.presets import COMPACT_KITTI, PRESETS
from lcf3d.detectors.lidar.upright import MOST, checked, doubts, heights_in
from lcf3d.structures import KITTI_CLASSES, Detections3D

SENSOR_M = 1.73
BEAM_RAD = np.radians(0.4)
PERSON = np.array([[20.0, 0.0, -SENSOR_M + 0.9, 0.8, 0.6, 1.8, 0.3]])


def column(height, x=20.0, lowest=0.0):
    """Returns of beams 0.4 degrees apart on a thin upright thing of a height, standing on the ground."""
    angles = np.arange(-0.3, 0.3, BEAM_RAD)
    z = x * np.tan(angles)
    z = z[(z > lowest - SENSOR_M) & (z < height - SENSOR_M)]
    side = np.linspace(-0.1, 0.1, 5)
    return np.array([[x, y, up, 0.3] for up in z for y in side], dtype=np.float32)


def test_heights_of_a_person():
    points = column(1.8)
    gap, spacing, body, above = heights_in(points, PERSON)[0]
    assert 0 <= gap < 20 * BEAM_RAD
    assert spacing == pytest.approx(20 * BEAM_RAD, rel=0.1)
    assert body == (points[:, 2] > -SENSOR_M + 0.2).sum()
    assert above == 0


def test_nothing_speaks_against_a_person():
    np.testing.assert_array_equal(doubts(column(1.8), PERSON), 0)


def test_a_box_that_rises_above_what_stands_there_is_doubted():
    # beams 0.14 m apart: a bush of 1.2 m is 0.6 m short, four beams and more
    assert doubts(column(1.2), PERSON)[0] == pytest.approx(MOST)


def test_a_pole_that_goes_on_is_doubted():
    assert doubts(column(3.5), PERSON)[0] == pytest.approx(MOST)


def test_too_few_beams_tell_nothing():
    beam = column(1.8, lowest=1.0)[:5]
    assert heights_in(beam, PERSON)[0, 1] == np.inf
    np.testing.assert_array_equal(doubts(beam, PERSON), 0)


def test_an_empty_box_and_bad_points_tell_nothing():
    bad = np.array([[np.nan, 0, 0, 0], [20, 0, np.inf, 0], [np.inf, 0, 0, 0]], dtype=np.float32)
    far = PERSON + np.array([500.0, 0, 0, 0, 0, 0, 0])
    for points in (bad, np.zeros((0, 4), np.float32)):
        np.testing.assert_array_equal(doubts(points, np.concatenate([PERSON, far])), 0)
    np.testing.assert_array_equal(heights_in(bad, np.zeros((0, 7))), np.zeros((0, 4)))


def test_what_stands_beside_a_box_does_not_matter():
    beside = column(3.5) + np.array([0, 1.5, 0, 0], np.float32)
    np.testing.assert_array_equal(doubts(np.concatenate([column(1.8), beside]), PERSON), 0)


def test_only_named_classes_are_looked_at_and_thresholds_hold():
    boxes = np.repeat(PERSON, 3, axis=0)
    found = Detections3D(boxes, np.array([0.5, 0.5, 0.15]), np.array([0, 1, 2]), KITTI_CLASSES)
    after = checked(found, column(1.2), COMPACT_KITTI, 0.1)
    # logit 0 less 2 is 0.12; 0.15 falls to 0.023
    np.testing.assert_allclose(after.scores, [0.5, 1 / (1 + np.exp(MOST))])
    np.testing.assert_array_equal(after.labels, [0, 1])
    assert checked(found, column(1.2), PRESETS["pointpillars-kitti"], 0.1) is found
    assert checked(found, column(1.2), replace(COMPACT_KITTI, upright=("Tram",)), 0.1) is found


def test_scores_of_one_stay_numbers():
    found = Detections3D(PERSON, np.ones(1), np.array([1]), KITTI_CLASSES)
    assert 0.9 < checked(found, column(1.2), COMPACT_KITTI, 0.1).scores[0] <= 1

"""How much measured sizes and heights count, and where what is seen is taken to be."""

import numpy as np
import pytest

from lcf3d.fusion.memory_shape import bottom_share, boxes_now, size_weight
from lcf3d.fusion.memory_state import BOTTOM, POSITION_X, SIZE, STANDING, STANDING_X, Tracks


def test_near_and_sure_sizes_count_more():
    weights = size_weight(np.array([0.0, 2.0, 0.0]), np.array([10.0, 10.0, 20.0]))
    assert weights / weights[0] == pytest.approx([1, np.e, 1 / np.e])


def test_the_past_counts_more_for_far_bottoms_and_less_after_a_while():
    shares = bottom_share(np.array([0.1, 0.1, 0.1, 0.2]), np.array([0.0, 30.0, 90.0, 0.0]))
    assert shares == pytest.approx([0.5, 0.6, 0.7, 0.25])


def test_boxes_are_where_objects_are_seen_or_expected():
    tracks = Tracks(np.zeros((4, 4), dtype=np.int64), np.zeros((4, 25)))
    tracks.values[:, POSITION_X], tracks.values[:, STANDING_X] = 1.0, 2.0
    tracks.values[:, STANDING] = 1.0, 0.0, 1.0, 0.0
    tracks.values[:, SIZE : SIZE + 3], tracks.values[:, BOTTOM] = [4.0, 2.0, 1.5], -1.0
    seen = np.array([0, 1])
    boxes = boxes_now(tracks, seen, np.array([[5.0, 0, 0, 4, 2, 1.5, 0]] * 2), 1.0)
    # seen: what stands is drawn a quarter of the way to where it stands; not seen: where it stands, or moves
    assert boxes[:, 0] == pytest.approx([1.25, 1, 2, 1])
    assert boxes[0] == pytest.approx([1.25, 0, -0.25, 4, 2, 1.5, 0])
    half = boxes_now(tracks, seen, np.array([[5.0, 0, 0, 4, 2, 1.5, 0]] * 2), 0.5)
    assert half[:, 0] == pytest.approx([3.125, 3, 2, 1])

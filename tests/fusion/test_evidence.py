import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.fusion.evidence import (
    Evidence,
    evidence_table,
    ground_slope,
    miss_exposure,
    to_log_odds,
    to_probability,
)

WEIGHTS = Evidence(
    base=-1, trust=0.5, support=(1.0, 2.0, 3.0, 5.0), miss=0.7, off_ground=2.0, competing=4.0, recovered=0.3
)


def row(log_odds=0.0, competing=0.0, slope=0.0, exposure=0.0, score=0.0, iou=0.0):
    return evidence_table(*(np.array([v], dtype=float) for v in (log_odds, competing, slope, exposure, score, iou)))


def log_odds(**values):
    return float((row(**values) @ WEIGHTS.weights)[0])


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, -1),
        ({"log_odds": 3.0}, -1 + 1.5),
        ({"score": 1.0, "iou": 0.5}, -1 + 1.0),
        ({"score": 1.0, "iou": 0.25}, -1 + 0.5),  # half way to the first point
        ({"score": 1.0, "iou": 0.6}, -1 + 1.5),  # half way from 0.5 to 0.7
        ({"score": 0.5, "iou": 1.0}, -1 + 2.5),
        ({"exposure": 1.0}, -1 - 0.7),
        ({"exposure": 1.0, "score": 1.0, "iou": 0.5}, -1 + 1.0),  # matched: nothing was missed
        ({"slope": 0.5}, -1 - 1.0),
        ({"competing": 0.5}, -1 - 2.0),
    ],
)
def test_log_odds_by_hand(values, expected):
    assert log_odds(**values) == pytest.approx(expected)


unit = st.floats(0, 1)


@given(st.floats(-8, 8), unit, unit, unit, unit, unit)
def test_more_camera_support_never_lowers_a_score(value, exposure, score_a, score_b, iou_a, iou_b):
    less = log_odds(log_odds=value, exposure=exposure, score=min(score_a, score_b), iou=min(iou_a, iou_b))
    more = log_odds(log_odds=value, exposure=exposure, score=max(score_a, score_b), iou=max(iou_a, iou_b))
    unmatched = log_odds(log_odds=value, exposure=exposure)
    assert unmatched - 1e-9 <= less <= more + 1e-9


@given(st.floats(-8, 8), st.floats(-8, 8), unit, unit, unit)
def test_a_better_lidar_score_never_lowers_a_score(a, b, competing, score, iou):
    low, high = sorted((a, b))
    # a competing box is one only while its score is the higher: it may vanish as the own score grows
    assert log_odds(log_odds=low, competing=competing, score=score, iou=iou) <= log_odds(
        log_odds=high, score=score, iou=iou
    )


def test_weights_go_there_and_back():
    assert Evidence.from_weights(WEIGHTS.weights, recovered=0.3) == WEIGHTS
    np.testing.assert_allclose(Evidence.lidar_alone().weights, [1, 0, 0, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("values", "message"),
    [({"support": (1, 0.5, 2, 3)}, "must not fall"), ({"miss": -1}, "miss"), ({"recovered": 1.5}, "recovered")],
)
def test_senseless_weights(values, message):
    with pytest.raises(ValueError, match=message):
        Evidence(**values)


def test_exposure_grows_with_height_and_ends_at_the_edge():
    tall = np.array([[100, 100, 200, 250], [100, 100, 200, 125], [100, 100, 200, 110], [100, 100, 200, 161.2372]])
    np.testing.assert_allclose(miss_exposure(tall, 1000, 400), [1, 0, 0, 0.5], atol=1e-4)
    cut = np.array([[0.0, 100, 200, 250], [800, 100, 1000, 250], [100, 200, 200, 400]])
    assert miss_exposure(cut, 1000, 400).tolist() == [0, 0, 0]


def test_slope_to_the_ground():
    # undersides at -1.6, 1 m above at 40 m and at 10 m, below at 20 m
    boxes = np.array([[20.0, 0, -0.8], [40, 0, 0.2], [10, 0, 0.2], [0, 20, -1.3]])
    boxes = np.column_stack([boxes, np.tile([4, 1.8, 1.6, 0], (4, 1))])
    np.testing.assert_allclose(ground_slope(boxes, -1.6), [0, 0.5, 1, 0.5], atol=1e-12)
    assert ground_slope(boxes, None).tolist() == [0, 0, 0, 0]


@given(st.floats(-20, 20))
def test_probability_and_log_odds_are_inverse(value):
    assert to_log_odds(to_probability(np.array([value])))[0] == pytest.approx(value, abs=1e-5)


def test_certain_scores_stay_finite():
    assert np.isfinite(to_log_odds(np.array([0.0, 1.0]))).all()

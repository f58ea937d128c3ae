import numpy as np
import pytest

from lcf3d.errors import ConfigError
from lcf3d.fusion.evidence import to_log_odds, to_probability
from lcf3d.fusion.memory import remember_sequence
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_evidence import MEMORY_S, REFERENCE
from lcf3d.fusion.memory_fit import Remembered, fit_memory, gathering, remembered_boxes
from lcf3d.structures import KITTI_CLASSES as CLASSES

from .test_memory import drive, fused

CAR, PEDESTRIAN = 0, 1


def drawn(seen, missed, base, n=4000, slope=1.0, level=0.0, label=CAR, seed=0):
    """Boxes that are right as often as a memory of these weights says; the present is told with a slope and level."""
    rng = np.random.default_rng(seed)
    predicted = np.arange(n) % 2 == 1
    past = np.where(predicted, rng.uniform(0, 40, n), rng.uniform(-6, 30, n))
    true = rng.normal(0, 1.5, n)
    log_odds = true + np.where(predicted, missed * past - base, seen * past)
    right = (rng.random(n) < to_probability(log_odds)).astype(float)
    present = np.where(predicted, true, (true - level) / slope)
    return Remembered(np.full(n, label), predicted, present, past), right


def test_weights_come_back():
    boxes, right = drawn(0.2, 0.15, 4.0, n=20000)
    car = fit_memory(boxes, np.ones(len(right), bool), right, CLASSES)["Car"]
    assert car.seen_weight == pytest.approx(0.2, abs=0.02)
    assert car.missed_weight == pytest.approx(0.15, abs=0.02)
    assert car.base == pytest.approx(4.0, abs=0.4)
    assert car.acceleration == MemoryConfig().of("Car").acceleration


def test_scores_that_are_off_are_not_put_on_the_past():
    # log-odds = 0.8 * present - 1 + 0.16 * past: on the scale of the present the past counts 0.2
    boxes, right = drawn(0.16, 0.12, 4.0, n=20000, slope=0.8, level=-1.0)
    car = fit_memory(boxes, np.ones(len(right), bool), right, CLASSES)["Car"]
    assert car.seen_weight == pytest.approx(0.2, abs=0.015)
    # a predicted box beside seen ones, whose level is one too high: (4 - 1) / 0.8
    assert car.base == pytest.approx(3.75, abs=0.3)


def test_no_weight_is_negative_and_what_is_not_judged_does_not_count():
    boxes, right = drawn(0.0, 0.1, 4.0)
    upside_down = np.where(boxes.predicted, right, boxes.past < 10).astype(float)
    assert fit_memory(boxes, np.ones(len(right), bool), upside_down, CLASSES)["Car"].seen_weight == 0
    assert fit_memory(boxes, np.zeros(len(right), bool), right, CLASSES) == {}


def test_few_boxes_leave_the_defaults():
    boxes, right = drawn(0.2, 0.15, 4.0, n=60, label=PEDESTRIAN)
    assert fit_memory(boxes, np.arange(60) < 20, right, CLASSES) == {}
    seen_only = fit_memory(boxes, ~boxes.predicted | (np.arange(60) < 8), right, CLASSES)
    assert set(seen_only) <= {"Pedestrian"}
    for settings in seen_only.values():
        assert settings.base == MemoryConfig().of("Pedestrian").base


def test_what_is_gathered_worked_out_by_hand():
    pairs = drive(0.0, missing={3}, n=4, score=0.9)
    results = list(remember_sequence(pairs, gathering(CLASSES)))
    boxes = remembered_boxes(results)
    stays, own = np.exp(-0.1 / MEMORY_S), to_log_odds(np.array([0.9]))[0]
    first, second, third, missed = range(4)
    assert boxes.predicted.tolist() == [False, False, False, True]
    np.testing.assert_allclose(boxes.present[:3], own)
    assert boxes.past[first] == 0
    support = (own + 4) * stays
    np.testing.assert_allclose(boxes.past[second], support - REFERENCE * stays)
    support = (support + own + 4) * stays
    np.testing.assert_allclose(boxes.past[third], support - REFERENCE * stays)
    np.testing.assert_allclose(boxes.past[missed], (support + own + 4) * stays)
    np.testing.assert_allclose(boxes.present[missed], 0, atol=1e-9)


def test_frames_without_memory_are_refused():
    with pytest.raises(ConfigError, match="without tracks"):
        remembered_boxes([fused([], [])])

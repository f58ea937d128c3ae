import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.errors import Lcf3dError
from lcf3d.fusion.calibration_fit import (
    block_folds,
    choose_map,
    fit_evidence,
    fit_isotonic,
    fit_platt,
    log_loss,
)
from lcf3d.fusion.evidence import Evidence, evidence_table, to_probability


def logistic(n, slope, intercept, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(0, 2, n)
    return x, (rng.random(n) < to_probability(slope * x + intercept)).astype(float)


def test_platt_finds_the_line_that_made_the_data():
    x, right = logistic(20000, 1.5, -0.5)
    slope, intercept = fit_platt(x, right)
    assert slope == pytest.approx(1.5, rel=0.05)
    assert intercept == pytest.approx(-0.5, abs=0.08)


def test_platt_without_data_is_its_prior_and_never_falls():
    assert fit_platt(np.zeros(0), np.zeros(0), prior=(0.7, -2.0)) == (0.7, -2.0)
    x, right = logistic(500, 2.0, 0.0)
    assert fit_platt(x, 1 - right)[0] > 0


def test_platt_of_separable_data_stays_finite():
    x = np.array([-1.0, -0.5, 0.5, 1.0])
    slope, intercept = fit_platt(x, (x > 0).astype(float))
    assert 0 < slope < 20
    assert abs(intercept) < 1


def test_log_loss_by_hand():
    assert log_loss(np.array([0.8, 0.4]), np.array([1.0, 0.0])) == pytest.approx(-(np.log(0.8) + np.log(0.6)) / 2)
    assert np.isfinite(log_loss(np.array([0.0]), np.array([1.0])))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 200), st.integers(0, 1000))
def test_isotonic_points_rise(n, seed):
    rng = np.random.default_rng(seed)
    x = np.round(rng.normal(size=n), 1)
    points = np.array(fit_isotonic(x, rng.integers(0, 2, n).astype(float), 1.0))
    assert len(points) >= 1
    assert (np.diff(points, axis=0) > 0).all()


def test_isotonic_by_hand():
    x = np.arange(60.0)
    right = np.repeat([0.0, 1.0, 1.0], 20)
    right[[5, 30]] = [1, 0]
    points = fit_isotonic(x, right, 1.0)
    # the pool around the mistake at 30 is one block of 11, joined with its neighbours to at least 20
    assert points[0][1] == pytest.approx(np.log(1.5 / 19.5), abs=0.3)
    assert points[-1][1] > 2


def test_a_straight_line_is_kept_simple_and_a_step_is_not():
    x, right = logistic(3000, 1.0, 0.0)
    folds = np.arange(3000) % 5
    chosen, loss = choose_map(x, right, folds)
    assert (chosen.kind, chosen.transform) == ("platt", "identity")
    assert loss < np.log(2)
    rng = np.random.default_rng(1)
    step = np.where(np.abs(x) < 1, 0.5, np.where(x > 0, 0.98, 0.4))
    chosen, _ = choose_map(x, (rng.random(3000) < step).astype(float), folds)
    assert chosen.kind == "isotonic"


def evidence_data(n, weights, seed=0):
    rng = np.random.default_rng(seed)
    matched = rng.random(n) < 0.5
    table = evidence_table(
        rng.normal(0, 2, n),
        rng.random(n) * (rng.random(n) < 0.2),
        rng.random(n),
        rng.random(n),
        np.where(matched, rng.random(n), 0),
        np.where(matched, rng.uniform(0.4, 1, n), 0),
    )
    return table, (rng.random(n) < to_probability(table @ weights)).astype(float)


def test_evidence_finds_the_weights_that_made_the_data():
    true = Evidence(base=-1, trust=0.7, support=(1.0, 2.0, 3.0, 5.0), miss=0.8, off_ground=1.5, competing=2.0)
    found = fit_evidence(*evidence_data(60000, true.weights), strength=1.0, recovered=0.2)
    np.testing.assert_allclose(found.weights, true.weights, atol=0.35)
    assert found.recovered == 0.2


def test_evidence_against_the_camera_is_not_believed():
    # the camera confirms false boxes: its support must not go below nothing
    table, right = evidence_data(4000, np.array([1.0, 0, 0, 0, -2, -2, -2, -2, 0]))
    assert fit_evidence(table, right).support == (0, 0, 0, 0)


def test_little_data_leaves_the_lidar_branch_alone():
    table, right = evidence_data(3, Evidence().weights)
    found = fit_evidence(table, right, strength=1000.0)
    np.testing.assert_allclose(found.weights[1:-1], 0, atol=0.02)
    assert found.trust > 0


def test_fits_are_deterministic():
    data = evidence_data(500, Evidence().weights)
    assert fit_evidence(*data) == fit_evidence(*data)


def test_folds_keep_sequences_together():
    ids = tuple(f"{s:04d}_{i:06d}" for s, count in enumerate([10, 4, 3, 3]) for i in range(count))
    folds = block_folds(ids, 2)
    by_sequence = {i.split("_")[0]: set() for i in ids}
    for name, fold in zip(ids, folds, strict=True):
        by_sequence[name.split("_")[0]].add(int(fold))
    assert all(len(found) == 1 for found in by_sequence.values())
    assert np.bincount(folds).tolist() == [10, 10]
    assert block_folds(tuple("abcdef"), 3).tolist() == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize(
    ("ids", "count", "message"),
    [(("a", "b"), 1, "2 folds or more"), (("a", "b"), 3, "2 frames for 3"), (("0_1", "1_1"), 3, "2 sequences for 3")],
)
def test_folds_that_cannot_be(ids, count, message):
    with pytest.raises(Lcf3dError, match=message):
        block_folds(ids, count)


def test_tables_of_another_shape_are_refused():
    with pytest.raises(Lcf3dError, match="evidence table"):
        fit_evidence(np.zeros((3, 4)), np.zeros(3))

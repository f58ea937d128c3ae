import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.evaluation.center_distance import ERRORS, RECALLS, Curve, EvaluationBoxes, class_curves


def boxes(
    centers: list[tuple[float, float]],
    scores: list[float] | None = None,
    *,
    frames: list[int] | None = None,
    labels: list[int] | None = None,
    sizes: tuple[float, float, float] = (2, 4, 1.5),
    yaw: float = 0.0,
    velocity: tuple[float, float] = (0, 0),
    attribute: int = 0,
) -> EvaluationBoxes:
    n = len(centers)
    return EvaluationBoxes(
        np.array(frames if frames is not None else [0] * n, dtype=np.int64),
        np.array(labels if labels is not None else [0] * n, dtype=np.int64),
        np.array(centers, dtype=np.float64).reshape(n, 2),
        np.tile(np.array(sizes, dtype=np.float64), (n, 1)),
        np.full(n, yaw),
        np.array(scores if scores is not None else [0.5] * n, dtype=np.float64),
        np.tile(np.array(velocity, dtype=np.float64), (n, 1)),
        np.full(n, attribute, dtype=np.int64),
    )


def curve(truth: EvaluationBoxes, found: EvaluationBoxes, threshold: float = 2.0, half_turn: bool = False) -> Curve:
    return class_curves(truth, found, 1, (threshold,), frozenset([0] if half_turn else []))[0][0]


def error(c: Curve, name: str) -> float:
    return float(c.errors[ERRORS.index(name), -1])


def test_a_perfect_detection() -> None:
    c = curve(boxes([(5, 5)]), boxes([(5, 5)], [0.7]))
    np.testing.assert_array_equal(c.precision, np.ones(101))
    np.testing.assert_array_equal(c.confidence, np.full(101, 0.7))
    np.testing.assert_array_equal(c.errors, np.zeros((5, 101)))
    assert c.average_precision(0.1, 0.1) == pytest.approx(1)
    np.testing.assert_array_equal(c.mean_errors(0.1), np.zeros(5))


def test_the_distance_must_be_smaller_than_the_threshold() -> None:
    truth = boxes([(0, 0)])
    # the 3-4-5 triangle
    assert curve(truth, boxes([(3, 4)]), 5.0).precision.max() == 0
    c = curve(truth, boxes([(3, 4)]), 5.0001)
    assert c.precision.min() == 1
    assert error(c, "trans_err") == 5


def test_errors_by_hand() -> None:
    truth = boxes([(0, 0)], sizes=(2, 4, 1), yaw=0.1, velocity=(1, 1), attribute=2)
    found = boxes([(0.3, 0.4)], sizes=(1, 4, 2), yaw=-0.2, velocity=(4, 5), attribute=3)
    c = curve(truth, found)
    assert error(c, "trans_err") == pytest.approx(0.5)
    # shared 1 * 4 * 1, union 8 + 8 - 4
    assert error(c, "scale_err") == pytest.approx(1 - 4 / 12)
    assert error(c, "orient_err") == pytest.approx(0.3)
    assert error(c, "vel_err") == pytest.approx(5)
    assert error(c, "attr_err") == 1


def test_headings_wrap_and_barriers_have_no_front() -> None:
    truth, found = boxes([(0, 0)], yaw=3.1), boxes([(0, 0)], yaw=-3.1)
    assert error(curve(truth, found), "orient_err") == pytest.approx(2 * np.pi - 6.2)
    turned = boxes([(0, 0)], yaw=3.1 - np.pi)
    assert error(curve(truth, turned), "orient_err") == pytest.approx(np.pi)
    assert error(curve(truth, turned, half_turn=True), "orient_err") == pytest.approx(0, abs=1e-12)


def test_undefined_errors_are_ones_or_left_out() -> None:
    unknown = boxes([(0, 0)], velocity=(np.nan, np.nan), attribute=-1)
    c = curve(unknown, boxes([(0, 0)]))
    assert error(c, "vel_err") == error(c, "attr_err") == 1
    truth = boxes([(0, 0), (50, 0)])
    truth.velocities[0] = np.nan
    c = curve(truth, boxes([(0, 0), (50, 0)], [0.9, 0.8], velocity=(3, 4)))
    # before the first known velocity 0, as in the devkit
    assert c.errors[ERRORS.index("vel_err"), [0, -1]].tolist() == [0, 5]


def test_of_equal_scores_the_later_prediction_goes_first() -> None:
    truth = boxes([(0, 0)])
    assert error(curve(truth, boxes([(1, 0), (0.5, 0)], [0.5, 0.5])), "trans_err") == 0.5
    assert error(curve(truth, boxes([(0.5, 0), (1, 0)], [0.5, 0.5])), "trans_err") == 1
    assert error(curve(truth, boxes([(0.5, 0), (1, 0)], [0.6, 0.5])), "trans_err") == 0.5


def test_frames_and_classes_do_not_mix() -> None:
    truth = boxes([(0, 0), (0, 0)], frames=[0, 1], labels=[0, 1])
    found = boxes([(0, 0), (0, 0)], frames=[1, 0], labels=[0, 1])
    assert all(c.precision.max() == 0 for row in class_curves(truth, found, 2, (2.0,)) for c in row)
    found = boxes([(0, 0), (0, 0)], frames=[0, 1], labels=[0, 1])
    assert all(c.precision.min() == 1 for row in class_curves(truth, found, 2, (2.0,)) for c in row)


def test_half_the_recall() -> None:
    c = curve(boxes([(0, 0), (50, 0)]), boxes([(0, 0)], [0.5]))
    np.testing.assert_array_equal(c.precision, np.where(RECALLS <= 0.5, 1.0, 0.0))
    # 40 of the 90 recall values beyond 0.1
    assert c.average_precision(0.1, 0.1) == pytest.approx(40 / 90)
    assert c.mean_errors(0.1)[0] == 0


def test_recall_below_a_tenth_counts_as_errors_of_one() -> None:
    truth = boxes([(float(10 * i), 0) for i in range(20)])
    np.testing.assert_array_equal(curve(truth, boxes([(0, 0)])).mean_errors(0.1), np.ones(5))


def test_nothing_at_all() -> None:
    some, none = boxes([(0, 0)]), boxes([])
    for truth, found in ((some, none), (none, some), (none, none)):
        c = curve(truth, found)
        assert c.average_precision(0.1, 0.1) == 0
        np.testing.assert_array_equal(c.mean_errors(0.1), np.ones(5))


def brute_force(truth: EvaluationBoxes, found: EvaluationBoxes, label: int, threshold: float) -> list[bool]:
    """Hits in descending score, by plain loops."""
    order = sorted((i for i in range(len(found)) if found.labels[i] == label), key=lambda i: (found.scores[i], i))[::-1]
    free = {g for g in range(len(truth)) if truth.labels[g] == label}
    hits = []
    for i in order:
        near = [
            (float(np.linalg.norm(found.centers[i] - truth.centers[g])), g)
            for g in free
            if truth.frames[g] == found.frames[i]
        ]
        hit = bool(near) and min(near)[0] < threshold
        if hit:
            free.remove(min(near)[1])
        hits.append(hit)
    return hits


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000))
def test_matching_agrees_with_plain_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def some(n: int) -> EvaluationBoxes:
        frames, labels = rng.integers(0, 3, n).tolist(), rng.integers(0, 2, n).tolist()
        centers = [(float(x), float(y)) for x, y in rng.uniform(0, 6, (n, 2))]
        return boxes(centers, rng.integers(0, 5, n).tolist(), frames=frames, labels=labels)

    truth, found = some(int(rng.integers(0, 15))), some(int(rng.integers(0, 25)))
    for label, row in enumerate(class_curves(truth, found, 2, (0.5, 2.0))):
        for threshold, c in zip((0.5, 2.0), row, strict=True):
            hits = np.array(brute_force(truth, found, label, threshold), dtype=bool)
            annotated = int((truth.labels == label).sum())
            if not hits.any():
                assert c.precision.max() == 0
                continue
            recall, precision = np.cumsum(hits) / annotated, np.cumsum(hits) / np.arange(1, len(hits) + 1)
            np.testing.assert_allclose(c.precision, np.interp(RECALLS, recall, precision, right=0))

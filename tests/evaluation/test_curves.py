import numpy as np
import pytest

from lcf3d.errors import ShapeError
from lcf3d.evaluation.curves import (
    ScoreEvents,
    average_precision,
    best_f1_score,
    exact_average_precision,
    precision_curve,
    precision_recall,
    resampled_curves,
)


def events(rows: list[tuple[float, int, int, int]], objects: list[int]) -> ScoreEvents:
    """Events from (score, frame, true, false), sorted by falling score; every true positive is also a hit."""
    scores = np.array([row[0] for row in rows])
    columns = np.array([row[1:] for row in rows], dtype=np.int64).reshape(-1, 3)
    hit = columns[:, 1] > 0
    return ScoreEvents(
        np.array(objects),
        scores[hit],
        columns[hit, 0].copy(),
        scores,
        columns[:, 0].copy(),
        columns[:, 1].copy(),
        columns[:, 2].copy(),
        columns[:, 1] / 2,
    )


MIXED = events([(0.9, 0, 1, 0), (0.8, 1, 0, 1), (0.7, 1, 1, 0), (0.6, 0, 0, 1), (0.5, 0, 0, 1)], [2, 2])


def test_eleven_positions_include_recall_zero_and_forty_do_not() -> None:
    precision = np.zeros(41)
    precision[0] = 1
    assert average_precision(precision, "R40") == 0
    assert average_precision(precision, "R11") == pytest.approx(100 / 11)
    with pytest.raises(ShapeError, match="41 values, got 11"):
        average_precision(np.zeros(11))


def test_precision_and_recall_by_hand() -> None:
    recall, precision, scores = precision_recall(MIXED)
    np.testing.assert_allclose(recall, [1 / 4, 1 / 4, 2 / 4, 2 / 4, 2 / 4])
    np.testing.assert_allclose(precision, [1, 1 / 2, 2 / 3, 2 / 4, 2 / 5])
    assert scores.tolist() == [0.9, 0.8, 0.7, 0.6, 0.5]


def test_equal_scores_come_in_together() -> None:
    recall, precision, scores = precision_recall(events([(0.5, 0, 1, 0), (0.5, 1, 0, 1)], [1, 0]))
    assert recall.tolist() == [1]
    assert precision.tolist() == [0.5]
    assert scores.tolist() == [0.5]


def test_exact_average_precision_by_hand() -> None:
    # a quarter of the recall at precision 1, the next at 2 / 3, the rest is never reached
    assert exact_average_precision(MIXED) == pytest.approx(100 * (1 / 4 + 1 / 4 * 2 / 3))


def test_few_objects_have_an_exact_average_precision_of_100_and_an_official_one_far_below() -> None:
    perfect = events([(1 - i / 10, 0, 1, 0) for i in range(10)], [10])
    assert exact_average_precision(perfect) == pytest.approx(100)
    assert precision_curve(perfect)[0].average_precision() == pytest.approx(22.5)


def test_many_objects_have_the_same_average_precision_either_way() -> None:
    right = np.random.default_rng(0).random(4000) < np.linspace(1, 0.2, 4000)
    many = events([(1 - i / 4000, 0, int(hit), int(not hit)) for i, hit in enumerate(right)], [3000])
    assert exact_average_precision(many) == pytest.approx(precision_curve(many)[0].average_precision(), abs=1.5)


def test_without_objects_there_is_no_exact_average_precision() -> None:
    assert np.isnan(exact_average_precision(events([(0.5, 0, 0, 1)], [0])))


def test_best_f1() -> None:
    assert best_f1_score(MIXED) == 0.7  # recall 1/2 and precision 2/3; F1 is lower everywhere else
    assert best_f1_score(events([], [3])) == np.inf


def test_sampled_curve_takes_the_best_at_this_or_a_higher_recall() -> None:
    curve, similarity = precision_curve(MIXED)
    # thresholds are the two hits: 1 / 1, then 2 / 3
    np.testing.assert_allclose(curve.precision, [1, 2 / 3] + [0] * 39)
    np.testing.assert_allclose(similarity.precision, [0.5, 1 / 3] + [0] * 39)
    assert curve.object_count == 4


def test_many_hits_are_thinned_to_41_positions() -> None:
    n = 400
    curve, _ = precision_curve(events([(1 - i / n, 0, 1, 0) for i in range(n)], [n]))
    assert (curve.precision == 1).all()


def test_weights_stand_for_copies_of_frames() -> None:
    twice_the_second = events(
        [
            (0.9, 0, 1, 0),
            (0.8, 1, 0, 1),
            (0.8, 2, 0, 1),
            (0.7, 1, 1, 0),
            (0.7, 2, 1, 0),
            (0.6, 0, 0, 1),
            (0.5, 0, 0, 1),
        ],
        [2, 2, 2],
    )
    weighted, _ = resampled_curves(MIXED, np.array([[1, 2], [1, 1], [0, 0]]))
    np.testing.assert_allclose(weighted[0], precision_curve(twice_the_second)[0].precision)
    np.testing.assert_allclose(weighted[1], precision_curve(MIXED)[0].precision)
    assert (weighted[2] == 0).all()
    with pytest.raises(ShapeError, match=r"shape \(B, 2\), got \(1, 3\)"):
        resampled_curves(MIXED, np.ones((1, 3), dtype=np.int64))

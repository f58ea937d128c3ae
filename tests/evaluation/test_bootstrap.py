import numpy as np
import pytest

from lcf3d.errors import ConfigError, DatasetError
from lcf3d.evaluation.bootstrap import Interval, frame_weights, resampled_ap
from lcf3d.evaluation.kitti import KittiEvaluator, Selection, evaluate
from lcf3d.evaluation.kitti_breakdown import ap_by_distance, ap_over_iou, compare

from .kitti_frames import frames


def evaluator(seed: int, share_found: float, n: int = 60) -> KittiEvaluator:
    """One car a frame, found in a share of the frames."""
    rng = np.random.default_rng(seed)
    results = [
        [{"score": rng.uniform(), "box": (0, 0, 100, 50) if rng.uniform() < share_found else (500, 0, 600, 50)}]
        for _ in range(n)
    ]
    return KittiEvaluator(frames([[{}]] * n, False), frames(results, True))


def test_every_draw_has_as_many_frames_as_there_are() -> None:
    weights = frame_weights(50, samples=400, seed=3)
    assert weights.shape == (400, 50)
    assert (weights.sum(axis=1) == 50).all()
    # the number of times a frame is drawn has mean 1 and variance 1 - 1/50
    assert weights.var() == pytest.approx(0.98, abs=0.05)
    assert (weights == frame_weights(50, samples=400, seed=3)).all()
    assert (weights != frame_weights(50, samples=400, seed=4)).any()
    with pytest.raises(ConfigError, match="got 0 and 5"):
        frame_weights(0, samples=5)


def test_interval_holds_the_middle_of_the_samples() -> None:
    interval = Interval.of(7.0, np.arange(101.0))
    assert (interval.value, interval.low, interval.high) == pytest.approx((7.0, 2.5, 97.5))


def test_a_resample_is_the_evaluation_of_the_drawn_frames() -> None:
    one = evaluator(0, 0.7)
    selection = Selection("Car", "bbox", "moderate")
    weights = frame_weights(60, samples=3, seed=1)
    ap, _ = resampled_ap(one.events(selection), weights)
    for drawn, value in zip(weights, ap, strict=True):
        rows = np.repeat(np.arange(60), drawn)
        truth = frames([[{}]] * 60, False)
        results = frames(
            [
                [{"score": float(one.results[i].scores[0]), "box": one.results[i].boxes2d[0]}]  # type: ignore[index]
                for i in rows
            ],
            True,
        )
        assert evaluate(truth, results).ap("Car", "bbox") == pytest.approx(value)


def test_comparison_of_a_result_with_itself_is_certain() -> None:
    rows = compare(evaluator(0, 0.7), evaluator(0, 0.7), samples=50)
    assert {(row.measure, row.level) for row in rows} == {
        (measure, difficulty) for measure in ("2D", "AOS", "BEV", "3D") for difficulty in ("easy", "moderate", "hard")
    }
    for row in rows:
        assert (row.difference.value, row.difference.low, row.difference.high) == (0, 0, 0)
        assert row.first.low <= row.first.value <= row.first.high


def test_a_clear_difference_leaves_out_zero() -> None:
    first, second = evaluator(0, 0.3), evaluator(1, 0.95)
    row = next(r for r in compare(first, second, samples=200) if (r.measure, r.level) == ("2D", "moderate"))
    assert row.first.value == first.metrics().ap("Car", "bbox")
    assert row.second.value == second.metrics().ap("Car", "bbox")
    assert row.difference.value == pytest.approx(row.second.value - row.first.value)
    assert 0 < row.difference.low < row.difference.value


def test_only_equal_frames_can_be_compared() -> None:
    with pytest.raises(DatasetError, match="same frames, got 60 and 59 frames"):
        compare(evaluator(0, 0.5), evaluator(0, 0.5, n=59))


def test_ap_falls_with_the_iou_threshold() -> None:
    truth = frames([[{}]] * 50, False)
    # the detected box covers 72 of 100 columns: IoU 0.72
    results = frames([[{"box": (0, 0, 72, 50), "score": 1 - i / 100}] for i in range(50)], True)
    values = ap_over_iou(KittiEvaluator(truth, results), Selection("Car", "bbox", "moderate"))
    assert values == [100.0] * 7 + [0.0] * 2


def test_distance_ranges_share_the_objects() -> None:
    rows = [[{"location": (0, 1.5, z), "score": 1 - z / 100}] for z in range(1, 61)]
    table = ap_by_distance(KittiEvaluator(frames(rows, False), frames(rows, True)), Selection("Car", "3d", "easy"))
    assert [row.objects for row in table] == [19, 20, 21]
    assert table[0].near == 0
    assert table[-1].far == float("inf")

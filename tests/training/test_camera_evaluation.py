import numpy as np
import pytest

from lcf3d.structures import KITTI_CLASSES, Detections2D, InstanceMask
from lcf3d.training.camera_calibration import fit_logits
from lcf3d.training.camera_evaluation import average_precision, evaluate
from tests.training.camera_pictures import picture

CAR, WALKER = ("Car", (20, 16, 60, 48)), ("Pedestrian", (70, 10, 80, 40))


def found(rows: list[tuple[float, int, tuple[float, float, float, float]]], masks: bool = False) -> Detections2D:
    boxes = np.array([box for _, _, box in rows], dtype=float).reshape(-1, 4)
    filled = tuple(InstanceMask(int(x), int(y), np.ones((int(v - y), int(u - x)), bool)) for x, y, u, v in boxes)
    return Detections2D(
        boxes, np.array([s for s, _, _ in rows]), [c for _, c, _ in rows], KITTI_CLASSES, filled if masks else None
    )


def test_the_truth_itself_is_perfect() -> None:
    image = picture([CAR, WALKER])
    figures = evaluate([found([(0.9, 0, CAR[1]), (0.8, 1, WALKER[1])], masks=True)], [image]).figures()
    assert figures == {
        "AP50 Car": 100.0,
        "AP50 Pedestrian": 100.0,
        "AP70 Car": 100.0,
        "AP70 Pedestrian": 100.0,
        "mask IoU Car": 1.0,
        "mask IoU Pedestrian": 1.0,
        "calibration error": pytest.approx(0.15),
    }


def test_a_loose_box_counts_at_the_lower_overlap_only() -> None:
    result = evaluate([found([(0.9, 0, (20, 16, 60, 70))])], [picture([CAR], size=(80, 96))])
    assert (result.ap(0, 0), result.ap(0, 1)) == (1.0, 0.0)


def test_a_second_detection_of_an_object_is_a_false_alarm() -> None:
    result = evaluate([found([(0.9, 0, CAR[1]), (0.8, 0, CAR[1])])], [picture([CAR])])
    assert result.hits[:, 0].tolist() == [True, False]


def test_detections_on_ignored_objects_do_not_count() -> None:
    image = picture([("Person_sitting", (20, 16, 60, 48))])
    result = evaluate([found([(0.9, 1, (22, 16, 60, 48))])], [image])
    assert len(result.scores) == 0
    assert result.objects.tolist() == [0, 0, 0]


def test_nothing_found_and_nothing_there() -> None:
    nothing = Detections2D.empty(KITTI_CLASSES)
    assert evaluate([nothing], [picture([CAR])]).ap(0, 0) == 0.0
    assert np.isnan(evaluate([nothing], [picture([])]).ap(0, 0))
    assert evaluate([], []).calibration_error() == 0.0


def test_average_precision_by_hand() -> None:
    # hits at ranks 1 and 3 of two objects: precision 1 up to recall 0.5, then 2/3
    precision = average_precision(np.array([0.9, 0.8, 0.7]), np.array([True, False, True]), 2)
    assert precision == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)


def test_fitted_logits_make_scores_probabilities() -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(0.05, 0.95, 4000)
    hits = rng.random(4000) < true
    shown = 1 / (1 + np.exp(-(2 * np.log(true / (1 - true)) + 1)))  # too sure, and too high
    slope, shift = fit_logits(shown, hits)
    assert slope == pytest.approx(0.5, abs=0.05)
    assert shift == pytest.approx(-0.5, abs=0.1)


def test_without_detections_scores_stay_as_they_are() -> None:
    assert fit_logits(np.zeros(0), np.zeros(0, bool)) == (1.0, 0.0)

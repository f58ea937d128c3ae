import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.errors import DatasetError, FormatError
from lcf3d.evaluation.argoverse import OFFICIAL, ArgoverseMetrics, ArgoverseMetricsConfig, evaluate_argoverse
from lcf3d.formats.argoverse import Cuboids, read_annotations, read_submission
from lcf3d.structures import ARGOVERSE_CLASSES

CAR, DOG = ARGOVERSE_CLASSES.index("REGULAR_VEHICLE"), ARGOVERSE_CLASSES.index("DOG")


def cuboids(
    centers: list[tuple[float, float, float]],
    scores: list[float] | None = None,
    *,
    labels: list[int] | None = None,
    times: list[int] | None = None,
    size: tuple[float, float, float] = (4, 2, 1),
    yaw: float = 0.0,
    points: int = 1,
    log: str = "log",
) -> Cuboids:
    n = len(centers)
    boxes = np.column_stack(
        [np.array(centers, dtype=float).reshape(n, 3), np.tile(np.array(size, float), (n, 1)), np.full(n, yaw)]
    )
    return Cuboids(
        (log,),
        np.zeros(n, np.int64),
        np.array(times or [0] * n, dtype=np.int64),
        boxes,
        np.array(labels or [CAR] * n, dtype=np.int64),
        np.array(scores or [0.5] * n, dtype=float),
        np.full(n, points, dtype=np.int64),
    )


def car(metrics: ArgoverseMetrics) -> dict[str, float]:
    row = metrics.to_json()["REGULAR_VEHICLE"]
    return {name: row[name] for name in ("AP", "ATE", "ASE", "AOE", "CDS")}


def test_ground_truth_against_itself() -> None:
    truth = cuboids([(5, 5, 0), (9, 9, 0), (5, 5, 0)], times=[0, 0, 1])
    metrics = evaluate_argoverse(truth, truth)
    assert car(metrics) == {"AP": 1, "ATE": 0, "ASE": 0, "AOE": 0, "CDS": 1}
    assert (metrics.sweeps, metrics.other_sweeps) == (2, 0)
    # 25 classes without ground truth count with the worst values
    means = metrics.table()
    assert means["AP"] == pytest.approx(1 / 26)
    assert means["ATE"] == pytest.approx(50 / 26)
    assert means["AOE"] == pytest.approx(25 * np.pi / 26)
    assert metrics.to_json()["AVERAGE_OF_ANNOTATED"]["CDS"] == 1


def test_errors_by_hand() -> None:
    truth = cuboids([(0, 0, 0)], size=(4, 2, 1), yaw=3.0)
    # 0.3, 0.4, 1.2: 1.3 m off; sizes 2 x 2 x 1 of 4 x 2 x 2 are shared; 6.2 rad are 0.083 the other way round
    found = cuboids([(0.3, 0.4, 1.2)], size=(2, 2, 2), yaw=-3.2)
    row = car(evaluate_argoverse(truth, found))
    assert row["ATE"] == pytest.approx(1.3)
    assert row["ASE"] == pytest.approx(1 - 4 / 16)
    assert row["AOE"] == pytest.approx(2 * np.pi - 6.2)
    # right at 2 and 4 m only
    assert row["AP"] == pytest.approx(0.5)
    expected = np.mean([1 - 1.3 / 2, 0.25, 1 - (2 * np.pi - 6.2) / np.pi])
    assert row["CDS"] == pytest.approx(0.5 * expected)


def test_average_precision_by_hand() -> None:
    truth = cuboids([(0, 0, 0), (50, 0, 0)])
    found = cuboids([(0, 0, 0), (20, 0, 0), (50, 0, 0)], [0.9, 0.8, 0.7])
    # precision 1 up to recall 1/2, then the line down... precision 2/3 at recall 1; between 0.5 and 1 interpolated
    recalls = np.linspace(0, 1, 101)
    expected = np.interp(recalls, [0.5, 0.5, 1], [1, 2 / 3, 2 / 3]).mean()
    assert car(evaluate_argoverse(truth, found))["AP"] == pytest.approx(expected)


def test_only_the_best_of_the_detections_of_one_annotation_can_be_right() -> None:
    truth = cuboids([(0, 0, 0), (3, 0, 0)])
    # both are nearest to the first annotation; the second one may not take its neighbour, though that is within 4 m
    found = cuboids([(0.4, 0, 0), (0.2, 0, 0)], [0.6, 0.9])
    metrics = evaluate_argoverse(truth, found)
    assert metrics.errors[CAR, 0] == pytest.approx(0.2)
    # precision 1 below recall 1/2, and 1/2 at it, where the second detection has come in
    assert metrics.aps[CAR].tolist() == pytest.approx([50.5 / 101] * 4)


def test_a_far_first_detection_keeps_a_nearer_one_of_a_lower_score_from_counting() -> None:
    truth = cuboids([(0, 0, 0)])
    metrics = evaluate_argoverse(truth, cuboids([(3, 0, 0), (0, 0, 0)], [0.9, 0.8]))
    assert metrics.aps[CAR].tolist() == pytest.approx([0, 0, 0, 100.5 / 101])
    assert metrics.errors[CAR].tolist() == OFFICIAL.worst_errors.tolist()


def test_boxes_of_other_sweeps_and_classes_are_not_matched() -> None:
    truth = cuboids([(0, 0, 0), (0, 0, 0)], times=[0, 1], labels=[CAR, DOG])
    found = cuboids([(0, 0, 0), (0, 0, 0)], times=[1, 0], labels=[CAR, DOG])
    assert evaluate_argoverse(truth, found).aps.max() == 0


def test_filters() -> None:
    truth = cuboids([(149, 0, 0), (150, 0, 0), (90, 0, 120)])
    metrics = evaluate_argoverse(truth, replace(truth, scores=np.ones(3)))
    assert (metrics.ground_truth_counts[CAR], metrics.detection_counts[CAR]) == (1, 1)
    assert evaluate_argoverse(cuboids([(5, 0, 0)], points=0), truth).ground_truth_counts[CAR] == 0
    near = evaluate_argoverse(truth, truth, ArgoverseMetricsConfig(max_range_m=100))
    assert near.ground_truth_counts[CAR] == 0


def test_the_hundred_best_of_a_sweep_and_class_count() -> None:
    truth = cuboids([(0, 0, 0), (30, 29, 0)])
    # one of the right ones has the lowest score of 101; out of range ones take no place
    found = cuboids([(30, 30, 0)] * 100 + [(0, 0, 0)] + [(200, 0, 0)], [0.5] * 100 + [0.1, 0.9])
    metrics = evaluate_argoverse(truth, found)
    assert metrics.detection_counts[CAR] == 100
    # the other annotation is found first: precision 1 below recall 1/2, 1/100 at it
    assert metrics.aps[CAR, -1] == pytest.approx(50.01 / 101)
    # a hundred detections without the first of them: 2 of 100 are right
    assert evaluate_argoverse(truth, found[1:]).aps[CAR, -1] > 50.5 / 101
    other = evaluate_argoverse(truth, replace(found, labels=np.array([CAR] * 50 + [DOG] * 50 + [CAR] * 2)))
    assert other.detection_counts[CAR] == 51


def test_sweeps_without_annotation_count_as_false_positives() -> None:
    truth = cuboids([(0, 0, 0)])
    metrics = evaluate_argoverse(truth, cuboids([(9, 9, 0), (0, 0, 0)], [0.9, 0.5], times=[7, 0]))
    assert metrics.other_sweeps == 1
    assert car(metrics)["AP"] == pytest.approx(0.5)


def test_what_cannot_be_compared() -> None:
    truth = cuboids([(0, 0, 0)])
    with pytest.raises(DatasetError, match="no annotations"):
        evaluate_argoverse(truth[:0], truth)
    with pytest.raises(FormatError, match="1 logs that are not annotated here, the first is other"):
        evaluate_argoverse(truth, cuboids([(0, 0, 0)], log="other"))
    with pytest.raises(FormatError, match="none of the 1 detections is of an annotated sweep"):
        evaluate_argoverse(truth, cuboids([(0, 0, 0)], times=[3]))


def test_no_detections() -> None:
    assert evaluate_argoverse(cuboids([(0, 0, 0)]), cuboids([])).table()["CDS"] == 0


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_the_order_of_boxes_does_not_matter(data: st.DataObject) -> None:
    random = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))

    def some(n: int) -> Cuboids:
        found = cuboids(
            [tuple(p) for p in random.uniform(-6, 6, (n, 3))],
            random.permutation(n).astype(float).tolist(),
            times=random.integers(0, 2, n).tolist(),
            labels=random.choice([CAR, DOG], n).tolist(),
        )
        return replace(found, boxes=found.boxes + random.uniform(0, 0.5, found.boxes.shape))

    truth, found = some(data.draw(st.integers(1, 12))), some(data.draw(st.integers(1, 12)))
    found = replace(
        found, timestamps_ns=np.where(np.arange(len(found)) == 0, truth.timestamps_ns[0], found.timestamps_ns)
    )
    metrics = evaluate_argoverse(truth, found)
    shuffled = evaluate_argoverse(truth[random.permutation(len(truth))], found[random.permutation(len(found))])
    np.testing.assert_allclose(shuffled.aps, metrics.aps, atol=1e-12)
    np.testing.assert_allclose(shuffled.errors, metrics.errors, atol=1e-12)
    # a larger matching distance finds no less
    assert (np.diff(metrics.aps, axis=1) >= -1e-12).all()


@pytest.mark.real
@pytest.mark.parametrize(("name", "max_range"), [("all_150m", 150.0), ("50m", 50.0)])
def test_every_number_of_the_original(shared: Path, name: str, max_range: float) -> None:
    pytest.importorskip("pyarrow", reason="needs pyarrow (extra formats)")
    (path,) = (shared / "data/argoverse2/sensor/val").glob("*/annotations.feather")
    truth = read_annotations(path, path.parent.name)
    found = read_submission(shared / "data/argoverse2/results/perturbed_labels.feather")
    assert (len(truth), len(found)) == (11364, 11020)
    metrics = evaluate_argoverse(truth, found, ArgoverseMetricsConfig(max_range_m=max_range)).to_json()
    golden = json.loads((shared / "golden/argoverse2/perturbed_labels.json").read_text())[name]
    assert len(golden) == 27
    for category, row in golden.items():
        for key, value in row.items():
            assert metrics[category][key] == pytest.approx(value, abs=1e-9), (category, key)

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.datasets.nuscenes_splits import scenes_of_split
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.evaluation.nuscenes import OFFICIAL, NuscenesMetrics, boxes_in_range, evaluate_nuscenes
from lcf3d.formats.nuscenes import read_submission
from lcf3d.formats.nuscenes_boxes import GlobalBoxes, empty_global
from lcf3d.structures import NUSCENES_CLASSES
from tests.datasets.nuscenes_world import annotation, world_tables, write_world


@pytest.fixture
def dataset(tmp_path: Path) -> NuscenesDataset:
    return NuscenesDataset(write_world(tmp_path), min_points=0)


def evaluate(dataset: NuscenesDataset, predictions: GlobalBoxes, **options: Any) -> NuscenesMetrics:
    return evaluate_nuscenes(dataset.tables, dataset.sample_rows, predictions, **options)


def as_predictions(truth: GlobalBoxes) -> GlobalBoxes:
    unknown = np.full(len(truth), -1)
    return replace(truth, scores=np.full(len(truth), 0.5), point_counts=unknown)


def test_ground_truth_against_itself(dataset: NuscenesDataset) -> None:
    metrics = evaluate(dataset, as_predictions(dataset.ground_truth()))
    car, pedestrian = NUSCENES_CLASSES.index("car"), NUSCENES_CLASSES.index("pedestrian")
    assert metrics.aps[car].tolist() == pytest.approx([1] * 4)
    np.testing.assert_allclose(metrics.class_errors[car], 0, atol=1e-12)
    # the pedestrian without points is no ground truth, its prediction a false one
    assert metrics.ground_truth_counts[pedestrian] == 1
    assert metrics.counts["ground_truth"].with_points == metrics.counts["predictions"].with_points - 1
    # the bicycle stands in the rack
    assert metrics.ground_truth_counts[NUSCENES_CLASSES.index("bicycle")] == 0
    assert metrics.counts["predictions"].outside_racks == metrics.counts["predictions"].with_points - 1


def test_a_bicycle_beside_the_rack_counts(tmp_path: Path) -> None:
    tables = world_tables()
    # the rack spans y from 39 to 41: it is 6 m long along global y, 2 m wide along x from 104.5 to 106.5
    tables["sample_annotation"].append(annotation("free", 0, "i-bicycle", [104.4, 40.0, 1.0]))
    tables["sample_annotation"].append(annotation("edge", 0, "i-bicycle", [104.5, 42.9, 1.75]))
    tables["sample_annotation"].append(annotation("above", 0, "i-bicycle", [105.0, 40.0, 1.8]))
    dataset = NuscenesDataset(write_world(tmp_path, tables))
    metrics = evaluate(dataset, as_predictions(dataset.ground_truth()))
    assert metrics.ground_truth_counts[NUSCENES_CLASSES.index("bicycle")] == 2


def test_ranges_are_measured_from_the_vehicle() -> None:
    ego = np.array([[100.0, 0, 0], [0, 0, 0]])
    boxes = replace(
        empty_global(("a", "b")),
        samples=np.array([0, 0, 1, 0, 0]),
        translations=np.array([[149.9, 0, 99], [150, 0, 0], [49.9, 0, 0], [140, 0, 0], [124, 18, 0]]),
        sizes=np.ones((5, 3)),
        rotations=np.ones((5, 4)),
        velocities=np.ones((5, 2)),
        labels=np.array([0, 0, 0, NUSCENES_CLASSES.index("pedestrian"), NUSCENES_CLASSES.index("barrier")]),
        scores=np.ones(5),
        attributes=np.zeros(5, dtype=np.int64),
        point_counts=np.ones(5, dtype=np.int64),
    )
    # the barrier's 24, 18, 30: not nearer than 30 m
    assert boxes_in_range(boxes, ego).tolist() == [True, False, True, False, False]


def test_scores_by_hand(dataset: NuscenesDataset) -> None:
    truth = dataset.ground_truth()
    cars = as_predictions(truth[truth.labels == 0])
    metrics = evaluate(dataset, cars)
    # one class of ten found, without errors; cones and barriers lack some errors
    assert metrics.mean_ap == pytest.approx(0.1)
    assert metrics.errors["trans_err"] == pytest.approx(0.9)
    assert metrics.errors["orient_err"] == pytest.approx(8 / 9)
    assert metrics.errors["vel_err"] == pytest.approx(7 / 8)
    assert metrics.errors["attr_err"] == pytest.approx(7 / 8)
    assert metrics.nd_score == pytest.approx((5 * 0.1 + 0.1 + 0.1 + 1 / 9 + 1 / 8 + 1 / 8) / 10)
    assert metrics.nds_hat == pytest.approx((3 * 0.1 + 0.1 + 0.1 + 1 / 9) / 6)


def test_front_view(dataset: NuscenesDataset) -> None:
    truth = dataset.ground_truth()
    metrics = evaluate(dataset, as_predictions(truth), camera="CAM_FRONT")
    # pedestrian at 10 m ahead and 5 m to the left, 10.4 m from the camera: pixel 800 - 481 is in the image
    assert metrics.counts["ground_truth"].in_view == 4
    behind = replace(as_predictions(truth), translations=truth.translations - [60.0, 0, 0])
    assert evaluate(dataset, behind, camera="CAM_FRONT").counts["predictions"].in_view == 0
    with pytest.raises(ConfigError, match="no camera 'left'"):
        evaluate(dataset, as_predictions(truth), camera="left")


def test_other_samples_are_refused(dataset: NuscenesDataset) -> None:
    with pytest.raises(FormatError, match="hold none of the 3 samples"):
        evaluate(dataset, empty_global(("x",)))
    with pytest.raises(FormatError, match="lack 1 of 3 samples, the first is s1"):
        evaluate(dataset, empty_global(("s0", "s2")))
    more = ("s0", "s1", "s2", "x")
    truth = as_predictions(dataset.ground_truth())
    with pytest.raises(FormatError, match="boxes of 1 samples that are not in this split, the first is x"):
        evaluate(dataset, truth[:1].in_samples(more, 3))
    # a run on a part of the samples lists the others without boxes
    assert evaluate(dataset, truth[:1].in_samples(more, 0)).counts["predictions"].original == 1


def test_tables_without_annotations(tmp_path: Path) -> None:
    dataset = NuscenesDataset(write_world(tmp_path, {**world_tables(), "sample_annotation": [], "instance": []}))
    with pytest.raises(DatasetError, match="holds no annotations"):
        evaluate(dataset, empty_global(dataset.ids))


def test_no_predictions(dataset: NuscenesDataset) -> None:
    metrics = evaluate(dataset, empty_global(dataset.ids))
    assert (metrics.mean_ap, metrics.nd_score, metrics.nds_hat) == (0, 0, 0)


def assert_agrees(found: Any, golden: Any, path: str = "") -> None:
    if isinstance(golden, dict):
        for key, value in golden.items():
            assert_agrees(found[key], value, f"{path}/{key}")
    elif isinstance(golden, float) and math.isnan(golden):
        assert math.isnan(found), path
    elif isinstance(golden, list) and golden and isinstance(golden[0], float):
        np.testing.assert_allclose(found, golden, atol=1e-12, rtol=0, err_msg=path)
    elif isinstance(golden, float):
        assert found == pytest.approx(golden, abs=1e-12), path
    else:
        assert found == golden, path


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "split"),
    [
        ("centerpoint", "mini_val"),
        ("pointpillars", "mini_val"),
        ("pointpillars_z_corrected", "mini_val"),
        ("perturbed_gt", "mini_val"),
        ("perturbed_gt_demo_frame", "mini_train"),
    ],
)
def test_every_number_of_the_devkit(shared: Path, name: str, split: str) -> None:
    dataset = NuscenesDataset(shared / "data/nuscenes", split=split)
    assert dataset.sample_rows.tolist() == dataset.tables.rows_of_scenes(scenes_of_split(split)).tolist()
    predictions, meta = read_submission(shared / f"data/nuscenes/results/{name}.json")
    metrics = evaluate(dataset, predictions, meta=meta)
    golden = json.loads((shared / f"golden/nuscenes_eval/{name}_metrics_summary.json").read_text())
    golden.pop("eval_time_median_of_3_s", None)
    lines = [int(line.rsplit(" ", 1)[1]) for line in golden.pop("filter_counts") if line.startswith("=>")]
    summary = json.loads(json.dumps(metrics.to_json()))
    assert_agrees(summary, golden)
    counts = [summary["filter_counts"][which] for which in ("predictions", "ground_truth")]
    keys = ("original", "in_range", "with_points", "outside_racks")
    assert [count[key] for count in counts for key in keys] == lines
    details = shared / f"golden/nuscenes_eval/{name}_metrics_details.json"
    if details.exists():
        assert_agrees(metrics.details_json(), json.loads(details.read_text()))


def test_the_official_numbers() -> None:
    assert list(OFFICIAL.class_range) == list(NUSCENES_CLASSES)
    assert OFFICIAL.dist_ths == (0.5, 1.0, 2.0, 4.0)

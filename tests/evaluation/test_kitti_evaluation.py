from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.evaluation.curves import precision_curve
from lcf3d.evaluation.kitti import (
    KittiEvaluationConfig,
    KittiEvaluator,
    Selection,
    evaluate,
    evaluate_folder,
    read_evaluator,
    result_folder,
    split_frame_ids,
)
from lcf3d.formats.kitti import KittiFrames, KittiObjects, format_objects, read_folder, read_frame_ids
from tests.evaluation.kitti_frames import dontcare, frames

CLASSES = ("Car", "Pedestrian", "Cyclist")


def many(n: int, **changes: object) -> list[list[dict[str, object]]]:
    """``n`` frames of one car each, scores falling from frame to frame."""
    return [[{"score": 1 - i / (2 * n), **changes}] for i in range(n)]


def test_ground_truth_against_itself_is_100() -> None:
    rows = [
        [
            {"name": name, "location": (4 * k, 1.5, 10 + i), "box": (150 * k, 0, 150 * k + 100, 50), "alpha": i / 10}
            for k, name in enumerate(CLASSES)
        ]
        + [dontcare((500, 0, 600, 100))]
        for i in range(41)
    ]
    results = [[row for row in frame if row["name"] != "DontCare"] for frame in rows]
    metrics = evaluate(frames(rows, False), frames(results, True))
    for name in CLASSES:
        for measure in ("bbox", "aos", "bev", "3d"):
            for difficulty in ("easy", "moderate", "hard"):
                assert metrics.ap(name, measure, difficulty) == 100
                assert metrics.ap(name, measure, difficulty, "R11") == 100
    assert metrics.class_names == CLASSES
    assert metrics.frame_count == 41


def test_average_precision_by_hand() -> None:
    # 40 objects; the 20 best-scored detections hit, the other 20 are elsewhere: hit k comes in with precision 1
    # at threshold k, so positions 0 to 19 have precision 1 and the rest is never reached
    truth = many(40)
    results = many(40)
    for i in range(20, 40):
        results[i][0]["box"] = (500, 0, 600, 50)
    metrics = evaluate(frames(truth, False), frames(results, True))
    assert metrics.curves["Car", "bbox", "easy"].precision.tolist() == [1.0] * 20 + [0.0] * 21
    assert metrics.ap("Car", "bbox", "easy") == pytest.approx(19 / 40 * 100)
    assert metrics.ap("Car", "bbox", "easy", "R11") == pytest.approx(5 / 11 * 100)  # positions 0, 4, 8, 12, 16


def test_false_detections_above_the_hits_halve_the_precision() -> None:
    truth = many(40)
    results = [[frame[0], {"box": (500, 0, 600, 50), "score": 2}] for frame in many(40)]
    curve = evaluate(frames(truth, False), frames(results, True)).curves["Car", "bbox", "moderate"]
    # with all 40 hits in, 40 of 80 are right, and precision only rises on the way there
    np.testing.assert_allclose(curve.precision[:40], 0.5)


def test_orientation_similarity_of_a_right_angle_is_one_half() -> None:
    metrics = evaluate(frames(many(41), False), frames(many(41, alpha=np.pi / 2), True))
    assert metrics.ap("Car", "bbox", "easy") == 100
    assert metrics.ap("Car", "aos", "easy") == pytest.approx(50)


def test_few_objects_cannot_reach_100_in_the_official_sampling() -> None:
    metrics = evaluate(frames(many(10), False), frames(many(10), True))
    assert metrics.ap("Car", "bbox", "easy") == pytest.approx(9 / 40 * 100)


def test_overlap_must_be_greater_than_the_threshold() -> None:
    # 100 x 50 against 100 x 35 inside: IoU is 0.7 exactly, which is not greater than 0.7
    truth, results = frames(many(41), False), frames(many(41, box=(0, 0, 100, 35)), True)
    assert evaluate(truth, results).ap("Car", "bbox", "moderate") == 0
    loose = KittiEvaluationConfig().with_min_overlap("Car", 0.69)
    assert evaluate(truth, results, loose).ap("Car", "bbox", "moderate") == 100


def test_iou_threshold_of_one_measure() -> None:
    config = KittiEvaluationConfig().with_min_overlap("Car", 0.5, "3d")
    assert config.min_overlap["Car"] == {"bbox": 0.7, "bev": 0.7, "3d": 0.5}
    assert config.min_overlap["Cyclist"]["3d"] == 0.5
    with pytest.raises(ConfigError, match="does not know class 'Bus'"):
        config.with_min_overlap("Bus", 0.5)
    with pytest.raises(ConfigError, match="measure 'aos'"):
        config.with_min_overlap("Car", 0.5, "aos")
    with pytest.raises(ConfigError, match=r"must be in \[0, 1\), got 1.5"):
        config.with_min_overlap("Car", 1.5)
    with pytest.raises(ConfigError, match="does not know class 'Tram'"):
        KittiEvaluationConfig(classes=("Tram",))


def test_only_what_the_results_cover_is_evaluated() -> None:
    flat = {"size": (-1, -1, -1), "location": (-1000, -1000, -1000), "alpha": -10}
    metrics = evaluate(frames(many(41), False), frames(many(41, **flat), True))
    assert {(name, measure) for name, measure, _ in metrics.curves} == {("Car", "bbox")}
    assert np.isnan(metrics.ap("Car", "3d"))
    assert np.isnan(metrics.ap("Cyclist", "bbox"))
    assert list(metrics.to_json()["Car"]) == ["bbox"]


def test_an_alpha_that_is_the_same_everywhere_is_no_orientation() -> None:
    truth = [[{"alpha": i / 41}] for i in range(41)]
    assert "aos" not in evaluate(frames(truth, False), frames(many(41), True)).measures("Car")
    # unless the objects have but one alpha too, or there are too few detections to tell
    assert "aos" in evaluate(frames(many(41), False), frames(many(41), True)).measures("Car")
    assert "aos" in evaluate(frames(truth[:40], False), frames(many(40), True)).measures("Car")


def test_class_names_ignore_case() -> None:
    metrics = evaluate(frames(many(41), False), frames(many(41, name="car"), True))
    assert metrics.ap("Car", "bbox", "easy") == 100


def test_distance_range_ignores_what_is_outside() -> None:
    truth, results = many(82), many(82)
    for rows in (truth, results):
        for i in range(41):
            rows[i][0]["location"] = (30, 1.5, 40)  # 50 m away
    for i in range(41):
        results[i][0]["rotation"] = np.pi / 2  # wrong in 3D, but only far away
    evaluator = KittiEvaluator(frames(truth, False), frames(results, True))

    def ap(near: float, far: float) -> float:
        curve, _ = precision_curve(evaluator.events(Selection("Car", "3d", "easy", (near, far))))
        assert curve.object_count == 41
        return curve.average_precision()

    assert ap(0, 20) == 100
    assert ap(50, 60) == 0


def test_frames_that_disagree_are_named() -> None:
    one, two = frames(many(2), False), frames(many(3), True)
    with pytest.raises(DatasetError, match=r"2 frames and results 3; .* 1 frames are in one only, first 2"):
        KittiEvaluator(one, two)


def test_bad_results_are_refused_in_one_sentence() -> None:
    truth = frames(many(2), False)
    with pytest.raises(FormatError, match=r"2 objects of class 'Tank' \(first in frame 0\)"):
        KittiEvaluator(truth, frames(many(2, name="Tank"), True))
    with pytest.raises(FormatError, match="have no scores"):
        KittiEvaluator(truth, frames(many(2), False))
    with pytest.raises(FormatError, match="2 scores are NaN, first in frame 0"):
        KittiEvaluator(truth, frames(many(2, score=np.nan), True))


def test_no_detections_and_no_frames() -> None:
    assert evaluate(frames(many(2), False), frames([[], []], True)).curves == {}
    empty = KittiFrames((), KittiObjects.empty(results=True), np.zeros(1, np.int64))
    assert evaluate(KittiFrames((), KittiObjects.empty(results=False), np.zeros(1, np.int64)), empty).curves == {}


def write_tree(root: Path, truth: KittiFrames) -> None:
    (root / "ImageSets").mkdir(parents=True)
    (root / "training" / "label_2").mkdir(parents=True)
    (root / "ImageSets" / "val.txt").write_text("\n".join(truth.frame_ids))
    for name, frame in zip(truth.frame_ids, truth, strict=True):
        (root / "training" / "label_2" / f"{name}.txt").write_text(format_objects(frame))


def test_evaluation_from_files(tmp_path: Path) -> None:
    write_tree(tmp_path, frames(many(41), False))
    data = tmp_path / "run" / "data"
    data.mkdir(parents=True)
    results = frames(many(41), True)
    for name, frame in zip(results.frame_ids, results, strict=True):
        (data / f"{name}.txt").write_text(format_objects(frame))
    # the folder itself, or the folder that holds it
    assert result_folder(data) == data
    for folder in (data, tmp_path / "run"):
        assert evaluate_folder(tmp_path, folder).ap("Car", "3d") == 100
    (data / "7.txt").unlink()
    with pytest.raises(DatasetError, match=r"lacks the files of 1 of 41 frames, first 7\.txt"):
        evaluate_folder(tmp_path, data)
    assert evaluate_folder(tmp_path, data, missing="empty").ap("Car", "3d") < 100
    with pytest.raises(DatasetError, match="is not a folder"):
        evaluate_folder(tmp_path, tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="no split 'test'; the lists in its ImageSets are: val"):
        evaluate_folder(tmp_path, data, split="test")
    (tmp_path / "ImageSets" / "val.txt").unlink()
    assert split_frame_ids(tmp_path) == tuple(sorted(map(str, range(41))))  # all that are labelled
    with pytest.raises(DatasetError, match="expected a KITTI tree"):
        evaluate_folder(tmp_path / "run", data)


GOLDEN = (
    ("kitti", "perturbed_labels"),
    ("kitti", "point_gnn"),
    ("kitti", "rcnn_2d"),
    ("kitti", "frustum_pointnets_2d"),
    ("kitti_tracking", "pointrcnn"),
    ("kitti_tracking", "rrc_2d"),
)


@pytest.mark.real
@pytest.mark.parametrize(("dataset", "name"), GOLDEN)
def test_golden_values_of_the_official_program(shared: Path, dataset: str, name: str) -> None:
    golden_name = name if dataset == "kitti" else f"tracking_{name}"
    golden = json.loads((shared / "golden" / "kitti_eval" / f"{golden_name}.json").read_text())
    root = shared / "data" / dataset
    ours = evaluate_folder(root, root / "results" / name).to_json()
    assert set(ours) == set(golden)
    compared = 0
    for class_name, measures in golden.items():
        assert set(ours[class_name]) == set(measures)
        for measure, difficulties in measures.items():
            for difficulty, expected in difficulties.items():
                got = ours[class_name][measure][difficulty]
                # the program prints six digits
                np.testing.assert_allclose(got["precision_41"], expected["precision_41"], atol=6e-7)
                np.testing.assert_allclose(got["AP_R11"], expected["AP_R11"], atol=5e-5)
                np.testing.assert_allclose(got["AP_R40"], expected["AP_R40"], atol=5e-5)
                compared += 1
    assert compared >= 3


@pytest.mark.real
def test_real_ground_truth_against_itself_is_100(shared: Path) -> None:
    root = shared / "data" / "kitti"
    frame_ids = read_frame_ids(root / "ImageSets" / "val.txt")
    truth = read_folder(root / "training" / "label_2", frame_ids, results=False)
    labels = truth.objects[truth.objects.class_names != "DontCare"]
    kept = truth.frame_of_object[truth.objects.class_names != "DontCare"]
    columns = [
        labels.class_names, labels.truncated, labels.occluded, labels.alpha, labels.boxes2d, labels.dimensions,
        labels.locations, labels.rotation_y, np.linspace(1, 0.5, len(labels)),
    ]  # fmt: skip
    starts = np.searchsorted(kept, np.arange(len(truth) + 1))
    metrics = evaluate(truth, KittiFrames(truth.frame_ids, KittiObjects(*columns), starts))
    assert {metrics.ap(*key, sampling) for key in metrics.curves for sampling in ("R11", "R40")} == {100.0}
    assert len(metrics.curves) == 36


@pytest.mark.real
def test_evaluator_from_real_files_counts_frames(shared: Path) -> None:
    root = shared / "data" / "kitti"
    assert len(read_evaluator(root, root / "results" / "point_gnn" / "data").truth) == 1912

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import ConfigError
from lcf3d.evaluation.generalization import evaluate_generalization, in_camera_view, nds_hat
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES, Camera, Detections3D

FORWARD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
CAMERA = Camera("left", np.array([[100.0, 0, 50, 0], [0, 100, 50, 0], [0, 0, 1, 0]]), FORWARD, 100, 100)


def detections(boxes: list[list[float]], labels: list[int], names: tuple[str, ...] = KITTI_CLASSES) -> Detections3D:
    return Detections3D(np.array(boxes, dtype=float).reshape(-1, 7), np.full(len(boxes), 0.5), np.array(labels), names)


CAR = [10.0, 0, 0, 4, 2, 1.5, 0]
WALKER = [20.0, 3, 0, 0.5, 0.5, 1.8, 1]


def test_the_equation() -> None:
    # (3 * 0.5 + (1 - 0.25) + (1 - 0.5) + 0) / 6
    assert nds_hat(0.5, (0.25, 0.5, 3.0)) == pytest.approx(2.75 / 6)


def test_ground_truth_against_itself() -> None:
    frames = [detections([CAR, WALKER], [0, 1]), detections([CAR], [2])]
    metrics = evaluate_generalization(frames, frames)
    assert metrics.nds_hat == pytest.approx(1)
    assert metrics.ground_truth_counts == (1, 1, 1)
    assert metrics.to_json()["label_aps"]["Car"]["0.5"] == pytest.approx(1)


def test_one_class_of_three_missed() -> None:
    truth = [detections([CAR, WALKER], [0, 1]), detections([CAR], [2])]
    found = [detections([CAR, WALKER], [0, 1]), detections([], [])]
    metrics = evaluate_generalization(truth, found)
    assert metrics.mean_ap == pytest.approx(2 / 3)
    assert metrics.errors == pytest.approx({"trans_err": 1 / 3, "scale_err": 1 / 3, "orient_err": 1 / 3})
    assert metrics.nds_hat == pytest.approx((3 * 2 / 3 + 3 * 2 / 3) / 6)
    assert evaluate_generalization(truth, found, class_names=("Car", "Pedestrian")).nds_hat == pytest.approx(1)


def test_classes_are_matched_by_name() -> None:
    truth = [detections([CAR, WALKER], [0, 1])]
    found = [detections([WALKER, CAR, CAR], [0, 1, 2], ("Pedestrian", "Car", "Tram"))]
    assert evaluate_generalization(truth, found, class_names=("Car", "Pedestrian")).nds_hat == pytest.approx(1)


def test_the_front_camera_sees_only_what_is_in_front_of_it() -> None:
    # one ahead, one behind, one 45 degrees aside: exactly on the image's right border (not in it), one just inside
    boxes = [CAR, [-10.0, *CAR[1:]], [10.0, -5, *CAR[2:]], [10.0, -4.99, *CAR[2:]]]
    frame = detections(boxes, [0] * 4)
    assert in_camera_view(frame, CAMERA).boxes[:, 1].tolist() == [0, -4.99]
    metrics = evaluate_generalization([frame], [frame], cameras=[CAMERA], class_names=["Car"])
    assert metrics.ground_truth_counts == (2,)


def test_class_ranges() -> None:
    near, far = [39.9, 0, *WALKER[2:]], [40.0, 0, *WALKER[2:]]
    frame = detections([near, far], [1, 1])
    assert evaluate_generalization([frame], [frame], class_names=["Pedestrian"]).ground_truth_counts == (1,)
    wide = evaluate_generalization([frame], [frame], class_names=["Pedestrian"], class_range={"Pedestrian": 50})
    assert wide.ground_truth_counts == (2,)


def test_nuscenes_rules_for_cones_and_barriers() -> None:
    cone, barrier = NUSCENES_CLASSES.index("traffic_cone"), NUSCENES_CLASSES.index("barrier")
    truth = [detections([CAR, CAR], [cone, barrier], NUSCENES_CLASSES)]
    turned = [detections([[*CAR[:6], -np.pi], [*CAR[:6], -np.pi]], [cone, barrier], NUSCENES_CLASSES)]
    metrics = evaluate_generalization(truth, turned, class_names=("traffic_cone", "barrier"))
    assert np.isnan(metrics.class_errors[0, 2])
    assert metrics.nds_hat == pytest.approx(1)


def test_bad_input() -> None:
    frame = detections([CAR], [0])
    with pytest.raises(ConfigError, match="got 1, 2 and no"):
        evaluate_generalization([frame], [frame, frame])
    with pytest.raises(ConfigError, match="at least one"):
        evaluate_generalization([], [])
    with pytest.raises(ConfigError, match="1 predictions have the score NaN"):
        evaluate_generalization([frame], [replace(frame, scores=np.array([np.nan]))])


@pytest.mark.real
def test_agrees_with_the_global_frame(shared: Path) -> None:
    """The same metrics from LiDAR-frame detections: ranges from the sensor and bicycle racks are all that differs."""
    from lcf3d.datasets.nuscenes import NuscenesDataset
    from lcf3d.evaluation.nuscenes import evaluate_nuscenes
    from lcf3d.formats.nuscenes import read_submission

    dataset = NuscenesDataset(shared / "data/nuscenes", split="mini_val")
    path = shared / "data/nuscenes/results/perturbed_gt.json"
    official = evaluate_nuscenes(dataset.tables, dataset.sample_rows, read_submission(path)[0])
    results = dataset.read_results(path)
    truth = [dataset.labels(token) for token in dataset.ids]
    ours = evaluate_generalization(truth, [results[token] for token in dataset.ids])
    assert ours.nds_hat == pytest.approx(official.nds_hat, abs=2e-3)


@pytest.mark.real
def test_kitti_labels_against_themselves(shared: Path) -> None:
    from lcf3d.datasets.kitti import KittiDataset

    dataset = KittiDataset(shared / "data/kitti", split="sensor_train")
    frames = list(dataset)
    truth = [frame.labels for frame in frames if frame.labels is not None]
    metrics = evaluate_generalization(truth, truth, cameras=[frame.camera("left") for frame in frames])
    assert metrics.aps[0].tolist() == pytest.approx([1] * 4)

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.errors import FormatError, ShapeError
from lcf3d.formats.nuscenes import read_submission, write_submission
from lcf3d.formats.nuscenes_boxes import (
    NUSCENES_ATTRIBUTES,
    GlobalBoxes,
    default_attributes,
    detections_from_global,
    empty_global,
    global_from_detections,
    split_by_sample,
)
from lcf3d.geometry.rotation import rigid_transforms, yaws_from_quaternions
from lcf3d.structures import NUSCENES_CLASSES, Detections3D


def box(**changes: Any) -> dict[str, Any]:
    record = {
        "sample_token": "s",
        "translation": [1.0, 2.0, 3.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.5, 0.0],
        "detection_name": "car",
        "detection_score": 0.5,
        "attribute_name": "vehicle.moving",
    }
    return {**record, **changes}


def write(path: Path, results: Any, **more: Any) -> Path:
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": results, **more}))
    return path


def test_a_submission_by_hand(tmp_path: Path) -> None:
    results = {
        "s": [box(), box(detection_name="barrier", attribute_name="", velocity=[float("nan"), 0], detection_score=1)],
        "empty": [],
        "t": [box(sample_token="t", translation=[7, 8, 9])],
    }
    boxes, meta = read_submission(write(tmp_path / "r.json", results, extra={"a": [1]}))
    assert meta == {"use_lidar": True}
    assert boxes.sample_tokens == ("s", "empty", "t")
    assert boxes.samples.tolist() == [0, 0, 2]
    assert boxes.translations.tolist() == [[1, 2, 3], [1, 2, 3], [7, 8, 9]]
    assert [NUSCENES_CLASSES[label] for label in boxes.labels] == ["car", "barrier", "car"]
    assert [NUSCENES_ATTRIBUTES[a] if a >= 0 else "" for a in boxes.attributes] == [
        "vehicle.moving",
        "",
        "vehicle.moving",
    ]
    assert np.isnan(boxes.velocities[1, 0])
    assert boxes.scores.tolist() == [0.5, 1, 0.5]
    assert boxes.point_counts.tolist() == [-1, -1, -1]


@pytest.mark.parametrize(
    ("results", "complaint"),
    [
        ({"s": [box()] * 501}, "sample s holds 501 boxes, at most 500"),
        ({"s": [box(detection_score=float("nan"))]}, "detection_score that is NaN"),
        ({"s": [box(translation=[1, 2, float("inf")])]}, "translation that is NaN or infinite"),
        ({"s": [box(detection_name="giraffe")]}, "unknown detection_name 'giraffe'"),
        ({"s": [box(attribute_name="vehicle.flying")]}, "unknown attribute_name 'vehicle.flying'"),
        ({"s": [box(detection_name=["car"])]}, "detection_name of a box of sample s must be text"),
        ({"s": [box(size=[1, 0, 1])]}, "size that is not positive"),
        ({"s": [box(rotation=[0, 0, 0, 0])]}, "rotation that is zero"),
        ({"s": [box(), box(size=[1, 2])]}, "size of a box of sample s must be 3 numbers"),
        ({"s": [box(detection_score=10**400)]}, "detection_score of a box of sample s must be a number"),
        ({"s": [box(detection_score="high")]}, "detection_score of a box of sample s must be a number"),
        ({"s": [{"sample_token": "s"}]}, "a box of sample s has no 'translation'"),
        ({"s": [box(sample_token="t")]}, "listed under sample s carries another sample's token"),
        ({"s": {"a": 1}}, "sample s must hold a list of boxes"),
        ({"s": [1, 2]}, "sample s must hold a list of boxes"),
        ([], "not a nuScenes submission"),
    ],
)
def test_bad_submissions(tmp_path: Path, results: Any, complaint: str) -> None:
    with pytest.raises(FormatError, match=complaint) as error:
        read_submission(write(tmp_path / "r.json", results))
    assert "r.json" in str(error.value)
    assert "\n" not in str(error.value)


def test_repeated_tokens_and_other_files(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    path.write_text('{"meta": {}, "results": {"s": [], "t": [], "s": []}}')
    with pytest.raises(FormatError, match="sample token s occurs twice"):
        read_submission(path)
    path.write_text('{"meta": {}}')
    with pytest.raises(FormatError, match="has no 'results'"):
        read_submission(path)
    path.write_text('{"results": {"s": [}')
    with pytest.raises(FormatError, match=r"r\.json:1:20: not a nuScenes submission"):
        read_submission(path)
    with pytest.raises(FormatError, match="does not exist"):
        read_submission(tmp_path / "none.json")
    with pytest.raises(FormatError, match="is a folder"):
        read_submission(tmp_path)


def test_writing_keeps_the_best_500_and_every_token(tmp_path: Path) -> None:
    n = 600
    scores = np.random.default_rng(0).permutation(n) / n
    boxes = some_boxes(n, scores)
    write_submission(tmp_path / "r.json", boxes)
    again, meta = read_submission(tmp_path / "r.json")
    assert again.sample_tokens == ("empty", "s")
    assert len(again) == 500
    np.testing.assert_array_equal(again.scores, np.sort(scores)[::-1][:500])
    assert meta["use_camera"]
    assert meta["use_lidar"]


def some_boxes(n: int, scores: np.ndarray) -> GlobalBoxes:
    return GlobalBoxes(
        ("empty", "s"),
        np.ones(n, dtype=np.int64),
        np.ones((n, 3)),
        np.ones((n, 3)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 2), np.nan),
        np.zeros(n, dtype=np.int64),
        scores,
        np.full(n, -1),
        np.full(n, -1),
    )


def test_writing_is_exact_and_refuses_what_is_not_finite(tmp_path: Path) -> None:
    results = {"s": [box(translation=[0.1, 1 / 3, -1e-17], detection_score=0.7), box(detection_score=0.2)], "t": []}
    first, meta = read_submission(write(tmp_path / "a.json", results))
    write_submission(tmp_path / "b.json", first, meta)
    assert json.loads((tmp_path / "b.json").read_text()) == json.loads((tmp_path / "a.json").read_text())
    with pytest.raises(FormatError, match="scores of a box of sample s hold NaN"):
        write_submission(tmp_path / "c.json", replace(first, scores=np.array([0.5, np.nan])))
    assert not (tmp_path / "c.json").exists()


def test_shapes_are_checked() -> None:
    boxes = some_boxes(2, np.zeros(2))
    with pytest.raises(ShapeError, match=r"rotations must have shape \(2, 4\), got \(2, 3\)"):
        replace(boxes, rotations=np.zeros((2, 3)))
    with pytest.raises(ShapeError, match=r"scores must have shape \(2,\)"):
        replace(boxes, scores=np.zeros(3))


angle = st.floats(-0.1, 0.1)


@given(st.lists(angle, min_size=3, max_size=3), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1), st.integers(0, 99))
def test_global_to_lidar_and_back_keeps_what_the_metrics_read(
    tilt: list[float], yaw: float, ego: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    quaternion = np.array([[np.cos(ego / 2), *(np.array(tilt) / 2)[:2], np.sin(ego / 2)]])
    global_from_lidar = rigid_transforms(quaternion, np.array([[600.0, 1600.0, 1.8]]))[0]
    boxes = replace(
        some_boxes(1, np.array([0.5])),
        translations=rng.uniform(-1000, 1000, (1, 3)),
        sizes=np.array([[1.0, 2.0, 3.0]]),
        rotations=np.array([[np.cos(yaw / 2), 0.01, -0.01, np.sin(yaw / 2)]]),
        velocities=rng.normal(size=(1, 2)),
        attributes=np.array([5]),
    )
    lidar = detections_from_global(split_by_sample(boxes)["s"], np.linalg.inv(global_from_lidar))
    np.testing.assert_array_equal(lidar.boxes[:, 3:6], [[2, 1, 3]])
    back = global_from_detections({"s": lidar}, {"s": global_from_lidar}, ("empty", "s"))
    assert back.sample_tokens == ("empty", "s")
    assert back.samples.tolist() == [1]
    np.testing.assert_allclose(back.translations, boxes.translations, atol=1e-8)
    np.testing.assert_array_equal(back.sizes, boxes.sizes)
    turned = yaws_from_quaternions(back.rotations) - yaws_from_quaternions(boxes.rotations)
    assert abs(np.angle(np.exp(1j * turned[0]))) < 1e-9
    np.testing.assert_allclose(back.velocities, boxes.velocities, atol=1e-9)
    np.testing.assert_array_equal(back.attributes, [5])


def test_other_classes_are_dropped_and_attributes_filled_in() -> None:
    found = Detections3D(
        np.tile([1.0, 2, 3, 4, 2, 1, 0], (3, 1)),
        np.array([0.9, 0.8, 0.7]),
        np.array([0, 1, 2]),
        ("pedestrian", "Tram", "car"),
        attributes=np.array(["pedestrian.standing", "", ""]),
    )
    boxes = global_from_detections({"s": found}, {"s": np.eye(4)})
    assert [NUSCENES_CLASSES[label] for label in boxes.labels] == ["pedestrian", "car"]
    assert [NUSCENES_ATTRIBUTES[a] for a in boxes.attributes] == ["pedestrian.standing", "vehicle.parked"]
    assert np.isnan(boxes.velocities).all()
    changed = Detections3D(
        found.boxes,
        found.scores,
        [5, 7, 8],
        NUSCENES_CLASSES,
        attributes=["vehicle.parked", "cycle.with_rider", "vehicle.moving"],
    )
    boxes = global_from_detections({"s": changed}, {"s": np.eye(4)})
    assert [NUSCENES_ATTRIBUTES[a] if a >= 0 else "" for a in boxes.attributes] == [
        "pedestrian.moving",
        "cycle.with_rider",
        "",
    ]
    with pytest.raises(FormatError, match="none of the classes Car, Van is a nuScenes class"):
        global_from_detections({"s": Detections3D.empty(("Car", "Van"))}, {"s": np.eye(4)})
    assert len(global_from_detections({}, {}, ("s",))) == len(empty_global(("s",))) == 0


@pytest.mark.parametrize(
    ("name", "unknown", "still", "moving"),
    [
        ("car", "vehicle.parked", "vehicle.parked", "vehicle.moving"),
        ("truck", "vehicle.parked", "vehicle.parked", "vehicle.moving"),
        ("trailer", "vehicle.parked", "vehicle.parked", "vehicle.moving"),
        ("construction_vehicle", "vehicle.parked", "vehicle.parked", "vehicle.moving"),
        ("bus", "vehicle.moving", "vehicle.stopped", "vehicle.moving"),
        ("pedestrian", "pedestrian.moving", "pedestrian.standing", "pedestrian.moving"),
        ("motorcycle", "cycle.without_rider", "cycle.without_rider", "cycle.with_rider"),
        ("bicycle", "cycle.without_rider", "cycle.without_rider", "cycle.with_rider"),
        ("traffic_cone", "", "", ""),
        ("barrier", "", "", ""),
    ],
)
def test_default_attributes(name: str, unknown: str, still: str, moving: str) -> None:
    labels = np.full(3, NUSCENES_CLASSES.index(name))
    found = default_attributes(labels, np.array([[np.nan, np.nan], [0.1, 0.1], [0.3, -0.4]]))
    assert [NUSCENES_ATTRIBUTES[a] if a >= 0 else "" for a in found] == [unknown, still, moving]

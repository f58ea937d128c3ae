"""nuScenes tracking submissions."""

import json

import numpy as np
import pytest

from lcf3d.errors import FormatError
from lcf3d.formats.nuscenes_tracking import write_tracking
from lcf3d.structures import NUSCENES_CLASSES, Detections3D

CAR, CONE = NUSCENES_CLASSES.index("car"), NUSCENES_CLASSES.index("traffic_cone")


def write(path, ids):
    boxes = [[10, 2, 0, 4, 1.8, 1.5, 0.0], [5, 0, 0, 0.4, 0.4, 1, 0], [20, 2, 0, 4, 1.8, 1.5, 0.0]]
    found = Detections3D(boxes, [0.5, 0.9, 0.8], [CAR, CONE, CAR], NUSCENES_CLASSES, velocities=np.full((3, 2), np.nan))
    pose = np.eye(4)
    pose[:3, 3] = 100, 200, 0
    write_tracking(path, {"a": found}, {"a": np.array(ids)}, {"a": "scene-7"}, {"a": pose}, ["a", "b"])
    return json.loads(path.read_text())["results"]


def test_tracked_classes_only_best_first_in_the_global_frame(tmp_path):
    results = write(tmp_path / "tracking.json", [3, 4, 5])
    assert results["b"] == []
    assert [box["tracking_id"] for box in results["a"]] == ["scene-7-5", "scene-7-3"]
    assert results["a"][0]["translation"] == pytest.approx([120, 202, 0])
    assert {box["tracking_name"] for box in results["a"]} == {"car"}
    assert results["a"][0]["velocity"] == [0, 0]


def test_fields_are_those_of_the_official_format(tmp_path):
    results = write(tmp_path / "tracking.json", [3, 4, 5])
    fields = {"sample_token": str, "translation": 3, "size": 3, "rotation": 4, "velocity": 2}
    fields |= {"tracking_id": str, "tracking_name": str, "tracking_score": float}
    for token, boxes in results.items():
        assert len({box["tracking_id"] for box in boxes}) == len(boxes)
        for box in boxes:
            assert box.keys() == fields.keys()
            assert box["sample_token"] == token
            assert all(isinstance(box[key], kind) for key, kind in fields.items() if isinstance(kind, type))
            lists = {key: kind for key, kind in fields.items() if isinstance(kind, int)}
            assert all(len(box[key]) == n and all(type(v) is float for v in box[key]) for key, n in lists.items())
    # width, length, height; w, x, y, z
    assert results["a"][0]["size"] == [1.8, 4, 1.5]
    assert results["a"][0]["rotation"] == pytest.approx([1, 0, 0, 0])
    meta = json.loads((tmp_path / "tracking.json").read_text())["meta"]
    assert meta.keys() == {"use_camera", "use_lidar", "use_radar", "use_map", "use_external"}


def test_ids_must_fit_the_boxes(tmp_path):
    with pytest.raises(FormatError, match="3 boxes but 2 track ids"):
        write(tmp_path / "tracking.json", [3, 4])

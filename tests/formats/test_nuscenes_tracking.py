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


def test_ids_must_fit_the_boxes(tmp_path):
    with pytest.raises(FormatError, match="3 boxes but 2 track ids"):
        write(tmp_path / "tracking.json", [3, 4])

"""Names of other tools in a dataset's own, and what falls out counted."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from lcf3d.detectors.classes import COCO_CLASSES, reported_classes
from lcf3d.detectors.joins import LeftOut, join_cameras, join_classes, require_pixels
from lcf3d.errors import DatasetError, FormatError
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES


@pytest.mark.parametrize(
    ("name", "class_names", "wanted"),
    [
        ("car", KITTI_CLASSES, "Car"),
        ("PERSON", KITTI_CLASSES, "Pedestrian"),
        ("Bicyclist", KITTI_CLASSES, "Cyclist"),
        ("Van", KITTI_CLASSES, None),
        ("bicycle", KITTI_CLASSES, None),
        ("vehicle.car", NUSCENES_CLASSES, "car"),
        ("human.pedestrian.adult", NUSCENES_CLASSES, "pedestrian"),
        ("movable_object.trafficcone", NUSCENES_CLASSES, "traffic_cone"),
        ("vehicle.bus.rigid", NUSCENES_CLASSES, "bus"),
        ("static_object.bicycle_rack", NUSCENES_CLASSES, None),
        ("vehicle.emergency.police", NUSCENES_CLASSES, None),
        ("Construction Vehicle", NUSCENES_CLASSES, "construction_vehicle"),
    ],
)
def test_class_names(name: str, class_names: tuple[str, ...], wanted: str | None) -> None:
    assert join_classes([name], class_names).get(name) == wanted


def test_camera_names() -> None:
    assert join_cameras(["cam_front", "CAM-BACK", "left"], ["CAM_FRONT", "CAM_BACK"]) == {
        "cam_front": "CAM_FRONT",
        "CAM-BACK": "CAM_BACK",
    }


def test_what_falls_out_is_counted_and_said() -> None:
    left_out = LeftOut("r.json", taken=3, classes=Counter({"Van": 2}), frames=Counter({f"f{i}": 1 for i in range(9)}))
    assert left_out.to_json()["classes"] == {"Van": 2}
    assert left_out.to_json()["frames"]["others"] == 4
    assert "left out 9 detections of frames" in " ".join(left_out.notes())
    left_out.require_some(KITTI_CLASSES)


def test_results_that_fit_nothing_are_refused() -> None:
    with pytest.raises(DatasetError, match="of cameras that are not of this run"):
        LeftOut("r.json", cameras=Counter({"CAM_X": 4})).require_some(KITTI_CLASSES, ["left"])
    with pytest.raises(DatasetError, match="expected Car, Pedestrian, Cyclist"):
        LeftOut("r.json", classes=Counter({"lorry": 4})).require_some(KITTI_CLASSES)
    LeftOut("r.json").require_some(KITTI_CLASSES)


def test_boxes_of_another_form_are_told() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 700, (50, 2))
    sides = rng.uniform(20, 150, (50, 2))
    right = np.c_[corners, corners + sides]
    require_pixels(right, "r.json", (1600, 900))
    require_pixels(np.zeros((0, 4)), "r.json", (1600, 900))
    with pytest.raises(FormatError, match="x, y, width, height"):
        # x, y, x2, y2 read as x, y, width, height
        require_pixels(np.c_[corners, corners + right[:, 2:]], "r.json", (1600, 900))
    with pytest.raises(FormatError, match="normalised"):
        require_pixels(right / 1600, "r.json", (1600, 900))


def test_reported_classes_follow_the_mapping_and_the_riders() -> None:
    assert reported_classes(COCO_CLASSES, KITTI_CLASSES) == ("Car", "Pedestrian", "Cyclist")
    reported = reported_classes(COCO_CLASSES, NUSCENES_CLASSES)
    assert "car" in reported
    assert not {"barrier", "traffic_cone", "trailer", "construction_vehicle"} & set(reported)

from __future__ import annotations

import numpy as np
import pytest

from lcf3d.detectors.classes import COCO_CLASSES, class_mapping, join_riders, to_classes
from lcf3d.structures import ARGOVERSE_CLASSES, KITTI_CLASSES, NUSCENES_CLASSES, Detections2D, InstanceMask

PERSON = ("person", 0.8, (10, 0, 30, 60))
BICYCLE = ("bicycle", 0.45, (0, 30, 40, 70))


def coco(*rows: tuple[str, float, tuple[float, ...]], masks: tuple[InstanceMask, ...] | None = None) -> Detections2D:
    return Detections2D(
        np.array([row[2] for row in rows], dtype=float).reshape(-1, 4),
        np.array([row[1] for row in rows]),
        np.array([COCO_CLASSES.index(row[0]) for row in rows], dtype=int),
        COCO_CLASSES,
        masks,
    )


def names_of(detections: Detections2D) -> list[str]:
    return [detections.class_names[label] for label in detections.labels]


def test_there_are_eighty_coco_classes() -> None:
    assert len(set(COCO_CLASSES)) == 80
    assert [COCO_CLASSES.index(n) for n in ("car", "truck", "traffic light", "sports ball", "toothbrush")] == [
        2,
        7,
        9,
        32,
        79,
    ]


def test_mappings_by_name() -> None:
    assert class_mapping(COCO_CLASSES, KITTI_CLASSES) == {"person": "Pedestrian", "car": "Car"}
    assert class_mapping(COCO_CLASSES, NUSCENES_CLASSES) == {
        "person": "pedestrian",
        "bicycle": "bicycle",
        "car": "car",
        "motorcycle": "motorcycle",
        "bus": "bus",
        "truck": "truck",
    }
    assert class_mapping(NUSCENES_CLASSES, KITTI_CLASSES) == {
        "car": "Car",
        "pedestrian": "Pedestrian",
        "bicycle": "Cyclist",
    }
    assert class_mapping((*KITTI_CLASSES, "Van"), NUSCENES_CLASSES) == {
        "Car": "car",
        "Pedestrian": "pedestrian",
        "Cyclist": "bicycle",
        "Van": "car",
    }


def test_the_names_of_argoverse() -> None:
    coco_names = class_mapping(COCO_CLASSES, ARGOVERSE_CLASSES)
    assert {name: coco_names[name] for name in ("person", "car", "truck", "bus", "stop sign", "dog", "bicycle")} == {
        "person": "PEDESTRIAN",
        "car": "REGULAR_VEHICLE",
        "truck": "TRUCK",
        "bus": "BUS",
        "stop sign": "STOP_SIGN",
        "dog": "DOG",
        "bicycle": "BICYCLE",
    }
    assert class_mapping(KITTI_CLASSES, ARGOVERSE_CLASSES)["Cyclist"] == "BICYCLIST"
    nuscenes = class_mapping(NUSCENES_CLASSES, ARGOVERSE_CLASSES)
    assert set(NUSCENES_CLASSES) - set(nuscenes) == {"construction_vehicle", "barrier"}
    back = class_mapping(ARGOVERSE_CLASSES, NUSCENES_CLASSES)
    assert (back["REGULAR_VEHICLE"], back["BOX_TRUCK"], back["VEHICULAR_TRAILER"]) == ("car", "truck", "trailer")


def test_a_rider_and_a_bicycle_become_one_cyclist() -> None:
    # 20 x 30 of 1200 and 1600 pixels are shared: half of the smaller box
    found = to_classes(coco(PERSON, BICYCLE), KITTI_CLASSES)
    assert names_of(found) == ["Cyclist"]
    assert found.boxes.tolist() == [[0, 0, 40, 70]]
    assert found.scores.tolist() == [pytest.approx(0.6)]


def test_nuscenes_puts_the_rider_into_the_box_of_the_mount() -> None:
    motorcycle = ("motorcycle", 0.45, BICYCLE[2])
    for mount, name in ((BICYCLE, "bicycle"), (motorcycle, "motorcycle")):
        found = to_classes(coco(PERSON, mount), NUSCENES_CLASSES)
        assert names_of(found) == [name]
        assert found.boxes.tolist() == [[0, 0, 40, 70]]
    assert names_of(to_classes(coco(PERSON, motorcycle), KITTI_CLASSES)) == ["Cyclist"]


@pytest.mark.parametrize(
    ("person", "bicycle", "expected"),
    [
        (("person", 0.8, (30, 0, 54, 60)), BICYCLE, "Pedestrian"),  # beside it: the centre is outside
        (("person", 0.8, (10, 0, 30, 80)), BICYCLE, "Pedestrian"),  # in front of it: 10 of 80 rows below the wheels
        (("person", 0.8, (10, 0, 30, 77)), BICYCLE, "Cyclist"),  # 7 of 77 rows are less than a tenth
        (("person", 0.8, (10, 30, 30, 60)), BICYCLE, "Pedestrian"),  # does not rise above it
        (PERSON, ("bicycle", 0.39, BICYCLE[2]), "Pedestrian"),  # not sure enough against 0.8
        (PERSON, ("bicycle", 0.4, BICYCLE[2]), "Cyclist"),
    ],
)
def test_the_limits_of_the_rule(
    person: tuple[str, float, tuple[float, ...]], bicycle: tuple[str, float, tuple[float, ...]], expected: str
) -> None:
    assert names_of(to_classes(coco(person, bicycle), KITTI_CLASSES)) == [expected]


def test_too_little_overlap_is_no_ride() -> None:
    # the person covers 800 pixels: 10 shared rows of 20 are the limit of a quarter
    for rows, expected in ((10, ["Cyclist"]), (9, ["Pedestrian"])):
        person = ("person", 0.8, (10, 30 + rows - 40, 30, 30 + rows))
        assert names_of(to_classes(coco(person, BICYCLE), KITTI_CLASSES)) == expected


def test_every_person_and_bicycle_is_used_once() -> None:
    passenger = ("person", 0.7, (12, 0, 32, 60))
    found = to_classes(coco(passenger, BICYCLE, PERSON, ("car", 0.9, (200, 0, 300, 60))), KITTI_CLASSES)
    assert names_of(found) == ["Cyclist", "Pedestrian", "Car"]
    assert found.scores.tolist() == pytest.approx([0.6, 0.7, 0.9])


def test_riders_keep_both_masks() -> None:
    masks = (
        InstanceMask(10, 0, np.ones((2, 2), dtype=bool)),
        InstanceMask(11, 1, np.ones((2, 3), dtype=bool)),
    )
    found = join_riders(coco(PERSON, BICYCLE, masks=masks))
    assert found.masks is not None
    joined = found.masks[0]
    assert joined is not None
    assert (joined.x, joined.y) == (10, 0)
    assert joined.bitmap.astype(int).tolist() == [[1, 1, 0, 0], [1, 1, 1, 1], [0, 1, 1, 1]]


def test_a_bicycle_alone_is_nothing_to_kitti() -> None:
    assert len(to_classes(coco(BICYCLE), KITTI_CLASSES)) == 0
    assert names_of(to_classes(coco(BICYCLE), NUSCENES_CLASSES)) == ["bicycle"]
    assert len(to_classes(coco(), KITTI_CLASSES)) == 0


def test_own_mapping_wins() -> None:
    truck = ("truck", 0.9, (0, 0, 10, 10))
    assert len(to_classes(coco(truck), KITTI_CLASSES)) == 0
    assert names_of(to_classes(coco(truck), KITTI_CLASSES, {"truck": "Car"})) == ["Car"]
    assert len(to_classes(coco(PERSON), KITTI_CLASSES, {"person": ""})) == 0

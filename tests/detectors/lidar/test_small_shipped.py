"""The network in the wheel finds what stands on the demo's street, without torch."""

from __future__ import annotations

import numpy as np
import pytest

from lcf3d.datasets.drive import read_drive
from lcf3d.detectors.lidar.kinds import shipped
from lcf3d.structures import KITTI_CLASSES

(FRAME,) = read_drive(count=1)


def test_cars_of_the_drive_are_found():
    found = shipped("kitti", nms="keep", score_threshold=0.3, threads=1)(FRAME.points)
    objects = FRAME.objects
    cars = objects.boxes[(objects.class_names == "Car") & (objects.occluded == 0)]
    cars = cars[np.hypot(cars[:, 0], cars[:, 1]) < 30]
    assert len(cars) > 0
    boxes = found.boxes[found.labels == KITTI_CLASSES.index("Car")]
    distance = np.hypot(*(cars[:, None, :2] - boxes[None, :, :2]).transpose(2, 0, 1))
    assert (distance.min(axis=1) < 0.6).mean() >= 0.7


def test_without_suppression_things_have_several_boxes():
    many, few = (shipped("kitti", nms=nms, threads=1)(FRAME.points) for nms in ("off", "keep"))
    assert 2 * len(few) < len(many) <= 250


@pytest.mark.parametrize("points", [np.zeros((0, 4)), np.full((9, 4), np.nan), np.full((9, 5), 300.0)])
def test_clouds_with_nothing_in_range(points):
    found = shipped("kitti", class_names=("Pedestrian",), threads=1)(points.astype(np.float32))
    assert len(found) == 0
    assert found.class_names == ("Pedestrian",)

import subprocess
import sys

import numpy as np
import pytest

from lcf3d.datasets.drive import read_drive
from lcf3d.detectors.camera.small import MODELS, SHIPPED, shipped
from lcf3d.errors import ConfigError
from lcf3d.geometry.iou import image_iou
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES


def test_every_file_has_its_model_card_and_is_small() -> None:
    for name in SHIPPED.values():
        assert (MODELS / name).stat().st_size < 6_000_000
        assert "Apache-2.0" in (MODELS / name).with_suffix(".md").read_text(encoding="utf-8")


def test_cars_of_the_demo_drive_are_found_with_their_masks() -> None:
    frames = read_drive(count=3)
    detector = shipped("kitti", score_threshold=0.5, threads=1)
    right = total = 0
    for frame, found in zip(frames, detector([f.image for f in frames]), strict=True):
        assert found.class_names == KITTI_CLASSES
        assert found.masks is not None
        assert all(mask is not None and mask.bitmap.any() for mask in found.masks)
        truth = frame.objects
        clear = (truth.occluded == 0) & np.isin(truth.class_names, ("Car", "Van")) & (truth.truncated < 0.3)
        boxes = truth.boxes2d[clear & (truth.boxes2d[:, 3] - truth.boxes2d[:, 1] > 40)]
        total += len(boxes)
        if len(found) and len(boxes):
            right += int((image_iou(boxes, found.boxes[found.labels == 0]).max(axis=1) > 0.5).sum())
    assert total > 0
    assert right >= 0.8 * total


def test_classes_of_nuscenes_are_mapped_by_name() -> None:
    (found,) = shipped("kitti", NUSCENES_CLASSES, threads=1)([read_drive(count=1)[0].image])
    assert found.class_names == NUSCENES_CLASSES
    assert "car" in {NUSCENES_CLASSES[label] for label in found.labels}


def test_an_unknown_name_is_refused_with_those_that_exist() -> None:
    with pytest.raises(ConfigError, match=r"no camera detector 'paris' comes with lcf3d; it ships: kitti"):
        shipped("paris")


def test_torch_is_not_needed() -> None:
    code = (
        "import sys; sys.modules['torch'] = None; import numpy as np; from lcf3d.detectors.camera.small import shipped;"
        "shipped('kitti', threads=1)([np.zeros((375, 1242, 3), np.uint8)])"
    )
    subprocess.run([sys.executable, "-c", code], check=True)

from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from lcf3d.errors import DatasetError, FormatError
from lcf3d.training.camera_images import IGNORED, class_counts, drive_images, from_sample, read_kitti, read_samples
from tests.training.camera_pictures import picture, sample

LABELS = """Car 0.00 0 -1.57 20.00 30.00 60.00 50.00 1.5 1.6 3.9 1.0 1.6 20.0 -1.57
Truck 0.00 0 -1.57 70.00 10.00 90.00 50.00 3.5 2.6 8.9 9.0 1.6 30.0 -1.57
Pedestrian 0.00 3 -1.57 100.00 30.00 110.00 50.00 1.8 0.6 0.6 9.0 1.6 30.0 -1.57
DontCare -1 -1 -10 0.00 30.00 10.00 40.00 -1 -1 -1 -1000 -1000 -1000 -10
"""
CALIBRATION = """P2: 100 0 64 0 0 100 32 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""


def test_vans_are_cars_trucks_are_background_and_sitting_persons_are_ignored() -> None:
    names = ["Car", "Van", "Truck", "Person_sitting", "Cyclist"]
    image = from_sample(sample([(name, (10 * i, 5, 10 * i + 8, 40)) for i, name in enumerate(names)]))
    assert image.labels.tolist() == [0, 0, IGNORED, 2]
    # numbers still name the right pixels though the truck is left out
    assert image.numbers.tolist() == [1, 2, 4, 5]
    assert image.owner is not None
    assert image.owner[20, 42] == image.numbers[3]


def test_almost_hidden_objects_are_ignored() -> None:
    image = from_sample(sample([("Car", (0, 0, 20, 20)), ("Car", (30, 0, 50, 20))], hidden=[0.95, 0.5]))
    assert image.labels.tolist() == [IGNORED, 0]


def test_counts_leave_out_what_is_ignored() -> None:
    images = [picture([("Car", (0, 0, 20, 20)), ("Person_sitting", (30, 0, 50, 20))]), picture([])]
    assert class_counts(images) == {"Car": 1, "Pedestrian": 0, "Cyclist": 0}
    assert class_counts([]) == {"Car": 0, "Pedestrian": 0, "Cyclist": 0}


def test_a_file_that_is_no_sample_is_named(tmp_path: Path) -> None:
    (tmp_path / "000000.npz").write_bytes(b"torn")
    with pytest.raises(FormatError, match=r"000000\.npz is no training sample"):
        read_samples([tmp_path / "000000.npz"])


def kitti_folder(root: Path, image: PIL.Image.Image) -> Path:
    for name in ("image_2", "label_2", "calib"):
        (root / "training" / name).mkdir(parents=True)
    image.save(root / "training" / "image_2" / "000000.png")
    (root / "training" / "label_2" / "000000.txt").write_text(LABELS)
    (root / "training" / "calib" / "000000.txt").write_text(CALIBRATION)
    (root / "training" / "calib" / "000001.txt").write_text(CALIBRATION)
    return root


def test_kitti_images_are_shrunk_with_their_boxes(tmp_path: Path) -> None:
    root = kitti_folder(tmp_path, PIL.Image.new("RGB", (128, 64)))
    (image,) = read_kitti(root, None, (32, 128))
    assert image.image.shape == (32, 64, 3)
    np.testing.assert_allclose(image.boxes[0], [10, 15, 30, 25])
    # the car, the pedestrian of unknown occlusion, the area not to care about; no truck
    assert image.labels.tolist() == [0, IGNORED, IGNORED]
    assert image.owner is None


def test_grey_kitti_images_become_rgb(tmp_path: Path) -> None:
    (image,) = read_kitti(kitti_folder(tmp_path, PIL.Image.new("L", (128, 64))), None, (256, 832))
    assert image.image.shape == (64, 128, 3)


def test_a_folder_without_images_is_refused(tmp_path: Path) -> None:
    root = kitti_folder(tmp_path, PIL.Image.new("RGB", (128, 64)))
    (root / "training" / "image_2" / "000000.png").unlink()
    with pytest.raises(DatasetError, match="has both an image in image_2 and labels"):
        read_kitti(root, None, (256, 832))


def test_the_demo_drive_has_boxes_in_its_images() -> None:
    images = drive_images()
    assert len(images) == 20
    assert class_counts(images)["Car"] > 50
    for image in images:
        height, width = image.image.shape[:2]
        assert (image.boxes >= 0).all()
        assert (image.boxes[:, 2:] <= [width, height]).all()
        # what is seen of an object lies within its whole box, but for rounding to pixels
        assert (image.visible[:, :2] > image.boxes[:, :2] - 2).all()

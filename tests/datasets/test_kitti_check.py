import numpy as np
import pytest

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_check import RULES, check_kitti
from tests.datasets.kitti_folder import calibration_text, make_kitti, make_results


@pytest.fixture
def root(tmp_path):
    return make_kitti(tmp_path / "kitti")


def rules(root, results=None):
    return sorted({f.id for f in check_kitti(KittiDataset(root, "val"), results)})


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def break_nothing(root):
    pass


def drop_calibration(root):
    (root / "training/calib/000001.txt").unlink()


def spoil_image(root):
    (root / "training/image_2/000001.png").write_bytes(b"x")


def cut_scan(root):
    path = root / "training/velodyne/000001.bin"
    path.write_bytes(path.read_bytes()[:-3])


def spoil_label(root):
    (root / "training/label_2/000001.txt").write_text("Car 0 0\n")


def unknown_class(root):
    edit(root / "training/label_2/000001.txt", "Pedestrian", "Dog")


def other_camera(root):
    text = calibration_text().replace(f"{609.5593:.12e}", f"{409.5593:.12e}")
    (root / "training/calib/000001.txt").write_text(text)


def shifted_scan(root):
    path = root / "training/velodyne/000001.bin"
    points = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 4) + np.array([0, 30, 0, 0], "<f4")
    path.write_bytes(points.astype("<f4").tobytes())


def no_scan(root):
    (root / "training/velodyne/000001.bin").unlink()


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (break_nothing, []),
        (drop_calibration, ["KIT01"]),
        (spoil_image, ["KIT02"]),
        (cut_scan, ["KIT03"]),
        (spoil_label, ["KIT04"]),
        (unknown_class, ["KIT05"]),
        (other_camera, ["KIT06"]),
        (shifted_scan, ["KIT07"]),
        (no_scan, ["KIT08"]),
    ],
)
def test_each_fault_breaks_its_rule(root, damage, expected):
    damage(root)
    assert rules(root) == expected
    assert set(expected) <= set(RULES)


def test_images_of_a_pair_that_differ_in_size(root):
    from PIL import Image

    folder = root / "training" / "image_3"
    folder.mkdir()
    Image.new("RGB", (1224, 370)).save(folder / "000000.png")
    assert rules(root) == ["KIT09"]


def test_result_folders(root, tmp_path):
    lidar, _ = make_results(tmp_path)
    assert rules(root, lidar) == []
    edit(lidar / "000000.txt", " 0.9\n", " 9\n")
    (lidar / "000001.txt").unlink()
    (lidar / "night_7.txt").write_text("Car\n")
    assert rules(root, lidar) == ["KIT10", "KIT11", "KIT12"]


@pytest.mark.real
@pytest.mark.parametrize("split", ["sensor_val", "stereo"])
def test_real_frames_hold_every_rule(shared, split):
    assert check_kitti(KittiDataset(shared / "data" / "kitti", split)) == []

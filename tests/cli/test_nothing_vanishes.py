"""Small KITTI folders as people have them: nothing falls out without a word, or is taken for what it is not."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from lcf3d.api import evaluate, run
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_calibration import read_calibration
from lcf3d.datasets.opening import check_dataset
from lcf3d.errors import DatasetError, FormatError
from tests.datasets.kitti_folder import calibration_text, make_kitti, make_results


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    make_kitti(tmp_path / "kitti")
    make_results(tmp_path)
    return tmp_path


def rewrite(folder: Path, old: str, new: str) -> None:
    for path in folder.glob("*.txt"):
        path.write_text(re.sub(old, new, path.read_text(), flags=re.M))


def outputs(tmp_path: Path) -> dict[str, dict[str, int]]:
    counts = run(
        f"kitti:{tmp_path / 'kitti'}",
        f"results:{tmp_path / 'lidar'}",
        f"results:{tmp_path / 'camera'}",
        tmp_path / "out",
        overwrite=True,
        recovery="off",
    )
    found: dict[str, dict[str, int]] = counts["outputs"]
    return found


def test_names_in_another_case_and_byte_order_marks_change_nothing(kitti: Path) -> None:
    right = outputs(kitti)
    rewrite(kitti / "lidar", "^Car", "car")
    rewrite(kitti / "camera", "^Pedestrian", "PERSON")
    for path in [*(kitti / "lidar").glob("*.txt"), *(kitti / "kitti" / "training" / "calib").glob("*.txt")]:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    (kitti / "lidar" / "._000000.txt").write_bytes(b"\0\5\x16\7")
    (kitti / "kitti" / "training" / "calib" / "._000000.txt").write_bytes(b"\0\5\x16\7")
    assert outputs(kitti) == right


def test_other_classes_are_counted_and_nothing_but_them_is_an_error(kitti: Path) -> None:
    file = kitti / "lidar" / "000000.txt"
    file.write_text(file.read_text().replace("Car", "Giraffe"))
    outputs(kitti)
    noted = json.loads((kitti / "out" / "run.json").read_text())
    assert noted["left_out"] == {"lidar": {"classes": {"Giraffe": 2}}}
    assert "left out 2 detections of classes" in noted["notes"][0]
    (finding,) = [f for f in check_dataset(f"kitti:{kitti / 'kitti'}", kitti / "lidar") if f.id == "KIT13"]
    assert "Giraffe 2" in finding.message
    rewrite(kitti / "lidar", "^Car", "Giraffe")
    with pytest.raises(DatasetError, match=r"Giraffe.*expected Car, Pedestrian, Cyclist"):
        outputs(kitti)


def test_results_of_nowhere_are_an_error_of_check(kitti: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        check_dataset(f"kitti:{kitti / 'kitti'}", kitti / "nowhere")


def test_an_unknown_camera_without_images_is_asked_for_its_size(kitti: Path) -> None:
    training = kitti / "kitti" / "training"
    for image in (training / "image_2").glob("*.png"):
        image.unlink()
    text = calibration_text().replace(f"{609.5593:.12e}", f"{961.0:.12e}").replace(f"{721.5377:.12e}", f"{1900.0:.12e}")
    for path in (training / "calib").glob("*.txt"):
        path.write_text("calib_time: 09-Jan-2012 13:57:47\n" + text)
    with pytest.raises(FormatError, match="say the size as"):
        KittiDataset(kitti / "kitti")[0]
    camera = KittiDataset(kitti / "kitti", image_size="1936x1216")[0].cameras[0]
    assert (camera.width, camera.height) == (1936, 1216)


def test_splits_of_the_test_server_are_read_where_they_lie(kitti: Path) -> None:
    root = kitti / "kitti"
    make_kitti(kitti / "other")
    (kitti / "other" / "training").rename(root / "testing")
    scan = root / "testing" / "velodyne" / "000000.bin"
    np.fromfile(scan, "<f4")[:400].tofile(scan)
    (root / "ImageSets" / "test.txt").write_text("000000\n")
    assert len(KittiDataset(root, "test")[0].points) == 100
    assert len(KittiDataset(root, "val")[0].points) > 100


def test_a_projection_of_zeros_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(re.sub("^P2: .*$", "P2: " + "0 " * 12, calibration_text(), flags=re.M))
    with pytest.raises(FormatError, match="P2 has no focal length"):
        read_calibration(tmp_path / "a.txt")


def test_why_nothing_counts(kitti: Path) -> None:
    rewrite(kitti / "lidar", r"^(\S+ \S+ \S+ \S+) \S+ \S+ \S+ \S+", r"\1 0 0 0 0")
    (table, *_) = evaluate(f"kitti:{kitti / 'kitti'}", kitti / "lidar").tables()
    assert any("no detection has a 2D box" in note for note in table.notes)

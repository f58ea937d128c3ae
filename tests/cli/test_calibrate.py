import json

import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.errors import Lcf3dError
from lcf3d.fusion.calibration import Calibration
from tests.evaluation.drive import write_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    lidar, camera = write_drive(root, 24)
    return root, f"results:{lidar}", f"results:{camera}"


def lcf3d(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def test_calibrate_writes_a_file_and_prints_what_it_brings(drive, tmp_path):
    root, lidar, camera = drive
    command = ("calibrate", f"kitti:{root}", "--lidar", lidar, "--camera", camera, "--out", tmp_path / "c.json")
    text = lcf3d(*command, "--folds", 3).stdout
    assert "cross-validated, 3 folds" in text
    assert "the camera never detects Cyclist" in text
    calibration = Calibration.load(tmp_path / "c.json")
    assert calibration.camera_classes == ("Car",)
    assert "24 frames, results:" in calibration.source
    values = json.loads(lcf3d(*command, "--folds", 3, "--json").stdout)
    assert [c["class_name"] for c in values["classes"]] == ["Car", "Cyclist"]
    assert values["classes"][0]["after"][1] > values["classes"][0]["before"][1]
    assert Calibration.load(tmp_path / "c.json") == calibration


def test_folds_0_leaves_the_report_out(drive, tmp_path):
    root, lidar, camera = drive
    out = tmp_path / "c.json"
    text = lcf3d("calibrate", root, "--lidar", lidar, "--camera", camera, "--out", out, "--folds", 0).stdout
    assert "cross-validated" not in text
    assert Calibration.load(out).evidence["Car"].support[-1] > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"--lidar": "onnx:x"}, "unknown LiDAR detector kind 'onnx'"),
        ({"--camera": "results:/nowhere"}, "lacks the files|not a folder|does not exist"),
        ({"--folds": "1"}, "2 folds or more"),
        ({"--folds": "99"}, "24 frames for 99 folds"),
        ({"--split": "night"}, "night"),
        ({"--missing": "maybe"}, "error or empty"),
        ({"--config": "nowhere"}, "neither a preset"),
    ],
)
def test_bad_input_is_one_sentence(drive, tmp_path, changes, message):
    root, lidar, camera = drive
    options = {"--lidar": lidar, "--camera": camera, "--out": str(tmp_path / "c.json"), **changes}
    with pytest.raises(Lcf3dError, match=message):
        lcf3d("calibrate", f"kitti:{root}", *(part for pair in options.items() for part in pair))
    assert not (tmp_path / "c.json").exists()


def test_ablate_prints_one_table_and_json(drive, tmp_path):
    root, lidar, camera = drive
    command = ("ablate", f"kitti:{root}", "--lidar", lidar, "--camera", camera)
    text = lcf3d(*command).stdout
    assert "matching + semantic" in text
    assert "rows with detection recovery are left out" in text
    values = json.loads(lcf3d(*command, "--json").stdout)
    assert values["scans"] is False
    assert {row["group"] for row in values["rows"]} >= {"clustering", "unmatched clusters", "ensemble"}
    lcf3d("calibrate", root, "--lidar", lidar, "--camera", camera, "--out", tmp_path / "c.json", "--folds", 0)
    fitted = json.loads(lcf3d(*command, "--json", "--calibration", tmp_path / "c.json").stdout)
    assert [row["name"] for row in fitted["rows"]] == [row["name"] for row in values["rows"]]
    with pytest.raises(Lcf3dError, match="lcf3d calibrate"):
        lcf3d(*command, "--calibration", "none")  # logits


def test_ablate_with_scans_has_rows_with_recovery(tmp_path):
    lidar, camera = write_drive(tmp_path / "drive", 2, scans=True)
    command = ("ablate", tmp_path / "drive", "--lidar", f"results:{lidar}", "--camera", f"results:{camera}")
    text = lcf3d(*command).stdout
    assert "matching + recovery + semantic" in text
    assert "left out" not in text

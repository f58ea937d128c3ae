"""Rows measured on a made-up KITTI drive with result files in place of networks, and with weights filled by rule."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.errors import ConfigError, FormatError
from lcf3d.paper.kept import Kept
from lcf3d.paper.measure import measure_row
from lcf3d.paper.networks import NeedsError
from lcf3d.paper.tables import find_row, find_table
from lcf3d.paper.workplace import Workplace
from lcf3d.structures import Detections2D, Detections3D, InstanceMask
from tests.evaluation.drive import write_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    lidar, camera = write_drive(root, 20, scans=True)
    for path in lidar.glob("*.txt"):
        # scores of the paper's detectors are probabilities
        lines = [line.split() for line in path.read_text().splitlines()]
        path.write_text("".join(" ".join([*f[:15], f"{1 / (1 + np.exp(-float(f[15]))):.4f}"]) + "\n" for f in lines))
    return root, lidar, camera


def place(tmp_path, drive, **more):
    root, lidar, camera = drive
    uses = {
        "pointpillars-kitti": f"results:{lidar}",
        "fasterrcnn-r101-kitti": f"results:{camera}",
        "frustum-pointnet-kitti": "geometric",
    }
    return Workplace(tmp_path, {"kitti": root}, uses, **more)


def test_fusion_removes_the_ghosts_of_the_lidar_branch(tmp_path, drive):
    table = find_table("table-1")
    alone = measure_row(table, find_row(table, "PointPillars"), place(tmp_path, drive))
    fused = measure_row(table, find_row(table, "PointPillars + Faster R-CNN, single"), place(tmp_path, drive))
    moderate = table.columns.index("Car moderate")
    assert alone.frames == fused.frames == 20
    assert alone.values[moderate] < 90 < fused.values[moderate]
    # the camera sees no cyclists, and the paper's filter drops what it does not confirm
    assert fused.values[table.columns.index("Cyclist moderate")] == 0
    assert any("has 20 frames" in note for note in fused.notes)
    assert any(note.endswith("for fasterrcnn-r101-kitti") for note in fused.notes)


def test_an_interrupted_run_goes_on_and_one_with_other_inputs_is_refused(tmp_path, drive):
    table = find_table("table-4")
    row = find_row(table, "matching + semantic fusion")
    begun = []
    here = place(tmp_path, drive, begin=lambda name, frames: begun.append(frames) or (lambda: None))
    first = measure_row(table, row, here)
    (run,) = (tmp_path / "runs").iterdir()
    (run / "provenance" / "000003.json").unlink()
    assert measure_row(table, row, here).values[:3] == first.values[:3]
    assert begun == [20, 1]
    other = Workplace(tmp_path, here.roots, {**here.uses, "fasterrcnn-r101-kitti": f"results:{drive[1]}"})
    with pytest.raises(ConfigError, match="other settings or inputs"):
        measure_row(table, row, other)


def test_a_pure_cascade_uses_no_lidar_detections(tmp_path, drive):
    table = find_table("table-4")
    measure_row(table, find_row(table, "recovery"), place(tmp_path, drive))
    (run,) = (tmp_path / "runs").iterdir()
    outcomes = json.loads((run / "provenance" / "000000.json").read_text())
    assert len(outcomes["lidar_inputs"]["scores"]) == 7
    # twenty points at the origin lie in no frustum, so nothing comes out
    assert outcomes["detections"]["scores"] == []


def test_result_files_fill_the_row_of_a_quoted_system(tmp_path, drive):
    table = find_table("table-2")
    row = find_row(table, "LoGoNet")
    with pytest.raises(NeedsError, match="--results fills the row"):
        measure_row(table, row, place(tmp_path, drive))
    found = measure_row(table, row, place(tmp_path, drive, results={"LoGoNet": drive[1]}))
    assert found.values[table.columns.index("Car moderate")] > 50
    assert found.values[table.columns.index("FPS")] is None


def test_without_data_a_row_says_what_it_needs(tmp_path):
    table = find_table("table-1")
    with pytest.raises(NeedsError, match=r"--kitti FOLDER: .*29 GB"):
        measure_row(table, table.rows[0], Workplace(tmp_path, {}))


def test_matching_over_iou_thresholds(tmp_path, drive):
    table = find_table("figure-1")
    for row in table.rows:
        found = measure_row(table, row, place(tmp_path, drive))
        assert found.values[table.columns.index("Car 0.5")] > 90


def test_detections_come_back_as_they_were(tmp_path):
    kept = Kept()
    made = []
    mask = InstanceMask(3, 4, np.array([[True, False], [False, True]]))
    found = Detections2D(
        np.array([[0.0, 0, 9, 9], [1, 1, 5, 5]]), np.array([0.5, 0.25]), [0, 1], ("a", "b"), (mask, None)
    )
    for _ in range(2):
        again = kept.get("camera", tmp_path / "x.npz", lambda: made.append(1) or found, Detections2D)
    assert made == [1]
    np.testing.assert_array_equal(again.boxes, found.boxes)
    assert again.class_names == ("a", "b")
    assert again.masks[1] is None
    assert (again.masks[0].x, again.masks[0].y) == (3, 4)
    np.testing.assert_array_equal(again.masks[0].bitmap, mask.bitmap)
    assert len(kept.milliseconds["camera"]) == 2
    (tmp_path / "y.npz").write_bytes(b"PK half a file")
    with pytest.raises(FormatError, match="delete it and run again"):
        kept.get("lidar", tmp_path / "y.npz", lambda: None, Detections3D)


def test_the_command_prints_and_writes(tmp_path, drive):
    root, lidar, camera = drive
    uses = ["--use", f"pointpillars-kitti=results:{lidar}", "--use", f"fasterrcnn-r101-kitti=results:{camera}"]
    command = ["paper", "table-2", "--kitti", str(root), "--out", str(tmp_path), *uses, "--results", f"logonet={lidar}"]
    result = CliRunner().invoke(app, [*command, "--json"])
    assert result.exit_code == 0, result.output
    rows = {row["name"]: row for row in json.loads(result.stdout)["rows"]}
    assert rows["LoGoNet"]["measured"]["Car moderate"] > 50
    assert not rows["LoGoNet"]["quoted"]
    assert rows["VirConv-T"]["quoted"]
    assert rows["VirConv-T"]["paper"]["Car moderate"] == 89.96
    assert any("frustum-pointnet-kitti" in note for note in rows["LCF3D-Single (FR + PP)"]["notes"])
    assert (tmp_path / "table-2.md").is_file()
    assert (tmp_path / "table-2.json").is_file()


def test_rows_that_fail_are_counted_and_fail_a_rehearsal(tmp_path, drive):
    (tmp_path / "cut.pth").write_bytes(b"PK half a file")
    command = ["paper", "table-1", "--kitti", str(drive[0]), "--out", str(tmp_path), "--row", "SECOND", "--json"]
    command += ["--use", f"second-kitti={tmp_path / 'cut.pth'}"]
    for words, code in ((command, 0), ([*command, "--rehearse"], 1)):
        result = CliRunner().invoke(app, words)
        assert result.exit_code == code
        assert "1 rows did not run, first table-1: SECOND" in result.output


def test_what_is_absent_is_told_with_disk_and_hours(tmp_path):
    result = CliRunner().invoke(app, ["paper", "table-1", "--out", str(tmp_path), "--json"])
    assert result.exit_code == 0, result.output
    rows = {row["name"]: row["notes"] for row in json.loads(result.stdout)["rows"]}
    fused = rows["PV-RCNN + Faster R-CNN, stereo"]
    assert [note.split(" ")[:2] for note in fused] == [
        ["needs", "fasterrcnn-r101-kitti"],
        ["needs", "frustum-pointnet-kitti"],
        ["needs", "--kitti"],
        ["about", fused[-1].split(" ")[1]],
    ]
    assert "29 GB" in fused[2]
    # a network runs once for all rows: five networks on 3,769 frames, the images of both views
    hours = 3769 * (0.40 + 0.96 + 1.99 + 2.55 + 2 * 2.6) / 3600
    assert fused[3].startswith(f"about {hours:.1f} h on two CPU cores")
    assert rows["SECOND"][-1] == fused[-1]


def test_a_folder_without_a_list_has_to_hold_the_papers_frames(tmp_path, drive):
    import shutil

    root = tmp_path / "kitti"
    shutil.copytree(drive[0], root)
    (root / "ImageSets" / "val.txt").unlink()
    table = find_table("table-1")
    with pytest.raises(ConfigError, match=r"lacks 3,761 of the 3,769 frames .*ImageSets/val\.txt"):
        measure_row(table, table.rows[3], place(tmp_path, (root, *drive[1:])))


def test_mvxnet_looks_through_the_front_camera_of_the_other_dataset(tmp_path, monkeypatch):
    from lcf3d.paper import shift

    tasks = []
    monkeypatch.setattr(shift, "_measure", lambda task, row, place: tasks.append(task) or {"figures": {}, "frames": 1})
    here = Workplace(tmp_path, {"kitti": tmp_path, "nuscenes": tmp_path})
    for name in ("kitti -> nuscenes: MVXNet", "kitti -> kitti: MVXNet"):
        measure_row(find_table("table-7"), find_row(find_table("table-7"), name), here)
    assert [task.lidar for task in tasks] == [
        "mvxnet:mvxnet-kitti?nms=keep&camera=CAM_FRONT",
        "mvxnet:mvxnet-kitti?nms=keep",
    ]


def test_the_split_lists_are_written(tmp_path):
    result = CliRunner().invoke(app, ["paper", "splits", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert len((tmp_path / "train.txt").read_text().split()) == 3712
    assert len((tmp_path / "val.txt").read_text().split()) == 3769


def test_wrong_requests_are_refused():
    for arguments, message in (
        (["table-1", "--results", "SECOND"], "--results takes NAME=DIR"),
        (["table-5", "--results", "LCF3D=."], "takes no --results"),
        (["all", "--row", "VoxelNeXt"], "no table has a row 'VoxelNeXt'"),
        (["table-1", "--row", "VoxelNeXt"], "names 0 rows of table-1"),
        (["all", "--row", "MVXNet", "--results", "MVXNet=."], "--results is for one table"),
        (["table-1", "--kitti", "nowhere"], "--kitti nowhere: there is no such folder"),
    ):
        result = CliRunner().invoke(app, ["paper", *arguments])
        assert isinstance(result.exception, ConfigError)
        assert message in str(result.exception)


def test_the_list_names_every_table():
    result = CliRunner().invoke(app, ["paper", "list"])
    assert result.exit_code == 0
    for name in ("table-1", "table-7", "figure-2", "--nuscenes: "):
        assert name in result.output


def test_dry_and_the_device_of_the_networks(tmp_path, drive, monkeypatch):
    root, lidar, _ = drive
    uses = ["--use", f"pointpillars-kitti=results:{lidar}"]
    command = ["paper", "table-1", "--kitti", str(root), "--out", str(tmp_path), "--row", "PointPillars", *uses]
    result = CliRunner().invoke(app, [*command, "--dry", "--json"])
    assert result.exit_code == 0, result.output
    assert not list(tmp_path.glob("**/*.npz"))
    devices = []
    monkeypatch.setattr("lcf3d.paper.rows.measured_rows", lambda table, rows, place: devices.append(place.device) or {})
    CliRunner().invoke(app, [*command, "--device", "cuda:1", "--json"])
    assert devices == ["cuda:1"]

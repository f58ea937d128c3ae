import json

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.errors import Lcf3dError
from lcf3d.formats.kitti import objects_from_detections_2d, read_objects, write_objects
from lcf3d.fusion.config import PRESETS
from lcf3d.geometry.camera import project_boxes
from lcf3d.localizers.named import SHIPPED
from lcf3d.reasons import Outcome
from lcf3d.run.folder import RunFolder
from lcf3d.structures import KITTI_CLASSES, Detections2D
from tests.datasets.kitti_folder import LABELS, make_kitti, make_results


@pytest.fixture
def paths(tmp_path):
    root = make_kitti(tmp_path / "kitti")
    lidar, camera = make_results(tmp_path)
    return {"root": root, "lidar": lidar, "camera": camera, "out": tmp_path / "out"}


def lcf3d(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def run(paths, *more):
    return lcf3d(
        "run",
        f"kitti:{paths['root']}",
        "--split",
        "val",
        "--lidar",
        f"results:{paths['lidar']}",
        "--camera",
        f"results:{paths['camera']}",
        "--out",
        paths["out"],
        *more,
    )


def test_run_matches_recovers_and_drops(paths):
    counts = json.loads(run(paths, "--set", "unmatched=drop", "--json").stdout)
    assert counts["frames"] == 3
    # the near car matches, the pedestrian comes out of its frustum, the weak 2D car stays below the threshold
    assert counts["outputs"] == {"matched": {"Car": 3}, "recovered": {"Pedestrian": 3}}
    assert counts["dropped_lidar"] == {"unconfirmed": 3}
    objects = read_objects(paths["out"] / "data" / "night_7.txt", results=True)
    assert sorted(objects.class_names) == ["Car", "Pedestrian"]
    fused = RunFolder(paths["out"]).read("night_7")
    assert len(fused) == 2
    assert "matched" in fused.explain(int(np.flatnonzero(fused.detections.labels == 0)[0]))


def test_two_processes_write_the_same(paths, tmp_path):
    run(paths)
    one = {p.name: p.read_text() for p in (paths["out"] / "data").iterdir()}
    paths["out"] = tmp_path / "out2"
    run(paths, "--jobs", "2")
    assert {p.name: p.read_text() for p in (paths["out"] / "data").iterdir()} == one


def test_frame_without_detections_is_an_empty_file(paths):
    for name in ("lidar", "camera"):
        (paths[name] / "000001.txt").write_text("")
    run(paths)
    assert (paths["out"] / "data" / "000001.txt").read_text() == ""


def test_recovery_off_needs_no_scans(paths):
    for path in (paths["root"] / "training" / "velodyne").iterdir():
        path.unlink()
    counts = json.loads(run(paths, "--recovery", "off", "--json").stdout)
    assert "recovered" not in counts["outputs"]


def test_interrupted_run_is_resumed(paths):
    scan = paths["root"] / "training" / "velodyne" / "night_7.bin"
    whole = scan.read_bytes()
    scan.write_bytes(whole[:-1])
    with pytest.raises(Lcf3dError, match=r"night_7.bin is cut off"):
        run(paths)
    done = sorted(p.name for p in (paths["out"] / "data").iterdir())
    assert done == ["000000.txt", "000001.txt"]
    scan.write_bytes(whole)
    with pytest.raises(Lcf3dError, match="not empty; pass --resume"):
        run(paths)
    counts = json.loads(run(paths, "--resume", "--json").stdout)
    assert (counts["frames"], counts["already_done"]) == (1, 2)


def test_resume_with_other_settings_is_refused(paths):
    run(paths)
    with pytest.raises(Lcf3dError, match="other settings or inputs"):
        run(paths, "--resume", "--set", "match_iou=0.6")
    run(paths, "--overwrite", "--set", "match_iou=0.6")
    assert "match_iou: 0.6" in (paths["out"] / "config.yaml").read_text()


def break_line(paths):
    path = paths["lidar"] / "000001.txt"
    path.write_text(path.read_text() + "Car 1 2 3\n")


def reverse_box(paths):
    path = paths["camera"] / "000001.txt"
    fields = path.read_text().splitlines()[0].split()
    fields[4], fields[6] = fields[6], fields[4]
    path.write_text(" ".join(fields) + "\n")


def raise_camera_score(paths):
    path = paths["camera"] / "000001.txt"
    path.write_text(path.read_text().replace(" 0.9\n", " 1.9\n"))


def drop_calibration(paths):
    (paths["root"] / "training" / "calib" / "000001.txt").unlink()


def drop_result(paths):
    (paths["lidar"] / "000001.txt").unlink()


@pytest.mark.parametrize(
    ("damage", "more", "message"),
    [
        (break_line, (), r"000001.txt:3"),
        (reverse_box, (), r"000001.txt:1"),
        (raise_camera_score, (), r"scores must lie in \[0, 1\]"),
        (drop_calibration, (), "lacks 1 of 3 frames"),
        (drop_result, (), "lacks the files of 1 of 3 frames"),
        (lambda p: None, ("--set", "match_iou=2"), "match_iou"),
        (lambda p: None, ("--set", "match_iou"), "name=value"),
        (lambda p: None, ("--recovery", "maybe"), "on or off"),
        (lambda p: None, ("--missing", "ignore"), "error or empty"),
        (lambda p: None, ("--config", "best"), "neither a preset"),
        (lambda p: None, ("--frame", "9"), "has no frame '9'"),
        (lambda p: None, ("--lidar", "magic:x"), "unknown LiDAR detector kind"),
        (lambda p: None, ("--lidar", "results"), "needs an argument: results:PATH"),
    ],
)
def test_bad_input_stops_before_anything_is_written(paths, damage, more, message):
    damage(paths)
    with pytest.raises(Lcf3dError, match=message):
        run(paths, *more)
    assert not list(paths["out"].glob("data/*"))


def test_missing_results_can_be_allowed(paths):
    drop_result(paths)
    counts = json.loads(run(paths, "--missing", "empty", "--json").stdout)
    assert counts["frames"] == 3


def test_2d_results_as_lidar_branch_are_recognised(paths):
    paths["lidar"] = paths["camera"]
    with pytest.raises(Lcf3dError, match="holds no 3D boxes"):
        run(paths)


def test_errors_are_one_sentence_and_exit_code_2(capsys, monkeypatch):
    from lcf3d.cli.app import main

    monkeypatch.setattr("sys.argv", ["lcf3d", "config", "nonsense"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    names = ", ".join(PRESETS)
    assert capsys.readouterr().err == f"error: 'nonsense' is neither a preset ({names}) nor a file\n"


def test_config_prints_and_writes(tmp_path):
    assert "match_iou: 0.7  #" in lcf3d("config", "paper", "--set", "match_iou=0.7").stdout
    lcf3d("config", "kitti", "--out", tmp_path / "c.yaml")
    assert (tmp_path / "c.yaml").read_text() == lcf3d("config", "kitti").stdout


def test_check_exit_codes(paths):
    good = lcf3d("check", f"kitti:{paths['root']}", "--split", "val")
    assert (good.exit_code, good.stdout.splitlines()[-1]) == (0, "all rules hold")
    drop_calibration(paths)
    bad = lcf3d("check", f"kitti:{paths['root']}", "--split", "val", "--json")
    assert bad.exit_code == 1
    assert json.loads(bad.stdout)[0]["id"] == "KIT01"


def test_stereo_pair_of_results(paths, tmp_path):
    from tests.datasets.kitti_folder import OBJECTS, left_camera, right_camera

    for view, folder in ((left_camera(), "l"), (right_camera(), "r")):
        boxes, _ = project_boxes(np.array(OBJECTS), view)
        found = Detections2D(boxes, [0.9, 0.8, 0.85], LABELS, KITTI_CLASSES)
        for frame_id in ("000000", "000001", "night_7"):
            write_objects(tmp_path / folder / f"{frame_id}.txt", objects_from_detections_2d(found))
    result = lcf3d(
        *("run", f"kitti:{paths['root']}", "--lidar", f"results:{paths['lidar']}", "--out", paths["out"], "--json"),
        *("--camera-left", f"results:{tmp_path / 'l'}", "--camera-right", f"results:{tmp_path / 'r'}"),
    )
    outputs = json.loads(result.stdout)["outputs"]
    assert outputs["matched"] == {"Car": 3}
    assert outputs["recovered"] == {"Car": 3, "Pedestrian": 3}
    assert "epipolar_gate_px" in (paths["out"] / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ((), "name the camera branch with --camera"),
        (("--camera-left", "results:x"), "both --camera-left and --camera-right"),
    ],
)
def test_camera_branch_must_be_named(paths, cameras, message):
    with pytest.raises(Lcf3dError, match=message):
        lcf3d("run", f"kitti:{paths['root']}", "--lidar", "results:x", "--out", paths["out"], *cameras)


def test_scores_without_bounds_are_calibrated_against_the_camera(paths):
    for path in paths["lidar"].iterdir():
        path.write_text(path.read_text().replace(" 0.9\n", " 40\n").replace(" 0.8\n", " -3\n"))
    result = run(paths, "--json")
    assert "no probabilities" in result.stderr
    assert (paths["out"] / "calibration.json").is_file()
    fused = RunFolder(paths["out"]).read("000000")
    assert (fused.detections.scores <= 1).all()
    with pytest.raises(Lcf3dError, match="scores must lie in"):
        run(paths, "--overwrite", "--calibration", "none")


def test_the_localizer_can_be_chosen(paths, tmp_path):
    recovered = {}
    for name in ("geometric", "network", f"onnx:{SHIPPED['kitti']}"):
        out = tmp_path / name.partition(":")[0]
        jobs = ("--jobs", "2") if name.startswith("onnx") else ()
        run({**paths, "out": out}, "--localizer", name, "--set", "min_quality=0", "--set", "confirm_iou=0", *jobs)
        assert json.loads((out / "run.json").read_text())["localizer"] == name
        recovered[name] = RunFolder(out).read("000000")
    boxes = [fused.detections.boxes[fused.outcomes == Outcome.RECOVERED] for fused in recovered.values()]
    assert [len(b) for b in boxes] == [1, 1, 1]
    assert np.abs(boxes[0] - boxes[1]).max() > 1e-6
    np.testing.assert_allclose(boxes[1], boxes[2], atol=1e-5)
    with pytest.raises(Lcf3dError, match="unknown localizer kind 'best'"):
        run({**paths, "out": tmp_path / "none"}, "--localizer", "best")
    assert not (tmp_path / "none").exists()

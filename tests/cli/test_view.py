from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.opening import open_dataset
from lcf3d.decisions import Decisions
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.fusion.config import FusionConfig
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.run.folder import RunFolder
from lcf3d.run.table_folder import open_run_folder
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D
from lcf3d.visualization.scene import COLOURS

CALIBRATION = """P2: 100 0 200 0 0 100 60 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
LABEL = "Car 0 0 0 180 40 220 80 1.5 2 4 0 0.75 10 -1.57\n"
RESULT = "Car -1 -1 0 180 40 220 80 1.5 2 4 0 0.75 10 -1.57 7.25\n"
RESULT_2D = "Car -1 -1 -10 180 40 220 80 -1 -1 -1 -1000 -1000 -1000 -10 0.9\n"


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Two frames with a 400 x 120 image, a scan and one car."""
    training = tmp_path / "kitti" / "training"
    for folder in ("calib", "image_2", "velodyne", "label_2"):
        (training / folder).mkdir(parents=True)
    for frame_id in ("000001", "000002"):
        (training / "calib" / f"{frame_id}.txt").write_text(CALIBRATION)
        (training / "label_2" / f"{frame_id}.txt").write_text(LABEL)
        np.full((9, 4), 8, dtype="<f4").tofile(training / "velodyne" / f"{frame_id}.bin")
        PIL.Image.new("RGB", (400, 120), (20, 20, 20)).save(training / "image_2" / f"{frame_id}.png")
    return training.parent


@pytest.fixture
def run_folder(kitti: Path, tmp_path: Path) -> Path:
    """A run over both frames in which the car was matched."""
    dataset, folder = KittiDataset(kitti), RunFolder(tmp_path / "run")
    folder.begin(FusionConfig(), {"dataset": f"kitti:{kitti}"}, resume=False, overwrite=False)
    lidar = Detections3D(np.array([[10, 0, 0, 4, 2, 1.5, 0]]), np.array([0.9]), np.array([0]), KITTI_CLASSES)
    camera = Detections2D(np.array([[180, 40, 220, 80]]), np.array([0.9]), np.array([0]), KITTI_CLASSES)
    table = Decisions.blank(1)
    table.outcome[0], table.reason[0], table.output[0] = Outcome.MATCHED, Reason.CONFIRMED, 0
    table.lidar[0] = table.camera[0] = table.detection[0] = 0
    for frame in dataset:
        folder.write(frame, FusedDetections(lidar, table, table, lidar, (camera,), ("left",)))
    return folder.path


def view(*arguments: object) -> str:
    """Standard output of ``lcf3d view``; errors are raised."""
    result = CliRunner().invoke(app, ["view", *map(str, arguments)])
    if result.exception is not None:
        raise result.exception
    return result.output


def pixels_of(path: Path, stage: str) -> int:
    """How many pixels nearly have the colour of a stage."""
    with PIL.Image.open(path) as picture:
        assert picture.width == 400
        return int((np.abs(np.asarray(picture).astype(int) - COLOURS[stage]).max(axis=-1) <= 12).sum())


def test_a_run_is_drawn_whole(run_folder: Path) -> None:
    output = view(run_folder)
    pictures = sorted((run_folder / "pictures").iterdir())
    assert [p.name for p in pictures] == ["000001.png", "000002.png"]
    assert "2 pictures" in output
    assert all(pixels_of(p, "matched") > 100 for p in pictures)


def test_boxes_that_nobody_believes_are_left_out(run_folder: Path, tmp_path: Path) -> None:
    view(run_folder, "--frame", "000001", "--out", tmp_path / "all.png", "--no-truth")
    view(run_folder, "--frame", "000001", "--out", tmp_path / "none.png", "--no-truth", "--min-score", 2)
    assert pixels_of(tmp_path / "all.png", "matched") > 0
    assert pixels_of(tmp_path / "none.png", "matched") == 0


def test_chosen_frames_and_limit(run_folder: Path, tmp_path: Path) -> None:
    assert view(run_folder, "--frame", "000002", "--out", tmp_path / "a.png").strip() == str(tmp_path / "a.png")
    assert pixels_of(tmp_path / "a.png", "matched") > 100
    view(run_folder, "--limit", "1", "--out", tmp_path / "some")
    assert [p.name for p in (tmp_path / "some").iterdir()] == ["000001.png"]


def test_of_a_long_run_the_first_frames_are_drawn(kitti: Path, run_folder: Path, tmp_path: Path) -> None:
    from inspect import signature

    from lcf3d.cli.view import _frame_ids
    from lcf3d.cli.view import view as verb

    assert signature(verb).parameters["limit"].default == 50
    data = open_dataset(f"kitti:{kitti}")
    ids = open_run_folder(run_folder).frame_ids()
    assert len(ids) > 1
    assert _frame_ids(data, [], run_folder, 1) == (ids[:1], len(ids) - 1)
    assert _frame_ids(data, [], run_folder, 0) == (ids, 0)
    # those that are named are drawn, however many
    assert _frame_ids(data, ids, run_folder, 1) == (ids, 0)
    assert f"{len(ids)} pictures in" in view(run_folder, "--limit", "0", "--out", tmp_path / "all")


def test_a_dataset_with_the_results_of_a_run(kitti: Path, run_folder: Path, tmp_path: Path) -> None:
    view(f"kitti:{kitti}", "--results", run_folder, "--frame", "000001", "--out", tmp_path / "a.png")
    assert pixels_of(tmp_path / "a.png", "matched") > 100


@pytest.mark.parametrize(("line", "detections"), [(RESULT, True), (RESULT_2D, False)])
def test_a_dataset_with_result_files(kitti: Path, tmp_path: Path, line: str, detections: bool) -> None:
    results = tmp_path / "results" / "data"
    results.mkdir(parents=True)
    (results / "000001.txt").write_text(line)
    out = tmp_path / "a.png"
    view(f"kitti:{kitti}", "--frame", "000001", "--results", results.parent, "--out", out)
    assert (pixels_of(out, "detection") > 100) == detections


def test_a_dataset_alone_with_and_without_truth(kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert view(f"kitti:{kitti}", "--frame", "000001").strip() == "000001.png"
    with_truth = np.asarray(PIL.Image.open(tmp_path / "000001.png")).astype(int)
    view(f"kitti:{kitti}", "--frame", "000001", "--no-truth")
    without = np.asarray(PIL.Image.open(tmp_path / "000001.png")).astype(int)
    # the rear of the car, 8 m away: its left edge is 12.5 px from the middle, below the legend of 26 rows
    left_edge = (slice(55 + 26, 65 + 26), 187)
    assert with_truth[left_edge].max() > without[left_edge].max() + 50


def test_bad_requests(kitti: Path, run_folder: Path, tmp_path: Path) -> None:
    source = f"kitti:{kitti}"
    for arguments, message in (
        ((source,), "name the frames to draw with --frame, for example --frame 000001"),
        ((source, "--frame", "000009"), "has no frame '000009'"),
        ((source, "--frame", "000001", "--results", tmp_path / "none"), "none does not exist; --results takes"),
        ((tmp_path / "none",), "none does not exist; view takes"),
        ((run_folder, "--results", run_folder), "leave --results out"),
        ((run_folder, "--out", tmp_path / "a.png"), "is one file, but 2 frames"),
        ((run_folder, "--out", run_folder / "run.json"), "must be a .png file or a folder"),
        (("waymo:x", "--frame", "1"), "unknown dataset kind 'waymo'"),
    ):
        with pytest.raises(ConfigError, match=message):
            view(*arguments)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"lacks the files of 1 of 1 frames, first 000001\.txt"):
        view(source, "--frame", "000001", "--results", tmp_path / "empty")
    assert not (tmp_path / "000001.png").exists()


def test_a_run_whose_dataset_has_moved(run_folder: Path, kitti: Path) -> None:
    kitti.rename(kitti.with_name("moved"))
    with pytest.raises(ConfigError, match=r"the dataset of this run is not there .* lcf3d view kind:ROOT --results"):
        view(run_folder)
    (run_folder / "run.json").write_text(json.dumps({"lcf3d": "0.1.0"}))
    with pytest.raises(ConfigError, match="does not say what dataset was run"):
        view(run_folder)
    for path in (run_folder / "provenance").iterdir():
        path.unlink()
    with pytest.raises(ConfigError, match="holds no finished frames yet"):
        view(f"kitti:{kitti.with_name('moved')}", "--results", run_folder)


def test_a_picture_that_moves(run_folder: Path, tmp_path: Path) -> None:
    assert "2 frames in" in view(run_folder, "--gif", tmp_path / "run.gif")
    with PIL.Image.open(tmp_path / "run.gif") as picture:
        assert picture.n_frames == 2
    assert not (run_folder / "pictures").exists()
    for wrong in (("--gif", tmp_path / "run.png"), ("--gif", tmp_path / "a.gif", "--out", tmp_path / "b.png")):
        with pytest.raises(ConfigError, match=r"ends in \.gif and goes without --out"):
            view(run_folder, *wrong)

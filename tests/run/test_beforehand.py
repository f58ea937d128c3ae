"""What a run does before its first frame: it refuses early, and a part of it reads only what it needs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

import lcf3d
from lcf3d.datasets import kitti_results
from lcf3d.errors import ConfigError, DatasetError, MissingExtraError
from lcf3d.formats.kitti import KittiObjects
from lcf3d.run import teaching
from lcf3d.run.setup import RunRequest, prepare_run
from lcf3d.run.shards import merge_shards
from tests.datasets.kitti_folder import make_kitti, make_results
from tests.run.test_fleet import content

IDS = tuple(f"0000_{i:06d}" for i in range(40))
PARTS = ("data", "provenance")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    make_kitti(folder / "kitti", IDS)
    make_results(folder, IDS)
    for frame_id in IDS[::8]:
        # not of the run's classes, one a file
        text = (folder / "camera" / f"{frame_id}.txt").read_text()
        (folder / "camera" / f"{frame_id}.txt").write_text(text + text.splitlines()[0].replace("Car", "Tram") + "\n")
    return folder


def request(root: Path, **options) -> RunRequest:
    return RunRequest(
        f"kitti:{root / 'kitti'}", f"results:{root / 'lidar'}", {"*": f"results:{root / 'camera'}"}, **options
    )


def fused(root: Path, out: Path, **options) -> Path:
    asked = request(root)
    lcf3d.run(asked.dataset, asked.lidar, asked.cameras, out, recovery="off", **options)
    return out


def test_a_shard_reads_its_own_files_and_those_that_all_learn_from(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(teaching, "TEACHING_FRAMES", 5)
    monkeypatch.setattr(teaching, "FEW_FRAMES", 5)
    whole = fused(root, tmp_path / "whole")
    read: list[str] = []
    read_folder = kitti_results.read_folder

    def noting(folder: Path, frame_ids, **options) -> KittiObjects:
        read.extend(frame_ids)
        return read_folder(folder, frame_ids, **options)

    monkeypatch.setattr(kitti_results, "read_folder", noting)
    shards = [fused(root, tmp_path / "part-1", shard="1/4")]
    assert set(read) == {*IDS[:10], *IDS[::8]}
    shards += [fused(root, tmp_path / f"part-{i}", shard=f"{i}/4") for i in (2, 3, 4)]
    merge_shards(shards, tmp_path / "merged")
    assert content(tmp_path / "merged", *PARTS) == content(whole, *PARTS)
    for name in ("calibration.json", "config.yaml"):
        assert (tmp_path / "merged" / name).read_bytes() == (whole / name).read_bytes()
    # what is left out is counted once, and summed
    one, all_of_them = (json.loads((p / "run.json").read_text()) for p in (tmp_path / "merged", whole))
    assert one["left_out"] == all_of_them["left_out"] == {"camera": {"classes": {"Tram": 5}}}
    assert any("shard 2/4: " in note and "Tram 1" in note for note in one["notes"])


def test_a_shard_does_not_ask_for_the_files_of_others(root: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(teaching, "TEACHING_FRAMES", 5)
    away = root / "lidar" / f"{IDS[39]}.txt"
    text = away.read_text()
    away.unlink()
    try:
        assert len(lcf3d.read_run(fused(root, tmp_path / "part-1", shard="1/4"))) == 10
        with pytest.raises(DatasetError, match=f"lacks the files of 1 of 10 frames, first {IDS[39]}.txt"):
            fused(root, tmp_path / "part-4", shard="4/4")
    finally:
        away.write_text(text)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"form": "csv"}, "--format takes"),
        ({"shard": "5/4"}, "--shard takes i/n"),
        ({"shard": "1/4", "memory": True}, "takes drives apart"),
        ({"calibration": "nowhere.json"}, "nowhere.json"),
        ({"localizer": "nonsense"}, "nonsense"),
    ],
)
def test_what_cannot_be_run_is_refused_before_result_files_are_read(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict, message: str
) -> None:
    monkeypatch.setattr(kitti_results, "read_folder", lambda *a, **k: pytest.fail("read"))
    with pytest.raises(lcf3d.Lcf3dError, match=message):
        prepare_run(request(root, **options), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_place_that_cannot_be_written_is_refused_first(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # not even the dataset is looked for
    nothing = RunRequest("kitti:nowhere", "results:nowhere", {"*": "results:nowhere"})
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is not empty; pass --resume, --overwrite or another --out"):
        prepare_run(nothing, full)
    with pytest.raises(ConfigError, match="holds files of something else"):
        prepare_run(nothing, full, overwrite=True)
    with pytest.raises(ConfigError, match="is a file; choose a folder"):
        prepare_run(nothing, full / "mine.txt")
    with pytest.raises(ConfigError, match=r"mine\.txt is read-only or no folder"):
        prepare_run(nothing, full / "mine.txt" / "deeper")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(ConfigError, match="cannot be written"):
        prepare_run(nothing, tmp_path / "new")


def test_packages_that_are_not_there_are_missed_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from lcf3d.cli.app import app
    from lcf3d.formats.bag_files import require_writer
    from lcf3d.run.ray_workers import require_processes

    nothing = RunRequest("kitti:nowhere", "results:nowhere", {"*": "results:nowhere"})
    monkeypatch.setattr("lcf3d.run.ray_workers.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="--ray needs ray"):
        require_processes(nothing, 1, "auto")
    monkeypatch.setattr("lcf3d.formats.bag_files.find_spec", lambda name: None if name == "mcap" else name)
    require_writer("fused.bag")
    with pytest.raises(MissingExtraError, match=r"writing fused\.mcap needs mcap"):
        require_writer("fused.mcap")
    command = ["run", "kitti:nowhere", "--lidar", "results:x", "--camera", "results:x", "--out", str(tmp_path / "out")]
    said = CliRunner().invoke(app, [*command, "--format", "mcap"])
    assert said.exit_code
    assert "mcap" in str(said.exception)


@pytest.mark.parametrize("smooth", [False, True])
def test_memory_takes_whole_drives_in_order_in_python_too(root: Path, tmp_path: Path, smooth: bool) -> None:
    options = {"smooth": True} if smooth else {"memory": True}
    ordered = fused(root, tmp_path / "ordered", frames=IDS[:12], **options)
    mixed = fused(root, tmp_path / "mixed", frames=(*IDS[6:12], *IDS[:6]), **options)
    assert content(ordered, "data", "provenance", "tracks") == content(mixed, "data", "provenance", "tracks")
    assert (ordered / "tracks" / "0000.txt").is_file()

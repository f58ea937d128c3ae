"""Runs in tables, in shards, on processes of any kind, and what other tools are given."""

import json
import multiprocessing
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import lcf3d
from lcf3d import plugins
from lcf3d.datasets.opening import open_dataset
from lcf3d.decisions import TrackTable
from lcf3d.errors import ConfigError, FormatError
from lcf3d.formats.fused_table import read_frames, write_frames
from lcf3d.run.conversion import convert_run
from lcf3d.run.export import export_run
from lcf3d.run.shards import frames_of_shard, merge_shards, parse_shard
from lcf3d.run.table_folder import TableRunFolder, open_run_folder
from tests.datasets.toy import write_toy

pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow: pip install 'lcf3d[fleet]'")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("toy")
    write_toy(folder, 12)
    return folder


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    known = plugins._points
    toy = EntryPoint("toy", "tests.datasets.toy:ToyDataset", "lcf3d.datasets")
    monkeypatch.setattr(plugins, "_points", lambda g: {**known(g), **({"toy": toy} if g == toy.group else {})})


def fused(root: Path, out: Path, **options) -> Path:
    lcf3d.run(f"toy:{root / 'data'}", f"results:{root / 'lidar'}", f"results:{root / 'camera'}", out, **options)
    return out


def content(folder: Path, *parts: str) -> dict[str, bytes]:
    """Bytes of all files of some sub-folders, by path."""
    files = [path for part in parts for path in (folder / part).rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_tables_hold_what_the_files_hold(root: Path, tmp_path: Path) -> None:
    files, tables = fused(root, tmp_path / "files"), fused(root, tmp_path / "tables", form="parquet")
    assert len(list((tables / "provenance").iterdir())) == 1
    first, second = lcf3d.read_run(files), lcf3d.read_run(tables)
    assert list(first) == list(second)
    for frame_id, one in first.items():
        assert one.to_json() == second[frame_id].to_json()
        assert [one.explain(i) for i in range(len(one))] == [second[frame_id].explain(i) for i in range(len(one))]


def test_tracks_are_kept(root: Path, tmp_path: Path) -> None:
    tables = fused(root, tmp_path / "tables", form="parquet")
    one = lcf3d.read_run(tables)["f00"]
    n = len(one)
    times = np.linspace(0.0, 0.5, n)
    tracks = TrackTable(np.arange(n) + 7, times, np.full(n, 2), np.zeros(n), times * 2, times - 1)
    path = tmp_path / "part-1.parquet"
    write_frames(path, [("f00", replace(one, tracks=tracks))])
    ((_, back),) = read_frames(path)
    assert back.tracks is not None
    assert back.explain(1) == replace(one, tracks=tracks).explain(1)
    assert back.tracks.ids.tolist() == tracks.ids.tolist()


def test_shards_and_memory_do_not_go_together(root: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="takes drives apart"):
        fused(root, tmp_path / "out", shard="1/2", memory=True)


def test_runs_are_converted_both_ways(root: Path, tmp_path: Path) -> None:
    files, tables = fused(root, tmp_path / "files"), fused(root, tmp_path / "tables", form="parquet")
    data = open_dataset(f"toy:{root / 'data'}")
    assert convert_run(tables, data, tmp_path / "back", "folder") == 12
    assert content(tmp_path / "back", "provenance", "data") == content(files, "provenance", "data")
    assert convert_run(files, data, tmp_path / "forth", "parquet") == 12
    assert convert_run(tmp_path / "forth", data, tmp_path / "again", "folder") == 12
    assert content(tmp_path / "again", "provenance") == content(files, "provenance")
    with pytest.raises(ConfigError, match="not empty"):
        convert_run(files, data, tmp_path / "back", "folder")


def test_rows_of_the_table_of_detections(root: Path, tmp_path: Path) -> None:
    tables = fused(root, tmp_path / "tables", form="parquet")
    table = pyarrow.parquet.read_table(next((tables / "detections").iterdir()))
    one = lcf3d.read_run(tables)["f03"]
    own = [row for row in table.to_pylist() if row["frame"] == "f03"]
    assert [row["score"] for row in own] == one.detections.scores.tolist()
    assert own[1]["explanation"] == one.explain(1)
    assert own[0]["outcome"] == "matched"
    assert own[0]["velocity_x"] is None


def test_evaluation_of_tables_and_files_agree(root: Path, tmp_path: Path) -> None:
    files, tables = fused(root, tmp_path / "files"), fused(root, tmp_path / "tables", form="parquet")
    first, second = (lcf3d.evaluate(f"toy:{root / 'data'}", path) for path in (files, tables))
    assert first.to_json() == second.to_json()
    one, other = first.study(), second.study()
    assert one.classes[0].to_json() == other.classes[0].to_json()
    assert other.fused(0) is not None


def test_shards_of_tables_are_whole_or_not_there(root: Path, tmp_path: Path) -> None:
    tables = fused(root, tmp_path / "tables", form="parquet")
    folder = TableRunFolder(tmp_path / "broken")
    frame, one = open_dataset(f"toy:{root / 'data'}").frame("f00"), lcf3d.read_run(tables)["f00"]

    def interrupted() -> None:
        with folder.shard():
            folder.write(frame, one)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert folder.frame_ids() == []
    for _ in range(2):
        with folder.shard():
            folder.write(frame, one)
    # the same frames make the same shard
    assert folder.frame_ids() == ["f00"]
    part = next((tmp_path / "broken" / "provenance").iterdir())
    part.with_name("part-copy.parquet").write_bytes(part.read_bytes())
    with pytest.raises(FormatError, match="f00 is in two shards"):
        TableRunFolder(tmp_path / "broken").frame_ids()


def test_resuming_tables_fuses_what_is_not_there(root: Path, tmp_path: Path) -> None:
    whole = fused(root, tmp_path / "whole", form="parquet")
    part = next((whole / "provenance").iterdir())
    part.unlink()
    fused(root, whole, form="parquet", resume=True)
    assert part.is_file()
    assert len(open_run_folder(whole).frame_ids()) == 12


def test_tables_made_anew(root: Path, tmp_path: Path) -> None:
    tables = fused(root, tmp_path / "tables", form="parquet")
    extra = tables / "provenance" / "part-old.parquet"
    extra.write_bytes(next((tables / "provenance").iterdir()).read_bytes())
    fused(root, tables, form="parquet", overwrite=True)
    assert not extra.exists()
    assert len(open_run_folder(tables).frame_ids()) == 12
    with pytest.raises(ConfigError, match="a run of another --format"):
        fused(root, tables, overwrite=True)


def test_tables_of_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "part-1.parquet"
    path.write_bytes(b"nothing")
    with pytest.raises(FormatError, match="parquet file"):
        list(read_frames(path))
    for metadata, message in (({}, "not written by lcf3d"), ({"lcf3d.schema": "9"}, "schema 9, this lcf3d reads 1")):
        schema = pyarrow.schema([("frame", pyarrow.string())], metadata=metadata)
        pyarrow.parquet.write_table(pyarrow.table({"frame": ["a"]}, schema=schema), path)
        with pytest.raises(FormatError, match=message):
            list(read_frames(path))


@pytest.mark.parametrize("form", ["folder", "parquet"])
def test_shards_put_together_are_the_whole_run(root: Path, tmp_path: Path, form: str) -> None:
    whole = fused(root, tmp_path / "whole", form=form)
    shards = [fused(root, tmp_path / f"s{i}", form=form, shard=f"{i}/3") for i in (1, 2, 3)]
    assert merge_shards(shards, tmp_path / "merged") == 12
    first, second = lcf3d.read_run(whole), lcf3d.read_run(tmp_path / "merged")
    assert {k: v.to_json() for k, v in first.items()} == {k: v.to_json() for k, v in second.items()}
    if form == "folder":
        assert content(whole, "provenance", "data") == content(tmp_path / "merged", "provenance", "data")
        assert (whole / "run.json").read_bytes() == (tmp_path / "merged" / "run.json").read_bytes()


def test_what_is_wrong_with_shards_is_named(root: Path, tmp_path: Path) -> None:
    one, two = (fused(root, tmp_path / f"s{i}", shard=f"{i}/3") for i in (1, 2))
    half = fused(root, tmp_path / "half", shard="2/2")
    for shards, message in (
        ([one, two], "1 of 3 shards are missing: 3/3"),
        ([one, half], "the shards overlap: they are of runs cut into 2 and 3"),
        ([one, fused(root, tmp_path / "w")], "is a whole run"),
        ([one, fused(root, tmp_path / "again", shard="1/3")], "shard 1/3 is there twice, in .*s1 and .*again"),
        ([one, fused(root, tmp_path / "o", shard="2/3", recovery="off")], "different runs: they differ in"),
        ([], "no shards"),
        ([one, tmp_path], "is no folder of 'lcf3d run'"),
    ):
        with pytest.raises(ConfigError, match=message):
            merge_shards(shards, tmp_path / "merged")
    three = fused(root, tmp_path / "s3", shard="3/3")
    (three / "provenance" / "f11.json").unlink()
    with pytest.raises(ConfigError, match=r"shard 3/3\) lacks 1 of its frames, first f11"):
        merge_shards([one, two, three], tmp_path / "merged")


@pytest.mark.parametrize("text", ["0/3", "4/3", "x", "1", "1/x", "-1/2"])
def test_bad_shards(text: str) -> None:
    with pytest.raises(ConfigError, match="--shard takes i/n"):
        parse_shard(text)


def test_shards_cover_all_frames_once() -> None:
    ids = [str(i) for i in range(10)]
    assert [i for k in (1, 2, 3, 4) for i in frames_of_shard(ids, f"{k}/4")] == ids
    assert frames_of_shard(ids, None) == tuple(ids)
    assert frames_of_shard(ids[:1], "1/2") == ()


@pytest.mark.parametrize(("method", "form"), [("spawn", "folder"), ("forkserver", "parquet"), ("fork", "parquet")])
def test_processes_of_any_kind_give_the_same_bytes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, form: str
) -> None:
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system cannot {method}")
    # two shards, so that both processes have one
    monkeypatch.setattr("lcf3d.run.frames.SHARD_FRAMES", 6)
    one = fused(root, tmp_path / "one", form=form)
    monkeypatch.setattr("lcf3d.run.frames.get_start_method", lambda allow_none: method)
    two = fused(root, tmp_path / "two", form=form, jobs=2)
    assert content(one, "provenance", "data", "detections") == content(two, "provenance", "data", "detections")
    assert multiprocessing.active_children() == []


def test_what_cannot_be_sent_to_processes_is_said(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lcf3d.run.frames.get_start_method", lambda allow_none: "spawn")
    monkeypatch.setattr("lcf3d.run.setup.load_localizer", lambda text: lambda proposals: None)
    with pytest.raises(ConfigError, match="leave --jobs out"):
        fused(root, tmp_path / "out", jobs=2)


def test_labels_for_other_tools(root: Path, tmp_path: Path) -> None:
    run = fused(root, tmp_path / "run")
    data = open_dataset(f"toy:{root / 'data'}")
    for form in ("coco", "fiftyone", "label-studio"):
        assert export_run(run, data, form, tmp_path / f"{form}.json") == 12
    coco, fiftyone, tasks = (
        json.loads((tmp_path / f"{form}.json").read_text()) for form in ("coco", "fiftyone", "label-studio")
    )
    one = lcf3d.read_run(run)["f00"]
    assert [image["file_name"] for image in coco["images"]][:2] == ["f00/front", "f01/front"]
    own = [a for a in coco["annotations"] if a["image_id"] == 1]
    # the 2D detection that confirmed the best output
    led = one.camera.detection[np.flatnonzero(one.camera.output == 0)[0]]
    x1, y1, x2, y2 = one.camera_inputs[0].boxes[led]
    np.testing.assert_allclose(own[0]["bbox"], [x1, y1, x2 - x1, y2 - y1], atol=2e-3)
    assert own[0]["explanation"] == one.explain(0)
    assert coco["categories"][own[0]["category_id"] - 1]["name"] == one.detections.class_names[one.detections.labels[0]]
    np.testing.assert_allclose(
        fiftyone["labels"]["f00/front"][0]["bounding_box"],
        [x1 / 800, y1 / 400, (x2 - x1) / 800, (y2 - y1) / 400],
        atol=1e-5,
    )
    (prediction,) = tasks[0]["predictions"]
    assert prediction["result"][0]["value"]["x"] == pytest.approx(100 * x1 / 800, abs=1e-3)
    assert prediction["result"][0]["value"]["rectanglelabels"] == [one.detections.class_names[one.detections.labels[0]]]


def test_exports_that_do_not_fit_are_refused(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = fused(root, tmp_path / "run")
    data = open_dataset(f"toy:{root / 'data'}")
    with pytest.raises(ConfigError, match="--to takes folder, parquet, coco"):
        export_run(run, data, "tfrecord", tmp_path / "x")
    with pytest.raises(ConfigError, match="class 'person' is none of nuScenes"):
        export_run(run, data, "nuscenes", tmp_path / "x")
    monkeypatch.setattr("lcf3d.run.export.NUSCENES_CLASSES", ("car", "person"))
    with pytest.raises(lcf3d.Lcf3dError, match="no pose"):
        export_run(run, data, "nuscenes", tmp_path / "x")
    with pytest.raises(ConfigError, match="is a folder"):
        export_run(run, data, "coco", tmp_path)
    with pytest.raises(ConfigError, match="--format takes folder or parquet"):
        fused(root, tmp_path / "other", form="csv")


def test_verbs(root: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from lcf3d.cli.app import app

    def call(*arguments: object) -> str:
        result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    toy = f"toy:{root / 'data'}"
    branches = ("--lidar", f"results:{root / 'lidar'}", "--camera", f"results:{root / 'camera'}")
    for i in (1, 2):
        call("run", toy, *branches, "--format", "parquet", "--shard", f"{i}/2", "--out", tmp_path / f"s{i}")
    assert "12 frames of 2 shards" in call("merge", tmp_path / "s1", tmp_path / "s2", "--out", tmp_path / "all")
    assert call("view", tmp_path / "all", "--limit", 1).strip().endswith("f00.png")
    call("export", tmp_path / "all", "--to", "folder", "--out", tmp_path / "files")
    first, second = (json.loads(call("eval", toy, tmp_path / name, "--json")) for name in ("all", "files"))
    assert first["results"][0]["metrics"] == second["results"][0]["metrics"]
    call("eval", toy, tmp_path / "all", "--out", tmp_path / "report")
    assert "Settings of all" in (tmp_path / "report" / "report.html").read_text()


def test_a_dataset_that_moved_is_named(root: Path, tmp_path: Path) -> None:
    from lcf3d.cli.export import dataset_of_run

    run = fused(root, tmp_path / "run")
    path = run / "run.json"
    path.write_text(path.read_text().replace(str(root / "data"), str(tmp_path / "gone")))
    with pytest.raises(ConfigError, match="name it with --dataset"):
        dataset_of_run(run, None)
    assert dataset_of_run(run, f"toy:{root / 'data'}")[1].startswith("toy:")
    with pytest.raises(ConfigError, match="no folder of 'lcf3d run'"):
        dataset_of_run(tmp_path, None)

"""Datasets, results and runs in other places: the memory, archives and a server that speaks S3."""

import json
import multiprocessing
import os
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import lcf3d
from lcf3d.cli.app import app
from lcf3d.errors import ConfigError, DatasetError, Lcf3dError
from lcf3d.files import write_text
from lcf3d.remote import mirror
from lcf3d.remote.places import cache_folder, fetched, legible, local, local_file, remove
from lcf3d.remote.urls import below, url_of
from lcf3d.run.shards import merge_shards
from tests.datasets.kitti_folder import make_kitti, make_results
from tests.remote.conftest import pack, upload


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder with ``kitti`` and the results ``lidar`` and ``camera``."""
    make_kitti(tmp_path / "data" / "kitti")
    for source, name in zip(make_results(tmp_path), ("lidar", "camera"), strict=True):
        os.replace(source, tmp_path / "data" / name)
    return tmp_path / "data"


def fused(base: str, out: str | Path, **options) -> dict:
    return lcf3d.run(f"kitti:{base}/kitti", f"results:{base}/lidar", f"results:{base}/camera", out, **options)


def content(folder: Path) -> dict[str, bytes]:
    """Bytes by path, without the names of places that ``run.json`` holds, and what is hidden."""
    files = [p for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".")]
    return {str(p.relative_to(folder)): p.read_bytes() for p in files if p.name != "run.json"}


def stored(files, place: str) -> dict[str, bytes]:
    names = [p for p in files.find(place) if not p.endswith("run.json")]
    return {p.split(place.strip("/") + "/")[-1]: files.cat(p) for p in names}


@pytest.mark.parametrize("form", ["folder", "parquet"])
def test_a_run_that_lies_elsewhere_is_the_same(data: Path, memory, tmp_path: Path, form: str) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow")
    upload(memory, data, "/drives")
    fused(str(data), tmp_path / "here", form=form)
    counts = fused("memory://drives", "memory://drives/out", form=form)
    assert counts["out"] == "memory://drives/out"
    assert stored(memory, "/drives/out") == content(tmp_path / "here")
    first, second = lcf3d.read_run(tmp_path / "here"), lcf3d.read_run("memory://drives/out")
    assert {k: v.to_json() for k, v in first.items()} == {k: v.to_json() for k, v in second.items()}
    one = lcf3d.evaluate(f"kitti:{data / 'kitti'}", tmp_path / "here").to_json()
    assert lcf3d.evaluate("kitti:memory://drives/kitti", "memory://drives/out").to_json() == one


def test_the_command_line_on_s3(data: Path, s3, tmp_path: Path) -> None:
    upload(s3, data, "drives")

    def call(*arguments: object) -> str:
        result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.stdout

    base = "s3://drives"
    branches = ("--lidar", f"results:{base}/lidar", "--camera", f"results:{base}/camera")
    assert f"results in {base}/out" in call("run", f"kitti:{base}/kitti", *branches, "--out", f"{base}/out")
    fused(str(data), tmp_path / "here")
    assert stored(s3, "drives/out") == content(tmp_path / "here")
    assert json.loads(s3.cat("drives/out/run.json"))["dataset"] == "kitti:s3://drives/kitti"
    shown = json.loads(call("eval", f"kitti:{base}/kitti", f"{base}/out", "--out", f"{base}/report", "--json"))
    assert shown["results"]
    assert b"<html" in s3.cat("drives/report/report.html")
    assert call("view", f"{base}/out", "--limit", 1, "--out", tmp_path / "one.png").strip().endswith("one.png")
    call("export", f"{base}/out", "--to", "coco", "--out", f"{base}/labels/coco.json")
    images = json.loads(s3.cat("drives/labels/coco.json"))["images"]
    assert images[0]["file_name"] == f"{base}/kitti/training/image_2/000000.png"
    for i in (1, 2):
        call("run", f"kitti:{base}/kitti", *branches, "--shard", f"{i}/2", "--out", f"{base}/part-{i}")
    call("merge", f"{base}/part-1", f"{base}/part-2", "--out", f"{base}/merged")
    assert stored(s3, "drives/merged") == content(tmp_path / "here")


def test_only_what_is_opened_is_fetched(data: Path, memory, own_cache: Path) -> None:
    upload(memory, data, "/drives")
    fused("memory://drives", "memory://drives/out", recovery="off")
    (folder,) = own_cache.glob("remote/memory-drives-kitti-*")
    scans = list(folder.glob("training/velodyne/*.bin"))
    assert len(scans) == 3
    for scan in scans:
        # its size is known, its content is not here and takes no room
        assert scan.stat().st_size == (data / "kitti" / "training" / "velodyne" / scan.name).stat().st_size
        assert mirror.is_absent(str(scan))
        assert scan.stat().st_blocks == 0
    assert scans[0].read_bytes() == (data / "kitti" / "training" / "velodyne" / scans[0].name).read_bytes()
    assert not mirror.is_absent(str(scans[0]))


def test_runs_go_on_where_they_were(data: Path, s3) -> None:
    upload(s3, data, "drives")
    fused("s3://drives", "s3://drives/out")
    s3.rm_file("drives/out/provenance/night_7.json")
    with pytest.raises(ConfigError, match="not empty; pass --resume"):
        fused("s3://drives", "s3://drives/out")
    assert fused("s3://drives", "s3://drives/out", resume=True)["already_done"] == 2
    assert s3.exists("drives/out/provenance/night_7.json")
    # a run of fewer frames in its place leaves nothing of the old one
    fused("s3://drives", "s3://drives/out", overwrite=True, frames=("000001",))
    assert {Path(p).stem for p in s3.find("drives/out/provenance")} == {"000001"}


def test_what_changes_elsewhere_is_read_anew(memory, tmp_path: Path) -> None:
    memory.pipe({"/place/a.txt": b"one", "/place/b.txt": b"left", "/place/deep/c.txt": b"c"})
    folder = local("memory://place")
    assert [(folder / n).read_text() for n in ("a.txt", "deep/c.txt")] == ["one", "c"]
    memory.pipe("/place/a.txt", b"two")
    memory.rm("/place/b.txt")
    assert local("memory://place") == folder
    assert (folder / "a.txt").read_text() == "two"
    assert not (folder / "b.txt").exists()
    # what has not changed is not fetched again
    assert not mirror.is_absent(str(folder / "deep" / "c.txt"))
    # gone since it was listed
    memory.pipe("/place/new.txt", b"new")
    local("memory://place")
    memory.rm("/place/new.txt")
    with pytest.raises(DatasetError, match=r"^memory://place/new.txt does not exist$"):
        (folder / "new.txt").read_bytes()


def test_files_written_and_removed(memory) -> None:
    folder = local("memory://place/out", new=True)
    write_text(folder / "sub" / "a.txt", "text")
    assert memory.cat("/place/out/sub/a.txt") == b"text"
    remove(folder / "sub" / "a.txt")
    assert not memory.exists("/place/out/sub/a.txt")
    assert not (folder / "sub" / "a.txt").exists()
    write_text(local_file("memory://place/one.json"), "{}")
    assert memory.cat("/place/one.json") == b"{}"


def test_links_and_libraries_that_open_files_themselves(memory, tmp_path: Path) -> None:
    memory.pipe({"/place/x/a.bin": b"12345678", "/place/x/b.bin": b"87654321"})
    folder = local("memory://place")
    (tmp_path / "link").symlink_to(folder / "x", target_is_directory=True)
    assert np.fromfile(tmp_path / "link" / "a.bin", np.uint8).tolist() == list(b"12345678")
    assert not mirror.is_absent(str(fetched(folder / "x" / "b.bin")))
    # whatever stands there is told by its size, and by its time
    old = tmp_path / "old"
    old.write_bytes(b"of 1970")
    os.utime(old, (0, 0))
    assert old.read_bytes() == b"of 1970"


def test_databases(memory, tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "bag.db3")) as made:
        made.execute("create table topics (name text)")
        made.execute("insert into topics values ('/lidar')")
        made.commit()
    for name in ("a", "b"):
        memory.pipe(f"/place/{name}.db3", (tmp_path / "bag.db3").read_bytes())
    folder = local("memory://place")
    for place, uri in ((folder / "a.db3", False), (f"file:{folder / 'b.db3'}?immutable=1", True)):
        with closing(sqlite3.connect(place, uri=uri)) as read:
            assert read.execute("select name from topics").fetchall() == [("/lidar",)]


def test_what_is_written_here_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"^s3://bucket/x.json lies elsewhere"):
        write_text(Path("s3://bucket/x.json"), "text")
    assert list(tmp_path.iterdir()) == []


def test_a_file_and_an_empty_file(memory) -> None:
    memory.pipe({"/place/one.json": b"[1]", "/place/empty.txt": b""})
    assert json.loads(local("memory://place/one.json").read_text()) == [1]
    assert (local("memory://place") / "empty.txt").read_bytes() == b""


@pytest.mark.parametrize("url", ["{}", "zip://::{}", "zip://set::{}"])
def test_archives(data: Path, tmp_path: Path, url: str) -> None:
    if "set" in url:
        (tmp_path / "above").mkdir()
        os.replace(data / "kitti", tmp_path / "above" / "set")
        pack(tmp_path / "above", tmp_path / "kitti.zip")
    else:
        pack(data / "kitti", tmp_path / "kitti.zip")
    text = f"kitti:{url.format(tmp_path / 'kitti.zip')}"
    out = tmp_path / "out"
    assert lcf3d.run(text, f"results:{data}/lidar", f"results:{data}/camera", out)["frames"] == 3
    if "set" not in url:
        fused(str(data), tmp_path / "here")
        assert content(out) == content(tmp_path / "here")


def test_an_archive_in_a_bucket(data: Path, s3, tmp_path: Path) -> None:
    s3.put_file(str(pack(data / "kitti", tmp_path / "kitti.zip")), "drives/kitti.zip")
    dataset = lcf3d.open_dataset("s3://drives/kitti.zip", split="val")
    assert len(dataset.frame("night_7").points) == len(
        lcf3d.open_dataset(f"kitti:{data / 'kitti'}").frame("night_7").points
    )


def test_the_oldest_files_go(memory, monkeypatch: pytest.MonkeyPatch) -> None:
    memory.pipe({f"/place/{i:03d}": bytes(1000) for i in range(128)})
    monkeypatch.setenv("LCF3D_CACHE_GB", str(40_000 / (1 << 30)))
    monkeypatch.setattr(mirror, "AHEAD", 0)
    folder = local("memory://place")
    for path in sorted(folder.glob("[0-9]*")):
        assert path.read_bytes() == bytes(1000)
    here = [not mirror.is_absent(str(path)) for path in sorted(folder.glob("[0-9]*"))]
    assert sum(here) < 75
    assert here[-1]
    assert not here[0]
    # and come back when they are asked for
    assert (folder / "000").read_bytes() == bytes(1000)


# forkserver is spawn with a shorter start
@pytest.mark.parametrize("method", [m for m in multiprocessing.get_all_start_methods() if m != "forkserver"])
def test_processes_of_any_kind_fetch(
    data: Path, s3, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    upload(s3, data, "drives")
    monkeypatch.setattr("lcf3d.run.frames.get_start_method", lambda allow_none: method)
    fused("s3://drives", "s3://drives/out", jobs=2)
    fused(str(data), tmp_path / "here")
    assert stored(s3, "drives/out") == content(tmp_path / "here")


def test_names_that_no_file_can_have_are_told(memory, caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    memory.store["/place/../../x"] = memory.store.get("/place/ok") or _stored(memory, "/place/ok")
    memory.store["/place/a//b"] = memory.store["/place/ok"]
    folder = local("memory://place")
    assert [p.name for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".")] == ["ok"]
    assert "memory://place: 2 names cannot be those of files and are left out" in caplog.text
    assert not (tmp_path / "x").exists()


def _stored(memory, path: str):
    memory.pipe(path, b"fine")
    return memory.store[path]


def run_arguments(dataset: str, out: str, data: Path) -> tuple[object, ...]:
    return ("run", dataset, "--lidar", f"results:{data}/lidar", "--camera", f"results:{data}/camera", "--out", out)


def test_places_that_are_not_there(data: Path, s3, tmp_path: Path, refused_by) -> None:
    said = refused_by(*run_arguments("kitti:s3://nobody/kitti", str(tmp_path / "out"), data))
    assert said == "error: s3://nobody/kitti does not exist"
    for place in ("s3://nobody", "s3://drives/kitti"):
        with pytest.raises(DatasetError, match=f"^{place} does not exist$"):
            local(place)
    with pytest.raises(DatasetError, match=r"^s3://nobody/out does not exist$"):
        local("s3://nobody/out", new=True)
    assert local("s3://drives/out", new=True).is_dir()
    with pytest.raises(DatasetError, match=r"dataset folder .*kitti does not exist"):
        lcf3d.open_dataset(f"kitti:{tmp_path}/kitti")


def test_buckets_that_may_not_be_read(data: Path, s3, s3_server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import requests

    upload(s3, data / "kitti", "drives/kitti")
    requests.post(f"{s3_server}/moto-api/reset-auth", data="0", timeout=10)
    try:
        for place in ("s3://drives/kitti", "s3://drives/out"):
            with pytest.raises(DatasetError, match=f"^{place} (may not be|cannot be) read"):
                local(place, new=place.endswith("out"))
    finally:
        requests.post(f"{s3_server}/moto-api/reset-auth", data="inf", timeout=10)


def test_messages_name_the_place(data: Path, s3, tmp_path: Path, refused_by) -> None:
    (data / "kitti" / "training" / "calib" / "000001.txt").write_text("P2: 1 2 3\n")
    upload(s3, data, "drives")
    said = refused_by(*run_arguments("kitti:s3://drives/kitti", str(tmp_path / "out"), data))
    assert "s3://drives/kitti/training/calib/000001.txt" in said
    assert "cache" not in said
    assert legible(f"{cache_folder()}/other/x is not there") == f"{cache_folder()}/other/x is not there"


def test_what_is_not_installed_is_named(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(Lcf3dError, match=r"s3://drives/x needs s3fs; install it with: pip install 'lcf3d\[fleet\]'"):
        local("s3://drives/x")
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(
        Lcf3dError, match=r"memory://drives needs fsspec; install it with: pip install 'lcf3d\[fleet\]'"
    ):
        local("memory://drives")


def test_urls_that_nobody_knows() -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        local("nonsense://drives")


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("s3://bucket/a", "s3://bucket/a"),
        ("s3:/bucket/a", "s3://bucket/a"),
        (Path("s3://bucket/a"), "s3://bucket/a"),
        (Path("zip://in/side::s3://bucket/a.zip"), "zip://in/side::s3://bucket/a.zip"),
        (Path("zip://::/data/a.zip"), "zip://::/data/a.zip"),
        ("gs://bucket/a.zip", "zip://::gs://bucket/a.zip"),
        ("/data/a", None),
        ("a.zip", None),
        ("kitti:/data", None),
        ("results:s3", None),
    ],
)
def test_urls(text: str, url: str | None) -> None:
    assert url_of(text) == url


def test_urls_below() -> None:
    assert below("s3://bucket", "a/b") == "s3://bucket/a/b"
    assert below("zip://::s3://bucket/a.zip", "x") == "zip://x::s3://bucket/a.zip"
    assert below("zip://in::s3://bucket/a.zip", "x") == "zip://in/x::s3://bucket/a.zip"


def test_shards_elsewhere_that_are_missing(data: Path, memory) -> None:
    upload(memory, data, "/drives")
    fused("memory://drives", "memory://drives/part-1", shard="1/2")
    with pytest.raises(ConfigError, match="1 of 2 shards are missing: 2/2"):
        merge_shards([local("memory://drives/part-1")], local("memory://drives/all", new=True))

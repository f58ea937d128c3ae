"""Run folders: one writer, recovery after kills, and nothing deleted that the run did not write."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lcf3d.datasets.plain_results import PlainWriter
from lcf3d.errors import ConfigError, FormatError
from lcf3d.fusion.config import FusionConfig
from lcf3d.processes import lock_folder, unlock_folder
from lcf3d.run.folder import RunFolder

CONFIG = FusionConfig.preset("kitti")
RUN = {"lcf3d": "0", "frames": ["a"]}


def begin(path: Path, resume: bool = False, overwrite: bool = False) -> RunFolder:
    folder = RunFolder(path, PlainWriter(path))
    folder.begin(CONFIG, RUN, resume=resume, overwrite=overwrite)
    folder.release()
    return folder


@pytest.mark.parametrize("left", [(), ("run.json",), ("run.json", "config.yaml")])
@pytest.mark.parametrize("how", ["resume", "overwrite"])
def test_a_run_killed_while_it_began_can_go_on(tmp_path: Path, left: tuple[str, ...], how: str) -> None:
    begin(tmp_path)
    for name in {"run.json", "config.yaml"} - set(left):
        (tmp_path / name).unlink()
    (tmp_path / ".lcf3d-tmp.4999999.config.yaml").write_text("half")
    begin(tmp_path, **{how: True})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.yaml", "run.json"]


def test_overwriting_deletes_only_what_the_run_wrote(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "000001.json").write_text("somebody's")
    out = tmp_path / "out"
    begin(out)
    (out / "provenance").mkdir()
    (out / "provenance" / "000001.json").write_text("{}")
    (out / "README.txt").write_text("mine")
    (out / "data").symlink_to(foreign)
    begin(out, overwrite=True)
    assert (foreign / "000001.json").read_text() == "somebody's"
    assert (out / "README.txt").is_file()
    assert not (out / "provenance" / "000001.json").exists()
    (out / "data").unlink()
    (out / "data").mkdir()
    (out / "provenance" / "000001.json").write_text("{}")
    for name in ("000001.json", "notes.json"):
        (out / "data" / name).write_text("{}")
    begin(out, overwrite=True)
    assert [p.name for p in (out / "data").iterdir()] == ["notes.json"]


def test_one_writer_at_a_time_and_the_dead_keep_nothing(tmp_path: Path) -> None:
    code = (
        "import sys, time, pathlib; from lcf3d.processes import lock_folder; "
        "lock_folder(pathlib.Path(sys.argv[1])); print('locked', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=-1)
    assert other.stdout is not None
    assert other.stdout.readline() == b"locked\n"
    other.send_signal(signal.SIGSTOP)  # alive, though it does not move
    with pytest.raises(ConfigError, match=f"is being written by process {other.pid} on"):
        begin(tmp_path)
    other.kill()
    other.wait()
    begin(tmp_path)
    lock_folder(tmp_path)
    lock_folder(tmp_path)
    unlock_folder(tmp_path)


def test_frame_ids_lead_nowhere_else(tmp_path: Path) -> None:
    folder = begin(tmp_path / "out")
    for name in ("../x", "/etc/passwd", "a/../../b"):
        with pytest.raises(FormatError, match="must not lead elsewhere"):
            folder.provenance_path(name)


def test_a_provenance_that_refers_to_nothing_is_refused(tmp_path: Path) -> None:
    folder = begin(tmp_path)
    path = folder.provenance_path("a")
    path.parent.mkdir()
    path.write_text(json.dumps({"cameras": [], "notes": []}))
    with pytest.raises(FormatError, match=r"a\.json cannot be read as the provenance of a frame"):
        folder.read("a")


WORKERS = """
import os, sys, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from lcf3d.processes import end_with_parent, workers
def sleep(_):
    os.write(1, b"%d\\n" % os.getpid())
    time.sleep(60)
if __name__ == "__main__":
    pool = ProcessPoolExecutor(2, mp_context=get_context("fork"), initializer=end_with_parent)
    with workers("sleeping"):
        list(pool.map(sleep, range(2)))
"""


@pytest.mark.parametrize("victim", ["parent", "worker"])
def test_workers_and_their_parent_end_together(tmp_path: Path, victim: str) -> None:
    (tmp_path / "w.py").write_text(WORKERS)
    parent = subprocess.Popen([sys.executable, tmp_path / "w.py"], stdout=-1, stderr=-1)
    assert parent.stdout is not None
    assert parent.stderr is not None
    children = [int(parent.stdout.readline()) for _ in range(2)]
    os.kill(parent.pid if victim == "parent" else children[0], signal.SIGKILL)
    parent.wait(20)
    if victim == "worker":
        assert parent.stderr.read().decode().strip().endswith("while sleeping")
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and any(Path(f"/proc/{child}").exists() for child in children):
        time.sleep(0.1)
    # whoever has no parent left may wait for init to take note, but runs no more
    states = [p.read_text().split()[2] for c in children if (p := Path(f"/proc/{c}/stat")).exists()]
    assert set(states) <= {"Z"}

"""Compiled functions work without a place for their cache, where it is damaged, and where other files have changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

CODE = """
from lcf3d.kernels import kernel
@kernel
def twice(x):
    return 2 * x
print(twice(21))
"""


def run(folder: Path, **changes: str) -> tuple[str, str]:
    (folder / "module.py").write_text(CODE)
    environment = {**os.environ, **changes}
    done = subprocess.run([sys.executable, "module.py"], cwd=folder, env=environment, capture_output=True, check=False)
    return done.stdout.decode().strip(), done.stderr.decode()


def test_without_a_place_for_the_cache(tmp_path: Path) -> None:
    # a file where a folder would have to be made: not even root can
    (tmp_path / "file").touch()
    (tmp_path / "__pycache__").touch()
    answer, said = run(tmp_path, HOME=str(tmp_path / "file"), XDG_CACHE_HOME=str(tmp_path / "file"), NUMBA_CACHE_DIR="")
    assert answer == "42"
    assert said.count("not kept") == said.count("\n") == 1, said


def test_damaged_cache_files_are_rebuilt(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert run(tmp_path, NUMBA_CACHE_DIR=str(cache))[0] == "42"
    files = list(cache.rglob("*.nb[ic]"))
    assert files
    for path in files:
        path.write_bytes(path.read_bytes()[:20])
    assert run(tmp_path, NUMBA_CACHE_DIR=str(cache)) == ("42", "")
    assert all(path.stat().st_size > 20 for path in files)


CALLED = """
from lcf3d.kernels import kernel
OFFSET = 1
@kernel
def inner(x):
    return 2 * x
"""
CALLS = """
from called import OFFSET, inner
from lcf3d.kernels import kernel
@kernel
def outer(x):
    return inner(x) + OFFSET
print(outer(20), sum(outer.stats.cache_hits.values()))
"""


def test_a_change_in_another_file_is_seen(tmp_path: Path) -> None:
    """A function of one file calls one of another, whose code, or a constant of it, changes."""

    def answers(called: str) -> str:
        (tmp_path / "called.py").write_text(called)
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        # without .pyc files: two versions of a second and a size are one to Python
        command = [sys.executable, "-B", "calls.py"]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=True).stdout.decode()

    (tmp_path / "calls.py").write_text(CALLS)
    assert answers(CALLED) == "41 0\n"
    assert answers(CALLED) == "41 1\n"
    assert answers(CALLED.replace("2 * x", "3 * x")) == "61 0\n"
    assert answers(CALLED.replace("OFFSET = 1", "OFFSET = 5")) == "45 0\n"
    # what it does not use may change
    assert answers(CALLED.replace("OFFSET = 1", "OFFSET = 5\nUNUSED = 2")) == "45 1\n"

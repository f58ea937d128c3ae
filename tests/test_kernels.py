"""Compiled functions work where there is no place for their cache, and where it is damaged."""

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

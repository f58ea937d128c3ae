"""Fixtures that several test folders use."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# in CI the same examples every time, so that a run says something about the change; elsewhere new ones are looked for
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")

# tests run side by side: torch and BLAS must not fight over the cores, and one thread adds in one order
for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the real data; tests that need it are marked ``real`` and skipped where it is absent."""
    if not (SHARED / "data").is_dir():
        pytest.skip("../shared/data is absent")
    return SHARED


@pytest.fixture
def refused_by(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What the command says; it is to end with code 2."""
    from lcf3d.cli.app import main

    def call(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["lcf3d", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 2
        return "\n".join(line for line in capsys.readouterr().err.splitlines() if not line.startswith("note:"))

    return call

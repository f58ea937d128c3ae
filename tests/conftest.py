"""Fixtures that several test folders use."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# in CI the same examples every time, so that a run says something about the change; elsewhere new ones are looked for
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the real data; tests that need it are marked ``real`` and skipped where it is absent."""
    if not (SHARED / "data").is_dir():
        pytest.skip("../shared/data is absent")
    return SHARED

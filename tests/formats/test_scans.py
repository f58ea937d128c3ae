"""Scans without a header: what they hold is told from their values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import FormatError
from lcf3d.formats import scans
from lcf3d.formats.scans import read_scan, unit_intensity


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.c_[rng.uniform(-60, 60, (4000, 2)), rng.normal(-1.7, 0.3, 4000), rng.uniform(0, 1, 4000)].astype("<f4")


def test_plain_scan_is_read_bit_by_bit(tmp_path: Path, points: np.ndarray) -> None:
    points.tofile(tmp_path / "a.bin")
    assert (read_scan(tmp_path / "a.bin") == points).all()


@pytest.mark.parametrize("columns", [5, 6, 7])
@pytest.mark.parametrize("count", [3999, 4000])
def test_more_columns_are_told(tmp_path: Path, points: np.ndarray, columns: int, count: int) -> None:
    wide = np.c_[points[:count], np.zeros((count, columns - 4))].astype("<f4")
    wide.tofile(tmp_path / "a.bin")
    assert (read_scan(tmp_path / "a.bin") == wide).all()


def test_ring_numbers_do_not_mislead(tmp_path: Path, points: np.ndarray) -> None:
    wide = np.c_[points, np.arange(4000) % 32].astype("<f4")
    wide.tofile(tmp_path / "a.bin")
    assert (read_scan(tmp_path / "a.bin", columns=5) == wide).all()
    assert (read_scan(tmp_path / "a.bin", columns=4) == wide).all()


def test_float64_and_npy(tmp_path: Path, points: np.ndarray) -> None:
    points.astype("<f8").tofile(tmp_path / "a.bin")
    np.save(tmp_path / "b.npy", points)
    (tmp_path / "b.npy").rename(tmp_path / "renamed.bin")
    assert (read_scan(tmp_path / "a.bin") == points).all()
    assert (read_scan(tmp_path / "renamed.bin") == points).all()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"LASF" + b"\1" * 4092, "LAS"),
        (b"# .PCD v0.7" + b"\1" * 4085, "PCD"),
        (b"ply\nformat", "PLY"),
        (np.random.default_rng(0).bytes(64000), "not a scan of 4"),
        (b"\0" * 999, "cut off"),
    ],
)
def test_other_files_are_refused_in_one_sentence(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "a.bin").write_bytes(content)
    with pytest.raises(FormatError, match=said):
        read_scan(tmp_path / "a.bin")


def test_intensity_of_255_is_scaled_and_said_once(
    points: np.ndarray, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scans, "_said", set())
    bytes_ = points * np.array([1, 1, 1, 255], dtype=np.float32)
    assert np.allclose(unit_intensity(bytes_, Path("a.bin")), points, atol=1e-6)
    unit_intensity(bytes_, Path("b.bin"))
    assert len(caplog.messages) == 1
    with pytest.raises(FormatError, match="intensities reach"):
        unit_intensity(points * np.array([1, 1, 1, 1000], dtype=np.float32), Path("a.bin"))

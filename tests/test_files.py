"""Whole files or none, text without marks, listings without hidden files, names that stay inside."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.errors import FormatError
from lcf3d.files import (
    atomic_path,
    inside,
    list_files,
    read_json,
    read_text,
    reading,
    remove_left_overs,
    write_text,
)


def test_half_written_files_are_hidden_and_go_with_their_dead_owner(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "000001.txt") as temporary:
        temporary.write_text("half")
        assert list_files(tmp_path, ".txt") == []
        assert not list(tmp_path.glob("[!.]*.txt"))
        assert remove_left_overs(tmp_path) == 0  # its owner lives
    assert [p.name for p in list_files(tmp_path)] == ["000001.txt"]
    # a process number that no system gives
    (tmp_path / ".lcf3d-tmp.4999999.000002.txt").write_text("half")
    assert remove_left_overs(tmp_path) == 1
    assert sorted(os.listdir(tmp_path)) == ["000001.txt"]


def test_listing_leaves_out_what_other_programs_hide(tmp_path: Path) -> None:
    for name in ("000002.txt", "000001.txt", "._000001.txt", ".DS_Store", "000001.txt~", "000003.TXT", "x.bin"):
        (tmp_path / name).touch()
    assert [p.name for p in list_files(tmp_path, ".txt")] == ["000001.txt", "000002.txt", "000003.TXT"]
    assert list_files(tmp_path / "nowhere", ".txt") == []


def test_text_loses_its_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_text(tmp_path / "a.json") == '{"a": 1}'
    assert read_json(tmp_path / "a.json") == {"a": 1}


@pytest.mark.parametrize("text", ["[" * 100000, "9" * 5000, "{", '{"a": "\\ud', "\x00"])
def test_broken_json_is_one_short_sentence(tmp_path: Path, text: str) -> None:
    write_text(tmp_path / "a.json", text)
    with pytest.raises(FormatError) as caught:
        read_json(tmp_path / "a.json")
    assert str(tmp_path / "a.json") in str(caught.value)
    assert len(str(caught.value)) < 400


def test_pipes_and_giants_are_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FormatError, match="pipe"):
        read_text(tmp_path / "pipe")
    with open(tmp_path / "giant", "wb") as file:
        file.truncate(64 << 30)
    with pytest.raises(FormatError, match="LCF3D_MAX_FILE_GB"):
        read_text(tmp_path / "giant")
    monkeypatch.setenv("LCF3D_MAX_FILE_GB", "1e-9")
    (tmp_path / "small").write_text("more than one byte")
    with pytest.raises(FormatError, match="LCF3D_MAX_FILE_GB"):
        read_text(tmp_path / "small")


@pytest.mark.parametrize("name", ["../x", "/etc/x", "a/../../x", "..", "", "a\0b", "~root/x", "..\\x"])
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(FormatError, match="must not lead elsewhere"):
        inside(tmp_path, name)


@given(st.text())
def test_accepted_names_stay_inside(name: str) -> None:
    folder = Path("/some/folder")
    try:
        path = inside(folder, name, ".txt")
    except FormatError:
        return
    assert os.path.normpath(path).startswith("/some/folder/")


def test_any_error_of_a_reader_becomes_a_sentence_with_its_place() -> None:
    for error in (KeyError("boxes"), TypeError("x" * 5000), RecursionError(), OverflowError(), AttributeError("a")):
        with pytest.raises(FormatError, match=r"place\.json") as caught, reading("place.json", "a result file"):
            raise error
        assert len(str(caught.value)) < 300


def test_full_disk_names_the_file_that_was_to_be_written(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="--resume") as caught, atomic_path(tmp_path / "a.json"):
        raise OSError(28, "No space left on device", "something else")
    assert caught.value.filename == str(tmp_path / "a.json")

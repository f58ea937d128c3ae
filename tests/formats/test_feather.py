from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import FormatError, MissingExtraError
from lcf3d.formats.feather import TEXT, read_columns, write_columns

pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow (extra formats)")


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "t.feather"
    write_columns(path, {"n": np.array([3, 1]), "x": np.array([0.5, 2.0]), "name": np.array(["a", "b"], dtype=object)})
    return path


def test_columns_come_back_in_the_types_asked_for(table: Path) -> None:
    columns = read_columns(table, {"name": TEXT, "n": np.int32, "x": np.float32, "y": np.float64}, optional=("y",))
    assert list(columns) == ["name", "n", "x"]
    assert columns["name"].tolist() == ["a", "b"]
    assert (columns["n"].dtype, columns["x"].dtype) == (np.int32, np.float32)
    assert columns["x"].tolist() == [0.5, 2.0]


def test_half_floats_and_large_text(tmp_path: Path) -> None:
    path = tmp_path / "t.feather"
    pyarrow.feather.write_feather(
        pyarrow.table({"x": np.array([1.5], np.float16), "name": pyarrow.array(["log"], type=pyarrow.large_string())}),
        path,
    )
    columns = read_columns(path, {"x": np.float32, "name": TEXT})
    assert (columns["x"].tolist(), columns["name"].tolist()) == ([1.5], ["log"])


def test_what_is_wrong_is_said(table: Path, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"t.feather has no column tz_m; it holds n, x, name"):
        read_columns(table, {"n": np.int64, "tz_m": np.float64})
    with pytest.raises(FormatError, match="column name must hold numbers"):
        read_columns(table, {"name": np.float64})
    with pytest.raises(FormatError, match="column n must hold text"):
        read_columns(table, {"n": TEXT})
    with pytest.raises(FormatError, match="column x must hold whole numbers, got double"):
        read_columns(table, {"x": np.int64})
    with pytest.raises(FormatError, match=r"none.feather does not exist"):
        read_columns(tmp_path / "none.feather", {})
    (tmp_path / "text.feather").write_text("hello")
    with pytest.raises(FormatError, match="cannot be read as a feather file"):
        read_columns(tmp_path / "text.feather", {})
    whole = table.read_bytes()
    (tmp_path / "cut.feather").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FormatError, match="cannot be read as a feather file"):
        read_columns(tmp_path / "cut.feather", {})
    pyarrow.feather.write_feather(pyarrow.table({"x": pyarrow.array([1.0, None])}), tmp_path / "null.feather")
    with pytest.raises(FormatError, match="column x has 1 missing values"):
        read_columns(tmp_path / "null.feather", {"x": np.float64})


def test_without_pyarrow(table: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'lcf3d\[formats\]'"):
        read_columns(table, {"x": np.float64})

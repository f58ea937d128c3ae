"""The text of KITTI object files, parsed many files at a time and checked; `lcf3d.formats.kitti` gives it a meaning."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import FormatError, Lcf3dError
from lcf3d.files import read_text
from lcf3d.structures import BoolArray, FloatArray, IntArray

NO_SIZE = -1.0
NO_LOCATION = -1000.0
LABEL_COLUMNS = 15
RESULT_COLUMNS = 16

_BATCH = 256


def has_box3d(dimensions: FloatArray, locations: FloatArray) -> BoolArray:
    """(N,) whether (N, 3) sizes and locations are those of a 3D box, not the numbers for "unknown"."""
    # tracking labels write -1000 as size, because their columns of unknown numbers are in another order
    no_size = (dimensions == NO_SIZE).all(axis=1) | (dimensions == NO_LOCATION).all(axis=1)
    known: BoolArray = ~(no_size | (locations == NO_LOCATION).all(axis=1))
    return known


def parse_files(paths: Sequence[Path | None], columns: int) -> tuple[NDArray[np.str_], FloatArray, list[int]]:
    """All lines of the files, one after the other.

    Args:
        paths: None stands for an empty file.
        columns: number of columns of every line, `LABEL_COLUMNS` or `RESULT_COLUMNS`.

    Returns:
        (N,) first column, (N, columns - 1) numbers, and how many lines each file holds.

    Raises:
        DatasetError: a file does not exist.
        FormatError: a line is not what it should be; names file and line.
    """
    # in batches, because the fields of a large folder as Python strings would fill the memory
    batches = [_parse_batch(paths[i : i + _BATCH], columns) for i in range(0, max(len(paths), 1), _BATCH)]
    names, values, counts = zip(*batches, strict=True)
    return np.concatenate(names), np.concatenate(values), [count for part in counts for count in part]


def parse_tracking(path: Path) -> tuple[IntArray, IntArray, NDArray[np.str_], FloatArray]:
    """The lines of a tracking label file: two more columns, frame number and track id, before those of a label.

    Returns:
        (N,) frame numbers, (N,) track ids (-1 for none), (N,) classes and the (N, 14) numbers that follow; truncation
        is written in levels there and left as it is.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is not what it should be; names file and line.
    """
    lines = [(i, fields) for i, line in enumerate(read_text(path).splitlines(), 1) if (fields := line.split())]
    numbers = np.empty((len(lines), LABEL_COLUMNS + 1))
    for row, (number, fields) in enumerate(lines):
        problem = _text_problem([fields[0], *fields[1:2], *fields[3:]], LABEL_COLUMNS + 1) if len(fields) > 2 else ""
        if len(fields) != LABEL_COLUMNS + 2:
            problem = f"expected the {LABEL_COLUMNS + 2} columns of a tracking label, got {len(fields)}"
        elif not problem and not (fields[0].isdigit() and fields[1].lstrip("-").isdigit()):
            problem = f"frame number and track id must be whole numbers, got {fields[0]} {fields[1]}"
        if problem:
            raise FormatError(f"{path}:{number}: {problem}")
        numbers[row] = [float(fields[0]), float(fields[1]), *map(float, fields[3:])]
    for row in _suspicious_rows(numbers[:, 2:]):
        raise FormatError(f"{path}:{lines[row][0]}: {_value_problem(numbers[row, 2:])}")
    names = np.array([fields[2] for _, fields in lines], dtype=np.str_)
    return numbers[:, 0].astype(np.int64), numbers[:, 1].astype(np.int64), names, numbers[:, 2:]


def _parse_batch(paths: Sequence[Path | None], columns: int) -> tuple[NDArray[np.str_], FloatArray, list[int]]:
    rows: list[list[str]] = []
    counts = []
    for path in paths:
        before = len(rows)
        if path is not None:
            rows += [fields for line in read_text(path).splitlines() if (fields := line.split())]
        counts.append(len(rows) - before)
    try:
        if set(map(len, rows)) - {columns}:
            raise ValueError
        names = np.array([row[0] for row in rows], dtype=np.str_)
        values = np.array([float(field) for row in rows for field in row[1:]]).reshape(-1, columns - 1)
    except ValueError:
        for index, row in enumerate(rows):
            problem = _text_problem(row, columns)
            if problem:
                raise _line_error(paths, counts, index, problem) from None
        raise
    for index in _suspicious_rows(values):
        raise _line_error(paths, counts, int(index), _value_problem(values[index]))
    return names, values, counts


def _suspicious_rows(values: FloatArray) -> IntArray:
    """Indices of the rows that `_value_problem` has a complaint about."""
    with np.errstate(invalid="ignore"):
        bad = ~np.isfinite(values).all(axis=1)
        bad |= values[:, 1] != np.round(values[:, 1])
        bad |= (values[:, 5] < values[:, 3]) | (values[:, 6] < values[:, 4])
        bad |= (values[:, 7:10] < 0).any(axis=1) & has_box3d(values[:, 7:10], values[:, 10:13])
    return np.flatnonzero(bad)


def _value_problem(row: FloatArray) -> str:
    if not np.isfinite(row).all():
        column = int(np.flatnonzero(~np.isfinite(row))[0])
        return f"column {column + 2} is {row[column]}, expected a finite number"
    if row[1] != np.round(row[1]):
        return f"occlusion must be a whole number, got {row[1]:g}"
    if row[5] < row[3] or row[6] < row[4]:
        return "2D box is reversed, expected x1 <= x2 and y1 <= y2, got " + " ".join(f"{v:g}" for v in row[3:7])
    return "height, width and length must not be negative, got " + " ".join(f"{v:g}" for v in row[7:10])


def _text_problem(fields: list[str], columns: int) -> str:
    """What is wrong with the split line, or an empty string."""
    if len(fields) != columns:
        kind = "a result (with a score)" if columns == RESULT_COLUMNS else "a label (without a score)"
        return f"expected the {columns} columns of {kind}, got {len(fields)}"
    for number, field in enumerate(fields[1:], start=2):
        try:
            float(field)
        except ValueError:
            return f"column {number} must be a number, got {field!r}"
    return ""


def _line_error(paths: Sequence[Path | None], counts: list[int], index: int, problem: str) -> Lcf3dError:
    """The error for the ``index``-th object, with its file and line number."""
    starts = np.cumsum([0, *counts])
    file = int(np.searchsorted(starts, index, side="right")) - 1
    path = paths[file]
    assert path is not None  # it holds an object
    filled = [i for i, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    return FormatError(f"{path}:{filled[index - int(starts[file])]}: {problem}")

"""Feather tables as NumPy columns (Apache Arrow files; extra ``formats``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import FormatError, MissingExtraError
from lcf3d.files import atomic_path, reading, require_file, shortened
from lcf3d.remote.places import fetched

TEXT = np.dtype(object)
"""The type to ask for in `read_columns` where a column holds text."""


def read_columns(path: Path, columns: Mapping[str, Any], optional: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Columns of a feather file by name.

    Args:
        path: the file.
        columns: the NumPy type of each column that is wanted; `TEXT` for text, which comes as an object array.
        optional: those of them that may be absent; they are left out of the result.

    Raises:
        FormatError: the file is absent, no feather file, lacks a column, or a column has missing values or values of
            another kind. The message names file and column.
        MissingExtraError: pyarrow is not installed.
    """
    arrow = _arrow("reading feather files")
    if not fetched(path).exists():
        raise FormatError(f"{path} does not exist")
    require_file(path)
    try:
        with reading(path, "a feather file"), arrow.OSFile(str(path)) as file:
            present = arrow.ipc.open_file(file).schema.names
            absent = [name for name in columns if name not in present and name not in optional]
            if absent:
                raise FormatError(
                    f"{path} has no column {', '.join(absent)}; it holds {', '.join(present) or 'no columns'}"
                )
            wanted = [i for i, name in enumerate(present) if name in columns]
            options = arrow.ipc.IpcReadOptions(included_fields=wanted)
            table = arrow.ipc.open_file(file, options=options).read_all()
            # what is damaged would be read beyond its end
            table.validate(full=True)
    except OSError as error:
        raise FormatError(f"{path} cannot be read as a feather file ({shortened(error)})") from None
    with reading(path, "a feather file"):
        return {name: _column(path, table, name, kind) for name, kind in columns.items() if name in present}


def write_columns(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns of equal length as a feather file, whole or not at all.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    arrow = _arrow("writing feather files")
    table = arrow.table({name: arrow.array(values) for name, values in columns.items()})
    with atomic_path(path) as temporary:
        arrow.feather.write_feather(table, temporary)


def _column(path: Path, table: Any, name: str, kind: Any) -> NDArray[Any]:
    column = table.column(name)
    if column.null_count:
        raise FormatError(
            f"{path}: column {name} has {column.null_count} missing values; fill them in or drop the rows"
        )
    values = column.to_numpy()
    wanted = np.dtype(kind)
    text = not np.issubdtype(values.dtype, np.number)
    if text != (wanted == TEXT):
        raise FormatError(f"{path}: column {name} must hold {'text' if wanted == TEXT else 'numbers'}")
    if wanted.kind in "iu" and values.dtype.kind == "f":
        raise FormatError(f"{path}: column {name} must hold whole numbers, got {column.type}")
    with np.errstate(all="ignore"):
        return np.asarray(values).astype(wanted)


def _arrow(purpose: str) -> Any:
    try:
        import pyarrow
        import pyarrow.feather
        import pyarrow.ipc
    except ImportError:
        raise MissingExtraError("pyarrow", "formats", purpose) from None
    return pyarrow

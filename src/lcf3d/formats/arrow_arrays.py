"""Arrow arrays of numpy arrays, texts and lists, made of their buffers.

``pyarrow.array`` would first import pandas where that is installed, half a second and 60 MB for nothing, and looks at
every value.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from lcf3d.structures import BoolArray, FloatArray, IntArray


def numbers(values: NDArray[Any], valid: BoolArray | None = None) -> pa.Array:
    """(N,) numbers; null where not ``valid``."""
    values = np.ascontiguousarray(values)
    kind = pa.from_numpy_dtype(values.dtype)
    return pa.Array.from_buffers(kind, len(values), [_bits(valid), pa.py_buffer(values)])


def measures(values: FloatArray) -> pa.Array:
    """(N,) numbers, null where NaN."""
    return numbers(values, ~np.isnan(values))


def texts(values: Sequence[str | None]) -> pa.Array:
    """Texts; null where None."""
    encoded = [b"" if value is None else value.encode() for value in values]
    valid = None if None not in values else np.array([value is not None for value in values])
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    buffers = [_bits(valid), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded))]
    return pa.Array.from_buffers(pa.string(), len(encoded), buffers)


def words(names: Sequence[str], codes: IntArray) -> pa.Array:
    """The names that codes stand for, null for negative ones."""
    return texts(names).take(numbers(codes, codes >= 0))


def lists(counts: Iterable[int], values: pa.Array, valid: BoolArray | None = None) -> pa.ListArray:
    """Lists of so many of the values each; null where not ``valid``, which are then to count none."""
    mask = None if valid is None else _flags(~valid)
    return pa.ListArray.from_arrays(numbers(np.cumsum([0, *counts], dtype=np.int32)), values, mask=mask)


def text_lists(values: Sequence[Sequence[str] | None]) -> pa.ListArray:
    """Lists of texts; null where None."""
    valid = np.array([value is not None for value in values], dtype=bool)
    known: list[Sequence[str]] = [value or () for value in values]
    joined = texts([text for value in known for text in value])
    return lists(map(len, known), joined, None if valid.all() else valid)


def structs(columns: dict[str, pa.Array], kind: pa.StructType, valid: BoolArray | None = None) -> pa.StructArray:
    """Columns side by side in the order of ``kind``; null where not ``valid``."""
    fields = [kind.field(i) for i in range(kind.num_fields)]
    mask = None if valid is None else _flags(~valid)
    return pa.StructArray.from_arrays([columns[field.name] for field in fields], fields=fields, mask=mask)


def _flags(values: BoolArray) -> pa.BooleanArray:
    return pa.Array.from_buffers(pa.bool_(), len(values), [None, pa.py_buffer(np.packbits(values, bitorder="little"))])


def _bits(valid: BoolArray | None) -> pa.Buffer | None:
    return None if valid is None or valid.all() else pa.py_buffer(np.packbits(valid, bitorder="little"))

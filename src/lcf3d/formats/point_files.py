"""Scans in the files that people have: ``.bin``, ``.npy``, ``.pcd``, ``.ply``, ``.las`` and ``.laz``.

All give (N, 4) float32 ``x, y, z, intensity`` in the file's own axes. Points with a coordinate that is not finite (the
missing returns of an organised cloud) are left out; a file without intensities gives zeros.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import FormatError, MissingExtraError
from lcf3d.files import reading, shortened
from lcf3d.formats.scans import npy_array, require_bare, scan_bytes

SUFFIXES = (".bin", ".npy", ".pcd", ".ply", ".las", ".laz")
INTENSITY = ("intensity", "i", "reflectance", "reflectivity", "remission", "scalar_intensity", "intensities")
"""What a column of intensities may be called, lower case, the first that is there."""

# no scanner sees farther: larger numbers, or tiny ones in most points, are another type or byte order
_FARTHEST_M = 1e5
_TINY_M = 1e-20
# least bytes of a LAS file's variable length records, and of the extended ones of LAS 1.4
_LAS_RECORD, _LAS_LONG_RECORD = 54, 60
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


def read_scan(path: Path, columns: Sequence[str] = ("x", "y", "z", "intensity")) -> NDArray[np.float32]:
    """(N, 4) ``x, y, z, intensity`` of a scan in any of the formats, told by its suffix.

    Args:
        path: the file.
        columns: of the float32 numbers of a ``.bin`` file, and of a ``.npy`` array without names.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it cannot be read as such a scan, has no x, y or z, or numbers that no scanner measures.
        MissingExtraError: the library that reads it is not installed.
    """
    raw = scan_bytes(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise FormatError(f"{path} is no scan of a known kind; expected one of {', '.join(SUFFIXES)}")
    return points_of(_READERS[suffix](path, raw, tuple(columns)), str(path))


def points_of(fields: Mapping[str, NDArray[Any]], place: str) -> NDArray[np.float32]:
    """(N, 4) ``x, y, z, intensity`` of columns by name, finite points only.

    Raises:
        FormatError: x, y or z is absent, or the numbers are none that a scanner measures.
    """
    named = {name.lower(): values for name, values in fields.items()}
    absent = [name for name in "xyz" if name not in named]
    if absent:
        raise FormatError(f"{place} has no column {', '.join(absent)}; it holds {', '.join(fields) or 'none'}")
    intensity = next((named[name] for name in INTENSITY if name in named), np.zeros(len(named["x"])))
    with reading(place, "a scan of numbers"), np.errstate(all="ignore"):
        points = np.stack([np.asarray(v, dtype=np.float32) for v in (*(named[n] for n in "xyz"), intensity)], axis=1)
    points = points[np.isfinite(points[:, :3]).all(axis=1)]
    points[~np.isfinite(points[:, 3]), 3] = 0
    sizes = np.abs(points[:, :3])
    absurd = (sizes > _FARTHEST_M).any(axis=1) | ((sizes > 0) & (sizes < _TINY_M)).any(axis=1)
    if absurd.any():
        raise FormatError(
            f"{place}: {int(absurd.sum())} of {len(points)} points lie where no scanner measures, first "
            f"{points[np.argmax(absurd), :3].tolist()}; check the columns, their type and the byte order"
        )
    return points


def column_count(path: Path) -> int:
    """How many float32 columns a ``.bin`` scan has: 3 to 6, the number for which the fourth is no coordinate.

    Raises:
        FormatError: no such number fits the file.
    """
    raw = scan_bytes(path)
    require_bare(path, raw, 4)
    values = np.frombuffer(raw[: len(raw) // 4 * 4], dtype="<f4")
    best, found = np.inf, 0
    for count in (4, 5, 6, 3):
        if not len(values) or len(values) % count:
            continue
        table = values.reshape(-1, count)[:, :3]
        if not np.isfinite(table).all() or np.abs(table).max() > _FARTHEST_M:
            continue
        # neighbouring points of one laser are near each other only when rows are cut where they should be
        step = float(np.median(np.abs(np.diff(table, axis=0)).sum(axis=1))) if len(table) > 1 else 0.0
        if step < 0.7 * best:
            best, found = step, count
    if not found:
        raise FormatError(f"{path} holds no whole number of points of 3 to 6 float32 numbers; name its columns")
    return found


def _read_bin(path: Path, raw: bytes, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    require_bare(path, raw, len(columns))
    size = 4 * len(columns)
    if len(raw) % size:
        raise FormatError(
            f"{path} is cut off, or its columns are others than {', '.join(columns)}: {len(raw)} bytes are no whole "
            f"number of {size}-byte points"
        )
    table = np.frombuffer(raw, dtype="<f4").reshape(-1, len(columns))
    return {name: table[:, i] for i, name in enumerate(columns)}


def _read_npy(path: Path, raw: bytes, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    table = npy_array(path, raw)
    if table.dtype.names:
        return {name: table[name].reshape(-1) for name in table.dtype.names}
    if table.ndim != 2 or table.shape[1] < 3:
        raise FormatError(f"{path} must hold an array (N, 3 or more), got {table.shape}")
    return {name: table[:, i] for i, name in enumerate(columns[: table.shape[1]])}


def _read_pcd(path: Path, raw: bytes, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    try:
        from pypcd4 import PointCloud
    except ImportError:
        raise MissingExtraError("pypcd4", "formats", "reading .pcd scans") from None
    try:
        cloud = PointCloud.from_path(path)
        return {name: cloud.pc_data[name].reshape(-1) for name in cloud.fields}
    except Exception as error:
        # the library raises whatever its parsing ran into
        raise FormatError(f"{path} cannot be read as a PCD file ({shortened(error)})") from None


def _read_las(path: Path, raw: bytes, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    try:
        import laspy
    except ImportError:
        raise MissingExtraError("laspy", "formats", f"reading {path.suffix} scans") from None
    _require_las_header(path, raw)
    try:
        cloud = laspy.read(str(path))
        fields = {name: np.asarray(getattr(cloud, name), dtype=np.float64) for name in "xyz"}
        if "intensity" in cloud.point_format.dimension_names:
            # written in 16 bits, whatever the scanner's own range
            fields["intensity"] = np.asarray(cloud.intensity, dtype=np.float64) / 65535
    except Exception as error:
        raise FormatError(f"{path} cannot be read as a LAS file ({shortened(error)})") from None
    return fields


def _require_las_header(path: Path, raw: bytes) -> None:
    """See that the records a LAS header counts have room in the file; the library makes as many, however long it takes.

    Raises:
        FormatError: they do not.
    """
    counts = [(raw[100:104], _LAS_RECORD)]
    if raw[24:26] == b"\x01\x04":
        counts.append((raw[243:247], _LAS_LONG_RECORD))
    if any(int.from_bytes(count, "little") * size > len(raw) for count, size in counts):
        raise FormatError(f"{path} cannot be read as a LAS file (its header counts more records than it holds)")


def _read_ply(path: Path, raw: bytes, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    end = raw.find(b"end_header")
    start = raw.find(b"\n", end) + 1
    if not raw.startswith(b"ply") or end < 0 or not start:
        raise FormatError(f"{path} is no PLY file: it has no header from 'ply' to 'end_header'")
    lines = [line.split() for line in raw[:end].decode("ascii", "replace").splitlines()]
    form = next((line[1] for line in lines if len(line) > 1 and line[0] == "format"), "")
    elements = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    if not elements or lines[elements[0]][1] != "vertex" or form not in _PLY_ORDER:
        raise FormatError(f"{path} must begin with element vertex, as ascii, binary_little_endian or _big_endian")
    last = elements[1] if len(elements) > 1 else len(lines)
    try:
        count = int(lines[elements[0]][2])
        properties = [(line[2], _PLY_TYPES[line[1]]) for line in lines[elements[0] : last] if line[:1] == ["property"]]
        if form == "ascii":
            rows = raw[start:].split(b"\n", count)[:count]
            table = np.array([row.split()[: len(properties)] for row in rows], dtype=np.float64)
            return {name: table[:, i] for i, (name, _) in enumerate(properties)}
        kind = np.dtype([(name, _PLY_ORDER[form] + of) for name, of in properties])
        data = np.frombuffer(raw, dtype=kind, count=count, offset=start)
    except (KeyError, ValueError, IndexError, TypeError, OverflowError, MemoryError):
        raise FormatError(f"{path} is cut off or holds vertices that are not plain numbers") from None
    return {name: data[name] for name in kind.names or ()}


_PLY_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_READERS = {
    ".bin": _read_bin,
    ".npy": _read_npy,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".las": _read_las,
    ".laz": _read_las,
}

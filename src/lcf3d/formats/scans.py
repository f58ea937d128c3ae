"""LiDAR scans without a header, as KITTI and nuScenes keep them: rows of float32, told apart from what else is found.

`lcf3d.formats.point_files` reads the bytes and arrays of scans with named columns through the same functions.

``.bin`` files do not say how many columns a point has or what type its numbers are. Read as something else they give
points as well, only wrong ones: so the numbers themselves are asked. Coordinates lie within `MOST_METRES`, intensities
are not negative; a file that fits in one way only is read that way, one that fits in none is refused.
"""

from __future__ import annotations

import io
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import read_bytes, reading, shortened
from lcf3d.structures import FloatArray

log = logging.getLogger(__name__)

MOST_METRES = 5000.0
"""No LiDAR sees farther."""

MOST_INTENSITY = 65535.0
COLUMNS = (4, 5, 6, 7)
"""Numbers a point that are known: x, y, z, intensity and perhaps ring, time, angle."""

# shares of the points that may look wrong before a file does
_FEW_WRONG = 0.001
# with fewer points than this nothing can be told from their values
_TELLING = 16
_NUMPY = b"\x93NUMPY"
_MAGIC = {
    _NUMPY: "a NumPy array",
    b"LASF": "a LAS file",
    b"# .PCD": "a PCD file",
    b"VERSION": "a PCD file",
    b"ply": "a PLY file",
    b"\x89PNG": "a PNG image",
    b"\xff\xd8": "a JPEG image",
    b"PK\x03\x04": "a ZIP archive",
    b"\x1f\x8b": "a gzip archive",
}
_said: set[str] = set()


def read_scan(path: Path, columns: int = 4) -> NDArray[np.float32]:
    """(N, K) float32 points ``x, y, z, intensity, ...`` of a ``.bin`` or ``.npy`` file.

    Args:
        path: the scan.
        columns: numbers a point that the file should have. Files with another number of columns, or of float64, are
            read where their values leave no doubt, which is said once.

    Returns:
        Points with at least four columns; NaN and infinite values are left as they are.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it is cut off, of another format, or its values are not those of a scan.
    """
    raw = scan_bytes(path)
    if path.suffix == ".npy" or raw.startswith(_NUMPY):
        return _checked(path, npy_array(path, raw))
    require_bare(path, raw, columns)
    return _read_bare(path, raw, columns)


def scan_bytes(path: Path) -> bytes:
    """The content of a scan's file.

    Raises:
        DatasetError: it does not exist.
        FormatError: it is no regular file, or too large.
    """
    if not path.exists():
        raise DatasetError(f"scan {path} does not exist")
    return read_bytes(path)


def require_bare(path: Path, raw: bytes, columns: int) -> None:
    """See that bytes begin like no known format: numbers without a header.

    Raises:
        FormatError: they do; names the format.
    """
    kind = next((name for magic, name in _MAGIC.items() if raw.startswith(magic)), None)
    if kind is not None:
        raise FormatError(f"{path} is {kind}, not a scan of {columns} float32 a point; convert it")


def npy_array(path: Path, raw: bytes) -> NDArray[Any]:
    """The array in the bytes of a ``.npy`` file, of whatever shape and type; no objects.

    Raises:
        FormatError: they are no such file.
    """
    if not raw.startswith(_NUMPY):
        raise FormatError(f"{path} is not a NumPy array: its header is missing")
    with reading(path, "a NumPy array of points"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        array: NDArray[Any] = np.load(io.BytesIO(raw), allow_pickle=False)
    return array


def unit_intensity(points: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    """The points with intensities of 0 to 1: those of 0 to 255 are divided, which is said once.

    Raises:
        FormatError: intensities are larger than 255.
    """
    largest = float(points[:, 3].max(initial=0))
    if largest <= 1:
        return points
    if largest > 255:
        raise FormatError(
            f"{path}: intensities reach {largest:.4g}; expected 0 to 1 (or 0 to 255), scale the fourth column"
        )
    _say("intensity", f"{path}: intensities are 0 to 255, taken as 0 to 1 (others of the kind are not listed)")
    scaled = points.copy()
    scaled[:, 3] /= 255
    return scaled


def scan_problem(points: FloatArray | NDArray[np.float32]) -> str:
    """What is wrong with the values of a scan, or an empty string; a few wild points are forgiven.

    Args:
        points: (N, 4 or more) ``x, y, z, intensity, ...``; points that are not finite are not looked at.
    """
    with np.errstate(all="ignore"):
        finite = points[np.isfinite(points[:, :4]).all(axis=1)]
        if not len(finite):
            return ""
        far = np.abs(finite[:, :3]).max(axis=1) > MOST_METRES
        dark = (finite[:, 3] < 0) | (finite[:, 3] > MOST_INTENSITY)
    allowed = _FEW_WRONG * len(finite)
    if far.sum() > allowed:
        return f"{int(far.sum())} of {len(finite)} points are farther away than {MOST_METRES:g} m"
    if dark.sum() > allowed:
        return f"{int(dark.sum())} of {len(finite)} intensities are negative or above {MOST_INTENSITY:g}"
    return ""


def _checked(path: Path, table: NDArray[Any]) -> NDArray[np.float32]:
    """A NumPy array as a scan, where shape and values are those of one."""
    if table.ndim != 2 or not 4 <= table.shape[1] <= 16 or table.dtype.kind not in "fiu":
        raise FormatError(
            f"{path} must hold N x 4 numbers (x, y, z, intensity), got {shortened(table.shape)} of {table.dtype}"
        )
    problem = scan_problem(table)
    if problem:
        raise FormatError(f"{path}: {problem}; expected columns x, y, z in metres and intensity")
    points: NDArray[np.float32] = table.astype(np.float32)
    return points


def _read_bare(path: Path, raw: bytes, columns: int) -> NDArray[np.float32]:
    """Rows of numbers without a header, in the form that their values fit."""
    width = 4 * columns
    whole = len(raw) % width == 0
    cut = f"{path} is cut off: {len(raw)} bytes are no whole number of {width}-byte points; copy it again"
    if len(raw) < _TELLING * width:
        if not whole:
            raise FormatError(cut)
        return _table(raw, "<f4", columns).astype(np.float32)
    problem = scan_problem(_table(raw, "<f4", columns)) if whole else cut
    # all NaN would pass for lack of anything to look at
    if not problem and np.isfinite(_table(raw, "<f4", columns)[:, :3]).any():
        return _table(raw, "<f4", columns).astype(np.float32)
    others = [("<f4", other) for other in COLUMNS if other != columns] + [("<f8", other) for other in COLUMNS]
    fitting = [(kind, other) for kind, other in others if _fits(raw, kind, other)]
    if len(fitting) == 1:
        kind, found = fitting[0]
        name = f"{found} numbers of {'float32' if kind == '<f4' else 'float64'} a point"
        _say(name, f"{path} holds {name} instead of {columns} of float32, read as that (others are not listed)")
        return _table(raw, kind, found).astype(np.float32)
    if not whole:
        raise FormatError(cut)
    raise FormatError(
        f"{path} is not a scan of {columns} float32 a point: "
        f"{problem or 'it holds no finite coordinates'}; convert it to x, y, z, intensity"
    )


def _fits(raw: bytes, kind: str, columns: int) -> bool:
    if len(raw) % (columns * np.dtype(kind).itemsize):
        return False
    table = _table(raw, kind, columns)
    with np.errstate(all="ignore"):
        finite = np.isfinite(table).all() and bool((np.abs(table) < 1e12).all())
        # numbers of another type look tiny: hardly any coordinate of a real scan is smaller than this
        tiny = (np.abs(table[:, :3]) < 1e-6).mean() > 0.2
    return finite and not tiny and not scan_problem(table)


def _table(raw: bytes, kind: str, columns: int) -> NDArray[np.floating]:
    return np.frombuffer(raw, dtype=kind).reshape(-1, columns)


def _say(key: str, text: str) -> None:
    """Log a note, once a process."""
    if key not in _said:
        _said.add(key)
        log.warning(text)

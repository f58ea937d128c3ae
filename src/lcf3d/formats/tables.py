"""Detections of many frames as one parquet table (extra ``formats``).

3D: columns ``frame, class, x, y, z, length, width, height, yaw, score`` in the LiDAR frame, metres and radians. 2D:
``frame, camera, class, x1, y1, x2, y2, score`` in pixels. ``score`` may be absent (labels: 1).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.joins import LeftOut, join_classes
from lcf3d.errors import FormatError, MissingExtraError
from lcf3d.files import atomic_path, reading, require_file, shortened
from lcf3d.remote.places import fetched
from lcf3d.structures import Detections2D, Detections3D

BOX_3D = ("x", "y", "z", "length", "width", "height", "yaw")
BOX_2D = ("x1", "y1", "x2", "y2")


def read_table_3d(path: Path, class_names: Sequence[str], left_out: LeftOut | None = None) -> dict[str, Detections3D]:
    """3D detections by frame; frames whose detections are all of other classes stay, empty.

    Args:
        path: the table.
        class_names: classes to keep, joined as by `join_classes`; others are left out.
        left_out: counts detections of other classes.

    Raises:
        FormatError: the file is absent, no parquet table, or lacks a column; names it.
        MissingExtraError: pyarrow is not installed.
    """
    table = _read(path, ("frame", "class"), BOX_3D)
    groups = _grouped(table, BOX_3D, (), class_names, left_out)
    return {str(key[0]): Detections3D(*parts) for key, parts in groups.items()}


def read_table_2d(
    path: Path, class_names: Sequence[str], left_out: LeftOut | None = None
) -> dict[tuple[str, str], Detections2D]:
    """2D detections by (frame, camera); see `read_table_3d`."""
    table = _read(path, ("frame", "camera", "class"), BOX_2D)
    groups = _grouped(table, BOX_2D, ("camera",), class_names, left_out)
    return {(key[0], key[1]): Detections2D(*parts) for key, parts in groups.items()}


def table_classes(path: Path) -> dict[str, int]:
    """Rows of a table by class.

    Raises:
        FormatError: no such table.
    """
    names, counts = np.unique(_read(path, ("class",), ())["class"], return_counts=True)
    return {str(name): int(count) for name, count in zip(names, counts, strict=True)}


def write_table_3d(path: Path, detections: Mapping[str, Detections3D]) -> None:
    """Write 3D detections by frame, whole or not at all.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    columns: dict[str, list[Any]] = {name: [] for name in ("frame", "class", *BOX_3D, "score")}
    for frame_id, found in detections.items():
        columns["frame"] += [frame_id] * len(found)
        _append(columns, found, BOX_3D)
    _write(path, columns)


def write_table_2d(path: Path, detections: Mapping[tuple[str, str], Detections2D]) -> None:
    """Write 2D detections by (frame, camera), whole or not at all; masks are not written."""
    columns: dict[str, list[Any]] = {name: [] for name in ("frame", "camera", "class", *BOX_2D, "score")}
    for (frame_id, camera), found in detections.items():
        columns["frame"] += [frame_id] * len(found)
        columns["camera"] += [camera] * len(found)
        _append(columns, found, BOX_2D)
    _write(path, columns)


def _append(columns: dict[str, list[Any]], found: Detections2D | Detections3D, box: Sequence[str]) -> None:
    columns["class"] += [found.class_names[label] for label in found.labels]
    columns["score"] += found.scores.tolist()
    for i, name in enumerate(box):
        columns[name] += found.boxes[:, i].tolist()


def _parquet(purpose: str) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("pyarrow", "formats", purpose) from None
    return pyarrow, pyarrow.parquet


def _write(path: Path, columns: Mapping[str, list[Any]]) -> None:
    arrow, parquet = _parquet("writing parquet tables")
    with atomic_path(path) as temporary:
        parquet.write_table(arrow.table(dict(columns)), temporary)


def _read(path: Path, texts: Sequence[str], numbers: Sequence[str]) -> dict[str, NDArray[Any]]:
    _, parquet = _parquet("reading parquet tables")
    if not fetched(path).exists():
        raise FormatError(f"{path} does not exist")
    require_file(path)
    try:
        with reading(path, "a parquet table"):
            table = parquet.read_table(path)
            # what is damaged would be read beyond its end
            table.validate(full=True)
    except OSError as error:
        raise FormatError(f"{path} cannot be read as a parquet table ({shortened(error)})") from None
    absent = [name for name in (*texts, *numbers) if name not in table.column_names]
    if absent:
        raise FormatError(f"{path} has no column {', '.join(absent)}; it holds {', '.join(table.column_names)}")
    found: dict[str, NDArray[Any]] = {}
    try:
        with reading(path, "a parquet table"):
            for name in texts:
                found[name] = np.array([str(value) for value in table[name].to_pylist()], dtype=np.str_)
        for name in (*numbers, *(("score",) if "score" in table.column_names else ())):
            found[name] = np.array(table[name].to_pylist(), dtype=np.float64)
    except (TypeError, ValueError):
        raise FormatError(f"{path}: column {name} must hold numbers") from None
    found.setdefault("score", np.ones(len(found["class"])))
    for name in (*numbers, "score"):
        if not np.isfinite(found[name]).all():
            raise FormatError(f"{path}: column {name} holds missing, NaN or infinite values")
    return found


def _grouped(
    table: Mapping[str, NDArray[Any]],
    box: Sequence[str],
    keys: Sequence[str],
    class_names: Sequence[str],
    left_out: LeftOut | None,
) -> dict[tuple[str, ...], tuple[Any, Any, Any, tuple[str, ...]]]:
    """Boxes, scores, labels and class names by frame and ``keys``."""
    names = tuple(class_names)
    own = Counter(table["class"].tolist())
    index = {name: names.index(target) for name, target in join_classes(own, names).items()}
    if left_out is not None:
        left_out.classes.update({name: count for name, count in own.items() if name not in index})
    labels = np.array([index.get(name, -1) for name in table["class"].tolist()], dtype=np.int64)
    boxes = np.stack([table[name] for name in box], axis=1) if len(labels) else np.zeros((0, len(box)))
    rows: dict[tuple[str, ...], list[int]] = {}
    for i, key in enumerate(zip(*(table[name].tolist() for name in ("frame", *keys)), strict=True)):
        kept = rows.setdefault(key, [])
        if labels[i] >= 0:
            kept.append(i)
    return {key: (boxes[kept], table["score"][kept], labels[kept], names) for key, kept in rows.items()}

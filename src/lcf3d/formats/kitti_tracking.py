"""KITTI tracking files: one file a sequence, each line ``frame id`` and then a line of the object format.

Labels have 17 columns, results 18 (the last is the score). Track id -1 marks regions that belong to no object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lcf3d.errors import FormatError
from lcf3d.files import read_text, write_text
from lcf3d.formats.kitti import KittiObjects, format_objects, objects_from_table
from lcf3d.formats.kitti_text import LABEL_COLUMNS, RESULT_COLUMNS
from lcf3d.structures import IntArray


@dataclass(frozen=True, eq=False)
class TrackedObjects:
    """The lines of one KITTI tracking file.

    Attributes:
        frames: (N,) frame number of each line.
        ids: (N,) track of each line, -1 for none.
        objects: (N) the rest of each line.
    """

    frames: IntArray
    ids: IntArray
    objects: KittiObjects

    def __len__(self) -> int:
        return len(self.frames)


def read_tracks(path: Path, results: bool) -> TrackedObjects:
    """The lines of a tracking label file, or of a result file when ``results``.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is not what it should be, or a frame holds a track twice; names file and line.
    """
    columns = (RESULT_COLUMNS if results else LABEL_COLUMNS) + 2
    names, rows, lines = [], [], []
    for number, line in enumerate(read_text(Path(path)).splitlines(), 1):
        fields = line.split()
        if not fields:
            continue
        if len(fields) != columns:
            kind = "a tracking result (with a score)" if results else "a tracking label"
            raise FormatError(f"{path}:{number}: expected the {columns} columns of {kind}, got {len(fields)}")
        try:
            rows.append([float(field) for field in (*fields[:2], *fields[3:])])
        except ValueError:
            raise FormatError(f"{path}:{number}: all columns but the class must be numbers") from None
        names.append(fields[2])
        lines.append(number)
    values = np.array(rows).reshape(-1, columns - 1)
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1) | (values[:, :2] != np.round(values[:, :2])).any(axis=1))
    if len(wrong):
        raise FormatError(
            f"{path}:{lines[wrong[0]]}: frame and track id must be whole numbers and all others finite numbers"
        )
    frames, ids = values[:, 0].astype(np.int64), values[:, 1].astype(np.int64)
    keys = list(zip(frames.tolist(), ids.tolist(), strict=True))
    seen: set[tuple[int, int]] = set()
    for key, number in zip(keys, lines, strict=True):
        if key[1] >= 0 and key in seen:
            raise FormatError(f"{path}:{number}: frame {key[0]} holds track {key[1]} twice")
        seen.add(key)
    return TrackedObjects(frames, ids, objects_from_table(np.array(names, dtype=np.str_), values[:, 2:]))


def write_tracks(path: Path, frames: Sequence[int], ids: Sequence[IntArray], objects: Sequence[KittiObjects]) -> None:
    """Write a result file, whole or not at all.

    Args:
        path: the file.
        frames: number of each frame.
        ids: for each frame, (N,) tracks of its objects.
        objects: for each frame, its objects with scores.
    """
    lines = []
    for frame, own, found in zip(frames, ids, objects, strict=True):
        text = format_objects(found).splitlines()
        lines += [f"{frame} {track} {line}\n" for track, line in zip(own, text, strict=True)]
    write_text(Path(path), "".join(lines))

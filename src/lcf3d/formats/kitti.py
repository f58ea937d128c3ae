"""KITTI object files: labels (15 columns a line) and results (16 columns, the last is the score), read and written.

A line is ``class truncated occluded alpha x1 y1 x2 y2 height width length x y z rotation_y [score]``. Location is the
bottom centre of the box in the rectified reference camera (x right, y down, z forward); ``-1 -1 -1`` as size or
``-1000 -1000 -1000`` as location says that the object has no 3D box.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DatasetError, FormatError, ShapeError
from lcf3d.files import read_text, write_text
from lcf3d.formats.kitti_text import (
    LABEL_COLUMNS,
    NO_LOCATION,
    NO_SIZE,
    RESULT_COLUMNS,
    has_box3d,
    parse_files,
)
from lcf3d.geometry.boxes import kitti_from_lidar, lidar_from_kitti, observation_angle
from lcf3d.structures import Detections2D, Detections3D, FloatArray, IntArray

NO_ANGLE = -10.0

# the numbers between class and score
_NUMBERS = " ".join(["%.4f"] * 14) + "\n"
_TRAILING = re.compile(r"\.?0+(?=\s)")
_ZERO = re.compile(r"(?<!\S)-0(?=\s)")

_Missing = Literal["error", "empty"]


@dataclass(frozen=True, eq=False)
class KittiObjects:
    """The lines of one KITTI file (or of several, see `KittiFrames`) as parallel arrays.

    Attributes:
        class_names: (N,) class of each object, ``DontCare`` included.
        truncated: (N,) share of the object outside the image, 0 to 1; -1 where unknown (results).
        occluded: (N,) int64 0 visible, 1 partly, 2 largely, 3 unknown; -1 in results.
        alpha: (N,) observation angle in radians; -10 where unknown.
        boxes2d: (N, 4) ``(x1, y1, x2, y2)`` pixels.
        dimensions: (N, 3) height, width, length in metres; -1 without a 3D box.
        locations: (N, 3) bottom centre in the rectified reference camera, metres; -1000 without a 3D box.
        rotation_y: (N,) radians about the camera's y axis; -10 without a 3D box.
        scores: (N,) as written (any real number), or None for labels.
    """

    class_names: NDArray[np.str_]
    truncated: FloatArray
    occluded: IntArray
    alpha: FloatArray
    boxes2d: FloatArray
    dimensions: FloatArray
    locations: FloatArray
    rotation_y: FloatArray
    scores: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.class_names)
        for name, shape in _SHAPES.items():
            value = getattr(self, name)
            if value is not None and value.shape != (n, *shape):
                raise ShapeError(f"KittiObjects.{name} must have shape {(n, *shape)}, got {value.shape}")

    @classmethod
    def empty(cls, results: bool) -> KittiObjects:
        """No objects, with scores if ``results``."""
        return objects_from_table(np.zeros(0, np.str_), np.zeros((0, 15 if results else 14)))

    @property
    def has_box3d(self) -> NDArray[np.bool_]:
        """(N,) whether the object has a 3D box, not only the "unknown" numbers."""
        return has_box3d(self.dimensions, self.locations)

    def __len__(self) -> int:
        return len(self.class_names)

    def __getitem__(self, index: Any) -> KittiObjects:
        """Those selected by a slice, an integer array or a boolean mask."""
        return KittiObjects(
            self.class_names[index],
            self.truncated[index],
            self.occluded[index],
            self.alpha[index],
            self.boxes2d[index],
            self.dimensions[index],
            self.locations[index],
            self.rotation_y[index],
            None if self.scores is None else self.scores[index],
        )


_SHAPES: dict[str, tuple[int, ...]] = {
    "truncated": (),
    "occluded": (),
    "alpha": (),
    "boxes2d": (4,),
    "dimensions": (3,),
    "locations": (3,),
    "rotation_y": (),
    "scores": (),
}


@dataclass(frozen=True, eq=False)
class KittiFrames(Sequence[KittiObjects]):
    """The objects of many frames in one columnar table; indexing gives one frame's `KittiObjects`.

    Attributes:
        frame_ids: names of the F frames.
        objects: all objects, frame after frame.
        starts: (F + 1,) int64; frame ``i`` owns the rows ``starts[i]`` to ``starts[i + 1]``.
    """

    frame_ids: tuple[str, ...]
    objects: KittiObjects
    starts: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame_ids", tuple(self.frame_ids))
        frames = len(self.frame_ids)
        if self.starts.shape != (frames + 1,) or self.starts[0] != 0 or self.starts[-1] != len(self.objects):
            raise ShapeError(
                f"KittiFrames.starts must be {frames + 1} row numbers from 0 to {len(self.objects)} "
                f"for {frames} frames, got shape {self.starts.shape}"
            )

    @classmethod
    def from_frames(cls, frame_ids: Sequence[str], frames: Sequence[KittiObjects]) -> KittiFrames:
        """One table from the objects of each frame; all of them with scores or all without."""
        with_scores = {frame.scores is not None for frame in frames}
        if len(with_scores) > 1:
            raise FormatError("frames with and without scores cannot be joined; read all as results or all as labels")
        if not frames:
            return cls(tuple(frame_ids), KittiObjects.empty(results=True), np.zeros(1, np.int64))
        columns = {
            name: np.concatenate([getattr(frame, name) for frame in frames])
            for name in ("class_names", *_SHAPES)
            if name != "scores" or True in with_scores
        }
        return cls(tuple(frame_ids), KittiObjects(**columns), _starts([len(frame) for frame in frames]))

    @property
    def frame_of_object(self) -> IntArray:
        """(N,) index of the frame that each object belongs to."""
        return np.repeat(np.arange(len(self.frame_ids)), np.diff(self.starts))

    def __len__(self) -> int:
        return len(self.frame_ids)

    @overload
    def __getitem__(self, index: int) -> KittiObjects: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[KittiObjects]: ...
    def __getitem__(self, index: int | slice) -> KittiObjects | Sequence[KittiObjects]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        i = range(len(self))[index]
        return self.objects[self.starts[i] : self.starts[i + 1]]

    def __iter__(self) -> Iterator[KittiObjects]:
        return (self[i] for i in range(len(self)))


def read_objects(path: Path, results: bool) -> KittiObjects:
    """The objects of one label file, or of one result file when ``results``.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is not what it should be; names file and line.
    """
    return _read_files([Path(path)], results)[0]


def read_folder(folder: Path, frame_ids: Sequence[str], results: bool, missing: _Missing = "error") -> KittiFrames:
    """The objects of ``folder/ID.txt`` for each of ``frame_ids``, in that order.

    Args:
        folder: folder of text files.
        frame_ids: names of the frames, any strings.
        results: expect scores (16 columns).
        missing: what to do about absent files: ``error``, or ``empty`` to take them as frames without objects.

    Raises:
        DatasetError: the folder, or any file unless ``missing="empty"``, does not exist; says how many and which first.
        FormatError: a line is not what it should be; names file and line.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder; expected KITTI text files, one a frame")
    # asked one by one: a part of a run must not list the files of all others
    absent = [frame_id for frame_id in frame_ids if not os.path.exists(f"{folder}/{frame_id}.txt")]
    if absent and missing == "error":
        raise DatasetError(
            f"{folder} lacks the files of {len(absent)} of {len(frame_ids)} frames, first {absent[0]}.txt; "
            "add them (an empty file means no objects), or ask for missing ones to be taken as empty"
        )
    skip = set(absent)
    paths = [None if frame_id in skip else folder / f"{frame_id}.txt" for frame_id in frame_ids]
    objects, counts = _read_files(paths, results)
    return KittiFrames(tuple(frame_ids), objects, _starts(counts))


def read_frame_ids(path: Path) -> tuple[str, ...]:
    """The frame names in an ``ImageSets`` file, one a line; blank lines are skipped.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it names no frame, or one twice.
    """
    frame_ids = tuple(read_text(Path(path)).split())
    if not frame_ids:
        raise FormatError(f"{path} names no frames; expected one frame id a line")
    if len(set(frame_ids)) < len(frame_ids):
        twice = next(name for i, name in enumerate(frame_ids) if name in frame_ids[:i])
        raise FormatError(f"{path} names frame {twice} more than once; every frame may appear once")
    return frame_ids


def write_objects(path: Path, objects: KittiObjects) -> None:
    """Write one file, 16 columns with scores and 15 without; no objects make an empty file. Whole or not at all."""
    write_text(Path(path), format_objects(objects))


def format_objects(objects: KittiObjects) -> str:
    """The text of a KITTI file, one line an object: lengths to 0.1 mm, pixels to 1e-4, scores to 8 digits."""
    n = len(objects)
    if not n:
        return ""
    numbers = np.empty((n, 14))
    numbers[:, 0], numbers[:, 1], numbers[:, 2] = objects.truncated, objects.occluded, objects.alpha
    numbers[:, 3:7], numbers[:, 7:10] = objects.boxes2d, objects.dimensions
    numbers[:, 10:13], numbers[:, 13] = objects.locations, objects.rotation_y
    flat = ~objects.has_box3d
    if flat.any():
        numbers[flat, 7:] = (*(NO_SIZE,) * 3, *(NO_LOCATION,) * 3, NO_ANGLE)
    # all numbers of the file at once: to four decimals, then without trailing zeros
    written = _ZERO.sub("0", _TRAILING.sub("", (_NUMBERS * n) % tuple(numbers.ravel().tolist())))
    lines = zip(objects.class_names.tolist(), written.splitlines(), strict=True)
    if objects.scores is None:
        return "".join(f"{name} {row}\n" for name, row in lines)
    scores = objects.scores.tolist()
    return "".join(f"{name} {row} {score:.8g}\n" for (name, row), score in zip(lines, scores, strict=True))


def detections_2d(objects: KittiObjects, class_names: Sequence[str]) -> Detections2D:
    """The 2D boxes of the objects whose class is in ``class_names``; labels get score 1."""
    labels = labels_of(objects, class_names)
    kept = labels >= 0
    scores = np.ones(len(objects)) if objects.scores is None else objects.scores
    return Detections2D(objects.boxes2d[kept], scores[kept], labels[kept], tuple(class_names))


def detections_3d(objects: KittiObjects, camera_from_lidar: FloatArray, class_names: Sequence[str]) -> Detections3D:
    """The 3D boxes, in the LiDAR frame, of the objects that have one and whose class is in ``class_names``.

    Args:
        objects: of one frame.
        camera_from_lidar: (4, 4) rectified reference camera from LiDAR, ``R0_rect @ Tr_velo_to_cam``.
        class_names: classes to keep; labels index them. Ground truth gets score 1.
    """
    labels = labels_of(objects, class_names)
    kept = (labels >= 0) & objects.has_box3d
    boxes = lidar_from_kitti(
        objects.locations[kept], objects.dimensions[kept], objects.rotation_y[kept], camera_from_lidar
    )
    scores = np.ones(len(objects)) if objects.scores is None else objects.scores
    return Detections3D(boxes, scores[kept], labels[kept], tuple(class_names))


def objects_from_detections(
    detections: Detections3D, boxes2d: FloatArray, camera_from_lidar: FloatArray
) -> KittiObjects:
    """KITTI result lines for 3D detections.

    Args:
        detections: N boxes in the LiDAR frame.
        boxes2d: (N, 4) their boxes in the image, pixels.
        camera_from_lidar: (4, 4) rectified reference camera from LiDAR, ``R0_rect @ Tr_velo_to_cam``.

    Returns:
        Objects with ``alpha = rotation_y - atan2(x, z)`` and truncation and occlusion unknown (-1).
    """
    n = len(detections)
    if np.shape(boxes2d) != (n, 4):
        raise ShapeError(f"boxes2d must have shape {(n, 4)} for {n} detections, got {np.shape(boxes2d)}")
    locations, dimensions, rotation_y = kitti_from_lidar(detections.boxes, camera_from_lidar)
    return KittiObjects(
        np.array(detections.class_names, dtype=np.str_)[detections.labels],
        np.full(n, -1.0),
        np.full(n, -1, dtype=np.int64),
        observation_angle(locations, rotation_y),
        np.asarray(boxes2d, dtype=np.float64),
        dimensions,
        locations,
        rotation_y,
        detections.scores,
    )


def objects_from_detections_2d(detections: Detections2D) -> KittiObjects:
    """KITTI result lines for 2D detections: everything of the third dimension is marked as unknown."""
    n = len(detections)
    return KittiObjects(
        np.array(detections.class_names, dtype=np.str_)[detections.labels],
        np.full(n, -1.0),
        np.full(n, -1, dtype=np.int64),
        np.full(n, NO_ANGLE),
        detections.boxes,
        np.full((n, 3), NO_SIZE),
        np.full((n, 3), NO_LOCATION),
        np.full(n, NO_ANGLE),
        detections.scores,
    )


def renamed(objects: KittiObjects, name: str, target: str) -> KittiObjects:
    """The objects with class ``name`` called ``target``."""
    names = objects.class_names.tolist()
    return replace(objects, class_names=np.array([target if n == name else n for n in names], dtype=np.str_))


def labels_of(objects: KittiObjects, class_names: Sequence[str]) -> IntArray:
    """(N,) index of each object's class in ``class_names``, -1 for the others."""
    labels = np.full(len(objects), -1, dtype=np.int64)
    for i, name in enumerate(class_names):
        labels[objects.class_names == name] = i
    return labels


def _starts(counts: Sequence[int]) -> IntArray:
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def _read_files(paths: Sequence[Path | None], results: bool) -> tuple[KittiObjects, list[int]]:
    """All objects of the files, one after the other, and how many each file holds; None stands for an empty file."""
    names, values, counts = parse_files(paths, RESULT_COLUMNS if results else LABEL_COLUMNS)
    return objects_from_table(names, values), counts


def objects_from_table(names: NDArray[np.str_], values: FloatArray) -> KittiObjects:
    """Objects from the (N, 14) or, with scores, (N, 15) numbers that follow the class name."""
    values.setflags(write=False)
    return KittiObjects(
        names,
        values[:, 0],
        values[:, 1].astype(np.int64),
        values[:, 2],
        values[:, 3:7],
        values[:, 7:10],
        values[:, 10:13],
        values[:, 13],
        values[:, 14] if values.shape[1] == 15 else None,
    )

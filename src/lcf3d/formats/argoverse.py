"""Argoverse 2 files: cuboids (annotations and submissions), sweeps, poses and calibration, as feather tables.

Everything is in the egovehicle frame of its moment: x forward, y left, z up, metres, which is the canonical LiDAR frame
of lcf3d for this dataset. Quaternions are ``(w, x, y, z)``; cuboids stand upright, so that a heading is all of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import FormatError
from lcf3d.formats.feather import TEXT, read_columns, write_columns
from lcf3d.geometry.rotation import quaternions_from_yaws, rigid_transforms, yaws_from_quaternions
from lcf3d.structures import ARGOVERSE_CLASSES, Detections3D, FloatArray, IntArray

OTHER_CLASSES = ("ANIMAL", "OFFICIAL_SIGNALER", "RAILED_VEHICLE", "TRAFFIC_LIGHT_TRAILER")
"""Categories that are annotated but not evaluated; their cuboids are left out and counted."""

_CUBOID = {
    "length_m": np.float64,
    "width_m": np.float64,
    "height_m": np.float64,
    "qw": np.float64,
    "qx": np.float64,
    "qy": np.float64,
    "qz": np.float64,
    "tx_m": np.float64,
    "ty_m": np.float64,
    "tz_m": np.float64,
    "timestamp_ns": np.int64,
    "category": TEXT,
}
_POSE = dict.fromkeys(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), np.float64)
_INTRINSICS = dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), np.float64)


@dataclass(frozen=True, eq=False)
class Cuboids:
    """Boxes of many sweeps, as parallel arrays.

    Attributes:
        log_ids: names of the logs that ``logs`` counts.
        logs: (N,) index into ``log_ids``.
        timestamps_ns: (N,) int64 time of each box's sweep in nanoseconds.
        boxes: (N, 7) canonical boxes in the egovehicle frame of that time.
        labels: (N,) index into `ARGOVERSE_CLASSES`.
        scores: (N,) confidences; 1 for annotations.
        point_counts: (N,) LiDAR points inside an annotation; -1 where unknown.
        left_out: how many cuboids of each of `OTHER_CLASSES` the file held besides.
    """

    log_ids: tuple[str, ...]
    logs: IntArray
    timestamps_ns: IntArray
    boxes: FloatArray
    labels: IntArray
    scores: FloatArray
    point_counts: IntArray
    left_out: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: Any) -> Cuboids:
        """Those selected by a slice, an integer array or a boolean mask."""
        return Cuboids(
            self.log_ids,
            self.logs[rows],
            self.timestamps_ns[rows],
            self.boxes[rows],
            self.labels[rows],
            self.scores[rows],
            self.point_counts[rows],
            self.left_out,
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Cuboids]) -> Cuboids:
        """All cuboids of ``parts`` one after the other; logs of equal name become one."""
        log_ids = tuple(dict.fromkeys(log for part in parts for log in part.log_ids))
        position = {log: i for i, log in enumerate(log_ids)}
        numbers = [np.array([position[log] for log in part.log_ids], dtype=np.int64) for part in parts]
        left_out: Counter[str] = Counter()
        for part in parts:
            left_out.update(part.left_out)

        def joined(name: str, empty: NDArray[Any]) -> Any:
            return np.concatenate([empty, *(getattr(part, name) for part in parts)])

        integers = np.zeros(0, np.int64)
        logs = [number[part.logs] for number, part in zip(numbers, parts, strict=True)]
        return cls(
            log_ids,
            np.concatenate([integers, *logs]),
            joined("timestamps_ns", integers),
            joined("boxes", np.zeros((0, 7))),
            joined("labels", integers),
            joined("scores", np.zeros(0)),
            joined("point_counts", integers),
            dict(left_out),
        )

    @classmethod
    def from_detections(cls, log_id: str, detections: Mapping[int, Detections3D]) -> Cuboids:
        """From detections by sweep time in nanoseconds, in the egovehicle frame, of one log.

        Detections of classes that are none of `ARGOVERSE_CLASSES` are left out and counted in ``left_out``.
        """
        parts = []
        for timestamp, found in detections.items():
            known = found.with_classes(ARGOVERSE_CLASSES)
            names = np.array(found.class_names, dtype=object)[found.labels]
            other = Counter(name for name in names.tolist() if name not in ARGOVERSE_CLASSES)
            n = len(known)
            parts.append(
                cls(
                    (log_id,),
                    np.zeros(n, np.int64),
                    np.full(n, timestamp, np.int64),
                    known.boxes,
                    known.labels,
                    known.scores,
                    np.full(n, -1, np.int64),
                    dict(other),
                )
            )
        return cls.concatenate([cls((log_id,), *_nothing()), *parts])

    def detections(self) -> Detections3D:
        """The boxes as detections, in file order, without their times."""
        return Detections3D(self.boxes, self.scores, self.labels, ARGOVERSE_CLASSES)


def read_annotations(path: Path, log_id: str) -> Cuboids:
    """Cuboids of a log's ``annotations.feather``.

    Raises:
        FormatError: absent or malformed (`lcf3d.formats.feather.read_columns`); an unknown category, a number that is
            not finite, a size that is not positive.
    """
    table = read_columns(path, {**_CUBOID, "num_interior_pts": np.int64})
    boxes, labels, kept, left_out = _boxes(path, table)
    n = len(boxes)
    return Cuboids(
        (log_id,),
        np.zeros(n, np.int64),
        table["timestamp_ns"][kept],
        boxes,
        labels,
        np.ones(n),
        table["num_interior_pts"][kept],
        left_out,
    )


def read_submission(path: Path) -> Cuboids:
    """Cuboids of a file in the submission form: those of an annotation with ``log_id`` and ``score``.

    Raises:
        FormatError: as `read_annotations`, or a score that is not finite.
    """
    table = read_columns(path, {**_CUBOID, "score": np.float64, "log_id": TEXT})
    if not np.isfinite(table["score"]).all():
        raise FormatError(f"{path}: column score holds NaN or infinite values")
    boxes, labels, kept, left_out = _boxes(path, table)
    log_ids, logs = _unique(table["log_id"])
    return Cuboids(
        log_ids,
        logs[kept],
        table["timestamp_ns"][kept],
        boxes,
        labels,
        table["score"][kept],
        np.full(len(boxes), -1, dtype=np.int64),
        left_out,
    )


def write_submission(path: Path, cuboids: Cuboids) -> None:
    """Write ``cuboids`` in the submission form, highest scores of a sweep first, whole or not at all.

    Raises:
        FormatError: a coordinate, size or score is not a finite number.
        MissingExtraError: pyarrow is not installed.
    """
    if not (np.isfinite(cuboids.boxes).all() and np.isfinite(cuboids.scores).all()):
        raise FormatError(f"cannot write {path}: boxes or scores hold NaN or infinite values")
    order = np.lexsort((-cuboids.scores, cuboids.timestamps_ns, cuboids.logs))
    boxes = cuboids.boxes[order]
    quaternions = quaternions_from_yaws(boxes[:, 6])
    columns: dict[str, NDArray[Any]] = {name: boxes[:, i] for i, name in enumerate(("tx_m", "ty_m", "tz_m"))}
    columns |= {name: boxes[:, 3 + i] for i, name in enumerate(("length_m", "width_m", "height_m"))}
    columns |= {name: quaternions[:, i] for i, name in enumerate(("qw", "qx", "qy", "qz"))}
    columns["score"] = cuboids.scores[order]
    columns["log_id"] = np.array(cuboids.log_ids, dtype=object)[cuboids.logs[order]]
    columns["timestamp_ns"] = cuboids.timestamps_ns[order]
    columns["category"] = np.array(ARGOVERSE_CLASSES, dtype=object)[cuboids.labels[order]]
    write_columns(path, {name: np.ascontiguousarray(values) for name, values in columns.items()})


def read_sweep(path: Path) -> NDArray[np.float32]:
    """(N, 5) float32 ``x, y, z`` (metres, egovehicle frame of the sweep's time), ``intensity`` (0 to 255) and seconds
    after the sweep's time, of a LiDAR sweep. Points with NaN or infinite coordinates are left out.

    Raises:
        FormatError: absent or malformed.
    """
    table = read_columns(
        path, {"x": np.float32, "y": np.float32, "z": np.float32, "intensity": np.float32, "offset_ns": np.float32}
    )
    points = np.stack([table[name] for name in ("x", "y", "z", "intensity", "offset_ns")], axis=1)
    points[:, 4] *= np.float32(1e-9)
    finite: NDArray[np.float32] = points[np.isfinite(points).all(axis=1)]
    return finite


def read_poses(path: Path) -> tuple[IntArray, FloatArray]:
    """(N,) times in nanoseconds, ascending, and (N, 4, 4) ``city_from_ego`` of ``city_SE3_egovehicle.feather``.

    Raises:
        FormatError: absent or malformed.
    """
    table = read_columns(path, {"timestamp_ns": np.int64, **_POSE})
    order = np.argsort(table["timestamp_ns"], kind="stable")
    return table["timestamp_ns"][order], _transforms(path, table)[order]


@dataclass(frozen=True, eq=False)
class Calibration:
    """What the ``calibration`` folder of a log says.

    Attributes:
        ego_from_sensor: (4, 4) by sensor name, cameras (x right, y down, z forward) and LiDARs.
        intrinsics: (3, 3) camera matrix by camera name, of the images as they are distributed: without distortion.
        sizes: (width, height) in pixels by camera name.
    """

    ego_from_sensor: Mapping[str, FloatArray]
    intrinsics: Mapping[str, FloatArray]
    sizes: Mapping[str, tuple[int, int]]


def read_calibration(folder: Path) -> Calibration:
    """The calibration of a log from ``egovehicle_SE3_sensor.feather`` and ``intrinsics.feather`` in ``folder``.

    The distortion coefficients of the file are not read: the images are distributed undistorted.

    Raises:
        FormatError: absent or malformed, or a camera without pose.
    """
    path = folder / "egovehicle_SE3_sensor.feather"
    table = read_columns(path, {"sensor_name": TEXT, **_POSE})
    ego_from_sensor = dict(zip(table["sensor_name"].tolist(), _transforms(path, table), strict=True))
    path = folder / "intrinsics.feather"
    table = read_columns(path, {"sensor_name": TEXT, **_INTRINSICS, "height_px": np.int64, "width_px": np.int64})
    intrinsics, sizes = {}, {}
    for i, name in enumerate(table["sensor_name"].tolist()):
        if name not in ego_from_sensor:
            raise FormatError(f"{path} describes camera {name}, which egovehicle_SE3_sensor.feather beside it does not")
        fx, fy, cx, cy = (float(table[key][i]) for key in _INTRINSICS)
        intrinsics[name] = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        sizes[name] = int(table["width_px"][i]), int(table["height_px"][i])
    return Calibration(ego_from_sensor, intrinsics, sizes)


def _boxes(path: Path, table: Mapping[str, NDArray[Any]]) -> tuple[FloatArray, IntArray, IntArray, dict[str, int]]:
    """(N, 7) boxes and (N,) labels of the rows (N,) that are evaluated, and how many of each other class there are."""
    numbers = np.stack([table[name] for name, kind in _CUBOID.items() if kind is np.float64], axis=1)
    checks = [
        ("NaN or infinite numbers", ~np.isfinite(numbers).all(axis=1)),
        ("a size that is not positive", ~(numbers[:, :3] > 0).all(axis=1)),
        ("a quaternion of zero length", (numbers[:, 3:7] == 0).all(axis=1)),
    ]
    for what, bad in checks:
        if bad.any():
            row = int(np.argmax(bad))
            raise FormatError(f"{path}: {int(bad.sum())} cuboids, the first in row {row}, have {what}")
    names, codes = _unique(table["category"])
    unknown = [name for name in names if name not in ARGOVERSE_CLASSES and name not in OTHER_CLASSES]
    if unknown:
        raise FormatError(f"{path} holds the unknown category {unknown[0]!r}; known are {', '.join(ARGOVERSE_CLASSES)}")
    number = {name: i for i, name in enumerate(ARGOVERSE_CLASSES)}
    labels = np.array([number.get(name, -1) for name in names] or [0], dtype=np.int64)[codes]
    kept = np.flatnonzero(labels >= 0)
    counts = np.bincount(codes, minlength=len(names))
    left_out = {name: int(count) for name, count in zip(names, counts, strict=True) if name not in number}
    boxes = np.column_stack([numbers[:, 7:10], numbers[:, :3], yaws_from_quaternions(numbers[:, 3:7])])
    # the largest angle that arctan2 gives is pi itself, which the canonical box writes as -pi
    boxes[boxes[:, 6] >= np.pi, 6] = -np.pi
    return boxes[kept], labels[kept], kept, left_out


def _transforms(path: Path, table: Mapping[str, NDArray[Any]]) -> FloatArray:
    values = np.stack([table[name] for name in _POSE], axis=1)
    if not np.isfinite(values).all() or (values[:, :4] == 0).all(axis=1).any():
        raise FormatError(f"{path} holds poses with NaN, infinite or zero values")
    return rigid_transforms(values[:, :4], values[:, 4:])


def _unique(names: NDArray[Any]) -> tuple[tuple[str, ...], IntArray]:
    """The different names in order of appearance, and (N,) which one each is."""
    position: dict[str, int] = {}
    codes = np.fromiter((position.setdefault(name, len(position)) for name in names), np.int64, len(names))
    return tuple(position), codes


def _nothing() -> tuple[IntArray, IntArray, FloatArray, IntArray, FloatArray, IntArray]:
    integers = np.zeros(0, np.int64)
    return integers, integers, np.zeros((0, 7)), integers, np.zeros(0), integers

"""Reading the nuScenes tables: table by table in bounded memory, tokens resolved to row numbers, mistakes noted.

Only what detection needs is kept: key frames of the six cameras, key frames and sweeps of LIDAR_TOP, their poses and
calibrations, and the annotations. Radar, camera sweeps, maps and logs are passed over.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.check import Finding
from lcf3d.datasets.nuscenes_tables import (
    CAMERAS,
    CHANNELS,
    LIDAR,
    Annotations,
    NuscenesTables,
    Samples,
    SensorData,
    Tokens,
)
from lcf3d.errors import DatasetError
from lcf3d.formats.json_stream import iterate_records
from lcf3d.formats.nuscenes_boxes import NUSCENES_ATTRIBUTES
from lcf3d.structures import FloatArray, IntArray

UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion may be from 1."""


def load_tables(root: Path, version: str) -> NuscenesTables:
    """The tables in ``root/version``.

    Raises:
        DatasetError: a folder or table is absent or malformed, a token is dangling (which table, which token) or
            repeated, a quaternion is not of unit length, a sample has no LIDAR_TOP sweep. `check_nuscenes` lists all.
    """
    tables, findings = read_tables(root, version)
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        more = f" (and {len(errors) - 1} more; lcf3d check nuscenes:{root} lists them)" if len(errors) > 1 else ""
        raise DatasetError(errors[0].message + more)
    return tables


def read_tables(root: Path, version: str) -> tuple[NuscenesTables, list[Finding]]:
    """The tables, with every inconsistency met on the way (rules NUS02 to NUS08 of `check_nuscenes`).

    Raises:
        DatasetError: a folder or table is absent or malformed, so that reading cannot go on.
    """
    folder = root / version
    if not folder.is_dir():
        versions = sorted(path.parent.name for path in root.glob("*/sample_data.json"))
        there = f"there are {', '.join(versions)}" if versions else "there is no folder with sample_data.json"
        raise DatasetError(f"{folder} is not a folder of nuScenes tables; {there}")
    reader = _Reader(folder)
    scene = reader.columns("scene", {"token": _TEXT, "name": _TEXT})
    scene_index = reader.index("scene", scene["token"])
    sample = reader.columns("sample", {"token": _TEXT, "timestamp": _INTEGER, "scene_token": _TEXT})
    sample_index = reader.index("sample", sample["token"])
    scenes = reader.resolve(scene_index, sample["scene_token"], "sample", sample["token"], "scene")
    data = _read_sensor_data(reader, sample_index)
    lidar, cameras = _key_frames(reader, data, sample["token"])
    category_names, annotations = _read_annotations(reader, sample_index)
    tables = NuscenesTables(
        root,
        version,
        tuple(name.decode() for name in scene["name"].tolist()),
        category_names,
        Samples(sample["token"], sample["timestamp"], scenes, lidar, cameras),
        data,
        annotations,
    )
    return tables, reader.findings


# how a value of a record becomes an element of a column: getter (None: the value itself), dtype, shape
_Spec = tuple[Callable[[Any], Any] | None, Any, tuple[int, ...]]
_TEXT: _Spec = (None, "S", ())
_INTEGER: _Spec = (None, np.int64, ())
_VECTOR: _Spec = (None, np.float64, (3,))
_QUATERNION: _Spec = (None, np.float64, (4,))


class _TokenIndex:
    """Rows of a table by token."""

    def __init__(self, table: str, tokens: Tokens) -> None:
        self.table = table
        self._order = np.argsort(tokens, kind="stable")
        self._sorted = tokens[self._order]

    def rows(self, tokens: Tokens) -> IntArray:
        """(N,) row of each token, -1 where the table does not hold it."""
        if not len(self._sorted) or not len(tokens):
            return np.full(len(tokens), -1, dtype=np.int64)
        position = np.minimum(np.searchsorted(self._sorted, tokens), len(self._sorted) - 1)
        return np.where(self._sorted[position] == tokens, self._order[position], -1)

    def repeated(self) -> list[bytes]:
        """Tokens that occur more than once."""
        return list(np.unique(self._sorted[1:][self._sorted[1:] == self._sorted[:-1]]))


MOST_METRES = 1e9
"""Nothing on Earth is farther from a map's origin."""


@dataclass
class _Reader:
    """Reads tables of one folder into columns and notes what is inconsistent."""

    folder: Path
    findings: list[Finding] = field(default_factory=list)

    def error(self, rule: str, message: str) -> None:
        self.findings.append(Finding(rule, "error", message))

    def columns(
        self, table: str, specs: Mapping[str, _Spec], keep: Callable[[dict[str, Any]], bool] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Columns of a table by key, of the records that ``keep`` selects."""
        parts: dict[str, list[NDArray[Any]]] = {key: [] for key in specs}
        path = self.folder / f"{table}.json"
        if not path.is_file():
            raise DatasetError(f"{path} is missing; a nuScenes table of that name is needed")
        for batch in iterate_records(path):
            records = batch if keep is None else _selected(path, batch, keep)
            for key, spec in specs.items():
                parts[key].append(_column(path, records, key, spec))
        return {key: np.concatenate(column) for key, column in parts.items()}

    def index(self, table: str, tokens: Tokens) -> _TokenIndex:
        """Rows of ``table`` by token; repeated tokens are noted (NUS03)."""
        index = _TokenIndex(table, tokens)
        for token in index.repeated():
            self.error("NUS03", f"{table}.json holds token {token.decode()} more than once")
        return index

    def resolve(
        self, target: _TokenIndex, tokens: Tokens, table: str, own: Tokens, what: str, optional: bool = False
    ) -> IntArray:
        """Rows of ``target`` that ``tokens`` name, -1 where dangling (NUS02) or, if ``optional``, empty."""
        rows = target.rows(tokens)
        dangling = rows < 0
        if optional:
            dangling &= tokens != b""
        for i in np.flatnonzero(dangling):
            self.error(
                "NUS02",
                f"{table}.json: record {own[i].decode()} names {what} {tokens[i].decode()!r}, "
                f"which {target.table}.json does not hold",
            )
        return rows

    def require_unit(self, table: str, tokens: Tokens, rotations: FloatArray) -> None:
        """Note quaternions that are not of unit length (NUS04)."""
        norms = np.linalg.norm(rotations, axis=1)
        for i in np.flatnonzero(~(np.abs(norms - 1) <= UNIT_TOLERANCE)):
            self.error(
                "NUS04", f"{table}.json: the rotation of record {tokens[i].decode()} has length {norms[i]:.6g}, not 1"
            )


def _selected(
    path: Path, records: list[dict[str, Any]], keep: Callable[[dict[str, Any]], bool]
) -> list[dict[str, Any]]:
    try:
        return [record for record in records if keep(record)]
    except KeyError as error:
        raise DatasetError(f"{path}: a record has no {error.args[0]!r}") from None
    except TypeError:
        raise DatasetError(f"{path}: a record's token is not text, or it is no record") from None


def _column(path: Path, records: list[dict[str, Any]], key: str, spec: _Spec) -> NDArray[Any]:
    getter, dtype, shape = spec
    try:
        values = [record[key] for record in records]
        if getter is not None:
            values = [getter(value) for value in values]
        column = np.array(values, dtype=dtype)
    except KeyError:
        raise DatasetError(f"{path}: a record has no {key!r}") from None
    except (TypeError, ValueError, OverflowError):
        column = np.empty(())
    if records and column.shape != (len(records), *shape):
        expected = f"{' x '.join(map(str, shape))} numbers" if shape else "one value"
        raise DatasetError(f"{path}: {key!r} of a record cannot be read, expected {expected}")
    if spec in (_VECTOR, _QUATERNION) and not (np.abs(column) < MOST_METRES).all():
        raise DatasetError(f"{path}: {key!r} of a record holds NaN, infinite or impossibly large values")
    return column.reshape(len(records), *shape)


@dataclass(frozen=True, eq=False)
class _Calibrations:
    """Columns of ``calibrated_sensor.json``, with the number of each sensor in `CHANNELS` (-1 for others)."""

    index: _TokenIndex
    tokens: Tokens
    channels: IntArray
    rotations: FloatArray
    translations: FloatArray
    intrinsics: FloatArray


def _read_calibrations(reader: _Reader) -> _Calibrations:
    sensor = reader.columns("sensor", {"token": _TEXT, "channel": _TEXT})
    # the intrinsics of anything but a camera are empty
    intrinsic: _Spec = (lambda value: value or [[np.nan] * 3] * 3, np.float64, (3, 3))
    table = reader.columns(
        "calibrated_sensor",
        {
            **dict.fromkeys(("token", "sensor_token"), _TEXT),
            "translation": _VECTOR,
            "rotation": _QUATERNION,
            "camera_intrinsic": intrinsic,
        },
    )
    own = table["token"]
    if not len(own):
        raise DatasetError(f"{reader.folder / 'calibrated_sensor.json'} is empty; no sensor can be placed")
    index = reader.index("calibrated_sensor", own)
    reader.require_unit("calibrated_sensor", own, table["rotation"])
    sensor_index = reader.index("sensor", sensor["token"])
    sensor_rows = reader.resolve(sensor_index, table["sensor_token"], "calibrated_sensor", own, "sensor")
    numbers = {channel.encode(): i for i, channel in enumerate(CHANNELS)}
    # other sensors get -1, dangling ones too: they have been noted above
    channel_of_sensor = np.array([*(numbers.get(name, -1) for name in sensor["channel"].tolist()), -1], dtype=np.int64)
    return _Calibrations(
        index,
        own,
        channel_of_sensor[sensor_rows],
        table["rotation"],
        table["translation"],
        table["camera_intrinsic"],
    )


def _read_recordings(reader: _Reader, calibrations: _Calibrations) -> dict[str, NDArray[Any]]:
    """Columns of ``sample_data.json``: LiDAR recordings, and key frames of the cameras."""
    lidar = CHANNELS.index(LIDAR)
    tokens = (token.decode() for token in calibrations.tokens.tolist())
    channel_by_token = dict(zip(tokens, calibrations.channels.tolist(), strict=True))

    def wanted(record: dict[str, Any]) -> bool:
        # a dangling calibration token passes, to be noted
        channel = channel_by_token.get(record["calibrated_sensor_token"], lidar)
        return channel == lidar or (channel >= 0 and bool(record["is_key_frame"]))

    specs: dict[str, _Spec] = {
        **dict.fromkeys(("token", "sample_token", "ego_pose_token", "calibrated_sensor_token", "prev"), _TEXT),
        **dict.fromkeys(("timestamp", "width", "height"), (lambda value: value or 0, np.int64, ())),
        "filename": _TEXT,
        "is_key_frame": (None, np.bool_, ()),
    }
    return reader.columns("sample_data", specs, wanted)


def _read_sensor_data(reader: _Reader, sample_index: _TokenIndex) -> SensorData:
    calibrations = _read_calibrations(reader)
    data = _read_recordings(reader, calibrations)
    own = data["token"]
    rows = reader.resolve(calibrations.index, data["calibrated_sensor_token"], "sample_data", own, "calibrated_sensor")
    samples = reader.resolve(sample_index, data["sample_token"], "sample_data", own, "sample")
    pose_rotations, pose_translations = _read_poses(reader, data["ego_pose_token"], own)
    channel = np.append(calibrations.channels, -1)[rows]
    previous = np.full(len(own), -1, dtype=np.int64)
    is_lidar = channel == CHANNELS.index(LIDAR)
    previous[is_lidar] = reader.resolve(
        reader.index("sample_data", own), data["prev"][is_lidar], "sample_data", own[is_lidar], "prev", optional=True
    )
    finite = np.asarray(np.isfinite(calibrations.intrinsics).all(axis=(1, 2)), dtype=bool)
    known = finite[rows] & (data["width"] > 0) & (data["height"] > 0)
    for i in np.flatnonzero((channel >= 0) & ~is_lidar & ~known):
        reader.error("NUS06", f"sample_data.json: image {own[i].decode()} has no camera_intrinsic, width or height")
    return SensorData(
        own,
        samples,
        channel,
        data["timestamp"],
        data["is_key_frame"],
        data["filename"],
        np.stack([data["width"], data["height"]], axis=1),
        previous,
        pose_rotations,
        pose_translations,
        calibrations.rotations[rows],
        calibrations.translations[rows],
        calibrations.intrinsics[rows],
    )


def _read_poses(reader: _Reader, tokens: Tokens, own: Tokens) -> tuple[FloatArray, FloatArray]:
    """Rotations (D, 4) and translations (D, 3) of the ego poses that ``tokens`` name."""
    poses = reader.columns(
        "ego_pose",
        {"token": _TEXT, "rotation": _QUATERNION, "translation": _VECTOR},
        # as many poses as recordings of all sensors: those of other sensors are left out at once
        _membership(tokens),
    )
    reader.require_unit("ego_pose", poses["token"], poses["rotation"])
    rows = reader.resolve(reader.index("ego_pose", poses["token"]), tokens, "sample_data", own, "ego_pose")
    if not len(poses["token"]):
        return np.tile([1.0, 0, 0, 0], (len(tokens), 1)), np.zeros((len(tokens), 3))
    return poses["rotation"][rows], poses["translation"][rows]


def _membership(tokens: Tokens) -> Callable[[dict[str, Any]], bool]:
    """Whether a record's token is among ``tokens``."""
    known = {token.decode() for token in tokens.tolist()}
    return lambda record: record["token"] in known


def _key_frames(reader: _Reader, data: SensorData, sample_tokens: Tokens) -> tuple[IntArray, IntArray]:
    """Rows of each sample's LIDAR_TOP (M,) and camera (M, 6) key frames; samples without LiDAR are noted (NUS05)."""
    table = np.full((len(sample_tokens), len(CHANNELS)), -1, dtype=np.int64)
    rows = np.flatnonzero(data.key_frames & (data.samples >= 0) & (data.channels >= 0))
    table[data.samples[rows], data.channels[rows]] = rows
    lidar = table[:, CHANNELS.index(LIDAR)]
    for i in np.flatnonzero(lidar < 0):
        reader.error("NUS05", f"sample {sample_tokens[i].decode()} has no {LIDAR} key frame in sample_data.json")
    return lidar, table[:, : len(CAMERAS)]


def _read_annotations(reader: _Reader, sample_index: _TokenIndex) -> tuple[tuple[str, ...], Annotations]:
    category = reader.columns("category", {"token": _TEXT, "name": _TEXT})
    attribute = reader.columns("attribute", {"token": _TEXT, "name": _TEXT})
    instance = reader.columns("instance", {"token": _TEXT, "category_token": _TEXT})
    category_of_instance = reader.resolve(
        reader.index("category", category["token"]),
        instance["category_token"],
        "instance",
        instance["token"],
        "category",
    )
    table = reader.columns(
        "sample_annotation",
        {
            **dict.fromkeys(("token", "sample_token", "instance_token", "prev", "next"), _TEXT),
            **dict.fromkeys(("translation", "size"), _VECTOR),
            "rotation": _QUATERNION,
            **dict.fromkeys(("num_lidar_pts", "num_radar_pts"), _INTEGER),
            "attribute_tokens": (",".join, "S", ()),
        },
    )
    own = table["token"]
    own_index = reader.index("sample_annotation", own)
    reader.require_unit("sample_annotation", own, table["rotation"])

    for i in np.flatnonzero(np.char.find(table["attribute_tokens"], b",") >= 0):
        reader.error(
            "NUS08", f"sample_annotation.json: record {own[i].decode()} has several attributes, one is allowed"
        )
        table["attribute_tokens"][i] = b""

    def resolve(target: _TokenIndex, column: str, what: str, optional: bool = False) -> IntArray:
        return reader.resolve(target, table[column], "sample_annotation", own, what, optional)

    instances = resolve(reader.index("instance", instance["token"]), "instance_token", "instance")
    attributes = resolve(reader.index("attribute", attribute["token"]), "attribute_tokens", "attribute", True)
    numbers = {name.encode(): i for i, name in enumerate(NUSCENES_ATTRIBUTES)}
    number_of_attribute = np.array([*(numbers.get(name, -1) for name in attribute["name"].tolist()), -1], np.int64)
    for i in np.flatnonzero(~(table["size"] > 0).all(axis=1)):
        reader.error("NUS07", f"sample_annotation.json: the size of record {own[i].decode()} is not positive")
    return tuple(name.decode() for name in category["name"].tolist()), Annotations(
        own,
        resolve(sample_index, "sample_token", "sample"),
        np.append(category_of_instance, -1)[instances],
        table["translation"],
        table["size"],
        table["rotation"],
        resolve(own_index, "prev", "prev", optional=True),
        resolve(own_index, "next", "next", optional=True),
        table["num_lidar_pts"] + table["num_radar_pts"],
        number_of_attribute[attributes],
        instances,
    )


def find_version(root: Path) -> str:
    """Name of the one folder of tables in ``root``.

    Raises:
        DatasetError: there is none, or several.
    """
    versions = sorted(path.parent.name for path in root.glob("*/sample_data.json"))
    if len(versions) != 1:
        there = f"several ({', '.join(versions)}); name one" if versions else "none"
        raise DatasetError(f"{root} should hold one folder of nuScenes tables such as v1.0-mini, there are {there}")
    return versions[0]

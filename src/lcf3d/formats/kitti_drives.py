"""Files that come with KITTI's drives: GPS/IMU records, time stamps, camera poses, tracking labels and tracklets."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import FormatError
from lcf3d.files import read_text
from lcf3d.formats.kitti import KittiObjects, objects_from_table
from lcf3d.formats.kitti_text import parse_tracking
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.geometry.rotation import rotation_matrices
from lcf3d.structures import FloatArray, IntArray

EARTH_RADIUS_M = 6378137.0
"""Radius of the sphere on which the map of the drives is drawn."""

TRUNCATION_LEVELS = (0.0, 0.25, 0.6)
"""Shares outside the image that the levels 0, 1, 2 of tracking labels are taken for: one in each difficulty's range."""

OXTS_COLUMNS = 30


def read_oxts(path: Path) -> FloatArray:
    """(N, 30) GPS/IMU records, one a line.

    Latitude and longitude in degrees, altitude in metres, roll, pitch and yaw in radians; then velocities,
    accelerations, rates and accuracies.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is malformed; names it.
    """
    return _numbers(path, OXTS_COLUMNS, at_least=6)


def poses_from_oxts(records: FloatArray) -> FloatArray:
    """(N, 4, 4) ``world_from_imu`` of (N, 6 or more) records.

    The world's origin is where the first record was taken, its axes point east, north and up. Positions are drawn on a
    Mercator map that is true to scale at the first record's latitude.
    """
    if not len(records):
        return np.zeros((0, 4, 4))
    latitude, longitude, altitude = records[:, 0], records[:, 1], records[:, 2]
    scale = np.cos(np.radians(latitude[0])) * EARTH_RADIUS_M
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    poses = np.tile(np.eye(4), (len(records), 1, 1))
    poses[:, :3, :3] = _rotations(records[:, 3], records[:, 4], records[:, 5])
    position = np.stack([east, north, altitude], axis=1)
    poses[:, :3, 3] = position - position[0]
    return poses


def read_camera_poses(path: Path) -> FloatArray:
    """(N, 4, 4) ``world_from_camera`` of a pose file, the twelve numbers of a 3 x 4 matrix a line.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is malformed; names it.
    """
    rows = _numbers(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return poses


def read_times(path: Path) -> FloatArray:
    """(N,) seconds of a time file: one a line, as a number (odometry) or as a date and time of UTC (raw drives).

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is neither; names it.
    """
    times = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        text = line.strip()
        if not text:
            # a lost scan of a raw drive has no time
            times.append(np.nan)
            continue
        try:
            times.append(float(text) if " " not in text else _seconds(text))
        except ValueError:
            raise FormatError(f"{path}:{number}: expected a time in seconds or a date and time, got {text!r}") from None
    return np.array(times)


def _seconds(text: str) -> float:
    whole, _, fraction = text.partition(".")
    moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc)
    return moment.timestamp() + float(f"0.{fraction or 0}")


@dataclass(frozen=True, eq=False)
class TrackedObjects:
    """Labels of one frame of a drive.

    Attributes:
        objects: as in an object label file.
        track_ids: (N,) which object each is, the same through the drive; -1 for none.
    """

    objects: KittiObjects
    track_ids: IntArray


def read_tracking_labels(path: Path) -> dict[int, TrackedObjects]:
    """Labels of a tracking file by frame number; frames without a line are not in it.

    Truncation levels are written as `TRUNCATION_LEVELS`.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is malformed; names it.
    """
    frames, tracks, names, values = parse_tracking(path)
    levels = values[:, 0]
    known = (levels >= 0) & (levels < len(TRUNCATION_LEVELS)) & (levels == np.round(levels))
    values[known, 0] = np.array(TRUNCATION_LEVELS)[levels[known].astype(np.int64)]
    found = {}
    for frame in np.unique(frames).tolist():
        rows = frames == frame
        found[frame] = TrackedObjects(objects_from_table(names[rows], values[rows]), tracks[rows])
    return found


@dataclass(frozen=True, eq=False)
class Tracklets:
    """Labelled boxes of a raw drive, one row an object and frame.

    Attributes:
        frames: (N,) frame numbers.
        track_ids: (N,) which object.
        class_names: (N,) its class.
        boxes: (N, 7) canonical boxes in the Velodyne frame.
    """

    frames: IntArray
    track_ids: IntArray
    class_names: NDArray[np.str_]
    boxes: FloatArray


def read_tracklets(path: Path) -> Tracklets:
    """Boxes of a raw drive's ``tracklet_labels.xml``.

    Raises:
        FormatError: it cannot be read, or misses a number.
    """
    try:
        root = ElementTree.parse(path).getroot()
        items = root.findall("tracklets/item")
        rows = [row for track, item in enumerate(items) for row in _tracklet(track, item)]
    except FileNotFoundError:
        raise FormatError(f"{path} does not exist") from None
    except ElementTree.ParseError as error:
        raise FormatError(f"{path} is no XML file ({error})") from None
    except (ValueError, TypeError) as error:
        raise FormatError(f"{path} is no file of tracklets ({error})") from None
    values = np.array([row[3:] for row in rows], dtype=np.float64).reshape(-1, 7)
    values[:, 6] = wrap_angle(values[:, 6])
    return Tracklets(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.int64),
        np.array([row[2] for row in rows], dtype=np.str_),
        values,
    )


def _tracklet(track: int, item: ElementTree.Element) -> list[tuple[Any, ...]]:
    """Frame, track, class and box of each pose; the position of a tracklet is the centre of the box's bottom."""
    height, width, length = (_number(item, name) for name in ("h", "w", "l"))
    first = int(_number(item, "first_frame"))
    name = item.findtext("objectType", "").strip().replace("Person (sitting)", "Person_sitting")
    rows = []
    for i, pose in enumerate(item.findall("poses/item")):
        x, y, z, yaw = (_number(pose, name) for name in ("tx", "ty", "tz", "rz"))
        rows.append((first + i, track, name, x, y, z + height / 2, length, width, height, yaw))
    return rows


def _number(element: ElementTree.Element, name: str) -> float:
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"<{element.tag}> has no <{name}>")
    return float(text)


def _numbers(path: Path, columns: int, at_least: int | None = None) -> FloatArray:
    """(N, columns) numbers of a text file; with ``at_least``, lines may end early and the rest is NaN."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        fields = line.split()
        if not fields:
            continue
        if not (at_least or columns) <= len(fields) <= columns:
            raise FormatError(f"{path}:{number}: expected {columns} numbers, got {len(fields)}")
        try:
            row = [float(field) for field in fields]
        except ValueError:
            raise FormatError(f"{path}:{number}: expected {columns} numbers, got {line.strip()[:40]!r}") from None
        if not np.isfinite(row).all():
            raise FormatError(f"{path}:{number}: holds NaN or infinite values")
        rows.append(row + [np.nan] * (columns - len(row)))
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _rotations(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 3, 3) rotations by roll about x, then pitch about y, then yaw about z."""
    half = np.stack([roll, pitch, yaw]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    quaternions = np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )
    return rotation_matrices(quaternions)

"""What may be pushed into a stream: one frozen record a kind of message, times in seconds of the sensors' clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.structures import Camera, Detections2D, Detections3D, FloatArray


@dataclass(frozen=True, eq=False)
class Scan:
    """A LiDAR scan: (N, 3 or more) points x, y, z, intensity, ... in the LiDAR frame at ``time``."""

    time: float
    points: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class LidarBoxes:
    """3D detections in the LiDAR frame at ``time``, that of their scan."""

    time: float
    detections: Detections3D


@dataclass(frozen=True, eq=False)
class Image:
    """A (H, W, 3) uint8 RGB image of one camera."""

    time: float
    camera: str
    pixels: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class CameraBoxes:
    """2D detections of one camera at ``time``, that of their image; ``pixels`` are for those who look at the result."""

    time: float
    camera: str
    detections: Detections2D
    pixels: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class EgoPose:
    """(4, 4) pose of the LiDAR in a frame that does not move."""

    time: float
    world_from_lidar: FloatArray


@dataclass(frozen=True, eq=False)
class CameraModel:
    """The calibration of one camera, for scans from ``time`` on; the first one serves all earlier scans too."""

    time: float
    camera: Camera


Message = Scan | LidarBoxes | Image | CameraBoxes | EgoPose | CameraModel


def source_of(message: Message) -> str:
    """Name of the stream that a message belongs to: ``lidar``, ``scan``, ``pose`` or ``camera NAME``.

    Raises:
        ConfigError: it is no message.
    """
    if isinstance(message, Image | CameraBoxes):
        return f"camera {message.camera}"
    if isinstance(message, CameraModel):
        return f"calibration {message.camera.name}"
    for kind, source in ((Scan, "scan"), (LidarBoxes, "lidar"), (EgoPose, "pose")):
        if isinstance(message, kind):
            return source
    raise ConfigError(
        f"a stream takes Scan, LidarBoxes, Image, CameraBoxes, EgoPose and CameraModel, not {type(message).__name__}"
    )


def is_whole(message: Message) -> bool:
    """Whether a message has a time and its data the shape that it should: what was cut off on the way has not."""
    if not isinstance(message.time, int | float | np.integer | np.floating):
        return False
    if isinstance(message, CameraModel):
        return isinstance(message.camera, Camera) and bool(np.isfinite(message.time))
    if isinstance(message, Scan):
        points = message.points
        known = isinstance(points, np.ndarray) and np.issubdtype(points.dtype, np.number)
        return known and points.ndim == 2 and points.shape[1] >= 3
    if isinstance(message, Image):
        return np.ndim(message.pixels) == 3 and np.shape(message.pixels)[2] == 3
    if isinstance(message, EgoPose):
        return _is_rigid(message.world_from_lidar)
    if isinstance(message, LidarBoxes):
        return isinstance(message.detections, Detections3D)
    return isinstance(message.detections, Detections2D)


def _is_rigid(transform: FloatArray) -> bool:
    """Whether something is a (4, 4) rotation and translation, but for rounding."""
    if np.shape(transform) != (4, 4) or not np.isfinite(transform).all():
        return False
    rotation = np.asarray(transform)[:3, :3]
    return bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2) and np.linalg.det(rotation) > 0)


def plain_points(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """(N, 4 or more) writable float32 points, row after row, of (N, 3 or more); without intensity it is 0.

    Of another layout, or of memory that cannot be written to, compiled functions would be compiled anew.
    """
    if np.shape(points)[1] == 3:
        points = np.concatenate([points, np.zeros((len(points), 1), np.float32)], axis=1)
    return np.require(points, np.float32, ["C_CONTIGUOUS", "WRITEABLE"])


def same_mount(camera: Camera, other: Camera) -> bool:
    """Whether two calibrations are of one camera on a moving car: equal but for a turn by a degree or so."""
    turn = camera.camera_from_lidar[:3, :3].T @ other.camera_from_lidar[:3, :3]
    same = np.allclose(camera.projection, other.projection) and (camera.width, camera.height) == (
        other.width,
        other.height,
    )
    return bool(same and np.trace(turn) > 1 + 2 * np.cos(np.deg2rad(3.0)))

"""One moment of all sensors: scan, cameras, images, labels, time and pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError, ShapeError
from lcf3d.structures import Camera, Detections3D, FloatArray, checked_array


@dataclass(frozen=True, eq=False)
class Sweep:
    """One LiDAR sweep before the key frame.

    Attributes:
        points: (N, 4 or more) ``x, y, z, intensity, ...`` in the LiDAR frame at the moment of the sweep.
        lidar_from_sweep: (4, 4) LiDAR coordinates of the key frame from those of the sweep.
        time_lag_s: seconds from the sweep to the key frame, positive for the past.
    """

    points: NDArray[np.floating]
    lidar_from_sweep: FloatArray
    time_lag_s: float


class Frame:
    """What the sensors saw at one moment; parts that are read from disk are read when first asked for.

    Args:
        id: name of the frame, unique in its dataset.
        points: (N, 4 or more) float32 ``x, y, z, intensity, ...`` in the LiDAR frame, a function that returns them,
            or None without a scan.
        cameras: the calibrated cameras, of different names.
        images: (H, W, 3) uint8 RGB image by camera name (a mapping that may load on access); cameras may be missing.
        labels: ground truth (scores 1), a function that returns it, or None.
        timestamp: moment of the scan in seconds, of any clock that the frames of a drive share; None if unknown.
        world_from_lidar: (4, 4) pose of the LiDAR frame in a frame that does not move; None if unknown.
        sequence: name of the drive that the frame is a moment of; None if it stands alone.
        sweeps: a function that reads at most so many sweeps before the scan, the latest first; None where there are
            none (see `Sweep`).
    """

    def __init__(
        self,
        id: str,
        points: NDArray[np.float32] | Callable[[], NDArray[np.float32]] | None = None,
        cameras: Sequence[Camera] = (),
        images: Mapping[str, NDArray[np.uint8]] | None = None,
        labels: Detections3D | Callable[[], Detections3D] | None = None,
        timestamp: float | None = None,
        world_from_lidar: FloatArray | None = None,
        sequence: str | None = None,
        sweeps: Callable[[int], Sequence[Sweep]] | None = None,
    ) -> None:
        self.id = id
        self._sweeps = sweeps
        self._sweeps_read: tuple[int, tuple[Sweep, ...]] | None = None
        self.timestamp = timestamp
        self.sequence = sequence
        self.world_from_lidar = (
            None
            if world_from_lidar is None
            else checked_array(world_from_lidar, np.float64, (4, 4), "Frame.world_from_lidar")
        )
        self.cameras = tuple(cameras)
        self.images: Mapping[str, NDArray[np.uint8]] = {} if images is None else images
        self._points = points
        self._labels = labels
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names):
            raise ConfigError(f"frame {id}: camera names must differ, got {names}")

    @property
    def points(self) -> NDArray[np.float32] | None:
        """(N, 4 or more) float32 points in the LiDAR frame, or None without a scan."""
        if callable(self._points):
            self._points = self._points()
        if self._points is not None and (self._points.ndim != 2 or self._points.shape[1] < 4):
            raise ShapeError(f"frame {self.id}: points must have shape (N, 4 or more), got {self._points.shape}")
        return self._points

    def sweeps(self, count: int) -> Sequence[Sweep]:
        """At most ``count`` LiDAR sweeps before the scan, the latest first; those read last are kept."""
        if self._sweeps is None or count < 1:
            return ()
        if self._sweeps_read is None or self._sweeps_read[0] != count:
            self._sweeps_read = (count, tuple(self._sweeps(count)))
        return self._sweeps_read[1]

    @property
    def labels(self) -> Detections3D | None:
        """Ground truth in the LiDAR frame, or None without it."""
        if callable(self._labels):
            self._labels = self._labels()
        return self._labels

    def camera(self, name: str) -> Camera:
        """The camera of that name.

        Raises:
            ConfigError: there is none.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise ConfigError(f"frame {self.id} has no camera {name!r}; it has {[c.name for c in self.cameras]}")

    def with_cameras(self, cameras: Sequence[Camera]) -> Frame:
        """The same frame with other cameras; scan, images and labels are those of this one, read when asked for."""
        frame = copy(self)
        frame.cameras = tuple(cameras)
        return frame

    def __repr__(self) -> str:
        return f"Frame({self.id!r}, cameras={[c.name for c in self.cameras]})"

"""One log of Argoverse 2: what its files say, each read when first asked for."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.files import list_files
from lcf3d.formats.argoverse import Calibration, Cuboids, read_annotations, read_calibration, read_poses
from lcf3d.formats.feather import read_columns
from lcf3d.structures import Detections3D, FloatArray, IntArray

CALIBRATION = "calibration/egovehicle_SE3_sensor.feather"
POSES = "city_SE3_egovehicle.feather"
SPLITS = ("train", "val", "test")

MAX_POSE_GAP_NS = 20_000_000
"""Longest accepted time between a frame and the nearest ego pose; poses come 150 times a second and more."""


class Argoverse2Log:
    """One log: what its files say, each read when first asked for.

    Args:
        folder: the folder of the log; its name is the log's id.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.id = folder.name

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration of all sensors."""
        return read_calibration(self.folder / "calibration")

    @cached_property
    def annotations(self) -> Cuboids | None:
        """Cuboids of all sweeps, or None where the log has none."""
        path = self.folder / "annotations.feather"
        return read_annotations(path, self.id) if path.is_file() else None

    @cached_property
    def sweeps(self) -> dict[int, Path]:
        """Sweep files by time in nanoseconds."""
        return _by_time(list_files(self.folder / "sensors/lidar", ".feather"))

    @cached_property
    def _poses(self) -> tuple[IntArray, FloatArray]:
        return read_poses(self.folder / POSES)

    @cached_property
    def _images(self) -> dict[str, tuple[IntArray, list[Path]]]:
        """Times, ascending, and files of each camera's images."""
        found = {}
        for folder in list_files(self.folder / "sensors/cameras"):
            paths = _by_time(list_files(folder, ".jpg"))
            found[folder.name] = np.array(sorted(paths), dtype=np.int64), [paths[time] for time in sorted(paths)]
        return found

    def times(self) -> IntArray:
        """(F,) times in nanoseconds, ascending, at which there is a sweep or an annotation."""
        annotated = np.zeros(0, np.int64)
        path = self.folder / "annotations.feather"
        if path.is_file():
            annotated = read_columns(path, {"timestamp_ns": np.int64})["timestamp_ns"]
        return np.union1d(annotated, np.array(list(self.sweeps), dtype=np.int64))

    def _pose_row(self, time: int) -> int:
        times = self._poses[0]
        row = nearest(times, time)
        return -1 if row < 0 or abs(int(times[row]) - time) > MAX_POSE_GAP_NS else row

    def has_pose(self, time: int) -> bool:
        """Whether there is an ego pose within `MAX_POSE_GAP_NS` of ``time`` in nanoseconds."""
        return self._pose_row(time) >= 0

    def city_from_ego(self, time: int) -> FloatArray:
        """(4, 4) ego pose at the moment nearest to ``time`` in nanoseconds for which there is one.

        Raises:
            DatasetError: there is none within `MAX_POSE_GAP_NS`.
        """
        row = self._pose_row(time)
        if row < 0:
            raise DatasetError(f"{self.folder / POSES} has no pose within 20 ms of {time} ns")
        pose: FloatArray = self._poses[1][row]
        return pose

    def image(self, camera: str, time: int, max_delay_s: float) -> tuple[int, Path] | None:
        """Time and file of the camera's image nearest to ``time``, or None without one within ``max_delay_s``."""
        times, paths = self._images.get(camera, (np.zeros(0, np.int64), []))
        row = nearest(times, time)
        if row < 0 or abs(int(times[row]) - time) > max_delay_s * 1e9:
            return None
        return int(times[row]), paths[row]

    def labels(self, time: int, min_points: int) -> Detections3D:
        """Annotations of the sweep at ``time`` with at least ``min_points`` points inside."""
        assert self.annotations is not None
        rows = (self.annotations.timestamps_ns == time) & (self.annotations.point_counts >= min_points)
        return self.annotations[rows].detections()


def find_logs(root: Path) -> list[Path]:
    """Folders of logs: ``root`` itself, those in it, or those in its (or ``root/sensor``'s) folders of `SPLITS`."""
    places = ("", "*/", *(f"{above}{split}/*/" for above in ("", "sensor/") for split in SPLITS))
    return sorted({path.parent.parent for place in places for path in root.glob(place + CALIBRATION)})


def nearest(times: IntArray, time: int) -> int:
    """Row of the entry of ascending ``times`` (N,) nearest to ``time``, or -1 of none."""
    if not len(times):
        return -1
    after = int(np.searchsorted(times, time))
    if after == 0 or after == len(times):
        return min(after, len(times) - 1)
    return after if times[after] - time < time - times[after - 1] else after - 1


def _by_time(paths: Iterable[Path]) -> dict[int, Path]:
    return {int(path.stem): path for path in paths if path.stem.isdigit()}

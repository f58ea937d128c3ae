"""Argoverse 2 Sensor data set: ring cameras, stereo pair, LiDAR sweeps, ego poses and annotations, without its package.

    ROOT/SPLIT/LOG/annotations.feather              cuboids by sweep (absent in the test split)
    ROOT/SPLIT/LOG/calibration/*.feather            intrinsics, egovehicle_SE3_sensor
    ROOT/SPLIT/LOG/city_SE3_egovehicle.feather      ego poses at the times of all sensors
    ROOT/SPLIT/LOG/sensors/lidar/TIME.feather       sweeps, both LiDARs joined, in the egovehicle frame
    ROOT/SPLIT/LOG/sensors/cameras/NAME/TIME.jpg    images, undistorted

A frame is a moment with a sweep or with annotations; its id is ``LOG_TIME`` with the time in nanoseconds. Its LiDAR
frame is the egovehicle frame at that time: x forward, y left, z up, origin on the ground side of the rear axle. Each
camera's ``camera_from_lidar`` leads through the ego poses at both times, since images are not taken with the sweeps.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from lcf3d.datasets.images import ImageFiles
from lcf3d.errors import DatasetError
from lcf3d.formats.argoverse import (
    ARGOVERSE_CLASSES,
    Calibration,
    Cuboids,
    read_annotations,
    read_calibration,
    read_poses,
    read_sweep,
)
from lcf3d.formats.feather import read_columns
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import Camera, Detections3D, FloatArray, Frame, IntArray

RING_CAMERAS = (
    "ring_front_center",
    "ring_front_left",
    "ring_front_right",
    "ring_side_left",
    "ring_side_right",
    "ring_rear_left",
    "ring_rear_right",
)
STEREO_CAMERAS = ("stereo_front_left", "stereo_front_right")

MAX_CAMERA_DELAY_S = 0.05
"""Longest accepted time between an image and its sweep: a ring camera takes one every 50 ms."""

MAX_POSE_GAP_NS = 20_000_000
"""Longest accepted time between a frame and the nearest ego pose; poses come 150 times a second and more."""

_POSES = "city_SE3_egovehicle.feather"
_CALIBRATION = "calibration/egovehicle_SE3_sensor.feather"


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
        return _by_time((self.folder / "sensors/lidar").glob("*.feather"))

    @cached_property
    def _poses(self) -> tuple[IntArray, FloatArray]:
        return read_poses(self.folder / _POSES)

    @cached_property
    def _images(self) -> dict[str, tuple[IntArray, list[Path]]]:
        """Times, ascending, and files of each camera's images."""
        found = {}
        for folder in sorted((self.folder / "sensors/cameras").glob("*")):
            paths = _by_time(folder.glob("*.jpg"))
            found[folder.name] = np.array(sorted(paths), dtype=np.int64), [paths[time] for time in sorted(paths)]
        return found

    def times(self) -> IntArray:
        """(F,) times in nanoseconds, ascending, at which there is a sweep or an annotation."""
        annotated = np.zeros(0, np.int64)
        path = self.folder / "annotations.feather"
        if path.is_file():
            annotated = read_columns(path, {"timestamp_ns": np.int64})["timestamp_ns"]
        return np.union1d(annotated, np.array(list(self.sweeps), dtype=np.int64))

    def city_from_ego(self, time: int) -> FloatArray:
        """(4, 4) ego pose at the moment nearest to ``time`` in nanoseconds for which there is one.

        Raises:
            DatasetError: there is none within `MAX_POSE_GAP_NS`.
        """
        times, poses = self._poses
        row = nearest(times, time)
        if row < 0 or abs(int(times[row]) - time) > MAX_POSE_GAP_NS:
            raise DatasetError(f"{self.folder / _POSES} has no pose within 20 ms of {time} ns")
        pose: FloatArray = poses[row]
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


class Argoverse2Dataset(Sequence[Frame]):
    """Frames of an Argoverse 2 Sensor folder.

    Args:
        root: a folder of splits, one split, or one log.
        split: ``train``, ``val`` or ``test``: only the logs in a folder of that name; None for all.
        log: only this log.
        max_camera_delay_s: longest accepted time between an image and its frame; later images are left out.
        min_points: annotations with fewer LiDAR points are no labels (official evaluation: 1).

    Raises:
        DatasetError: no such log is there.
    """

    class_names = ARGOVERSE_CLASSES
    camera_names = (*RING_CAMERAS, *STEREO_CAMERAS)
    used_cameras = RING_CAMERAS
    stereo_pair = STEREO_CAMERAS

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        *,
        log: str | None = None,
        max_camera_delay_s: float = MAX_CAMERA_DELAY_S,
        min_points: int = 1,
    ) -> None:
        self.root = Path(root)
        self.split = split
        self.max_camera_delay_s = max_camera_delay_s
        self.min_points = min_points
        folders = find_logs(self.root)
        chosen = [f for f in folders if split in (None, f.parent.name) and log in (None, f.name)]
        if not chosen:
            splits = ", ".join(sorted({folder.parent.name for folder in folders})) or "none"
            wanted = f"{f' {log}' if log else ''}{f' of split {split!r}' if split else ''}"
            raise DatasetError(
                f"{self.root} holds no Argoverse 2 log{wanted}; expected ROOT/SPLIT/LOG/{_CALIBRATION}; "
                f"logs found: {len(folders)}, splits: {splits}"
            )
        self._folders = {folder.name: folder for folder in chosen}
        self.log_ids = tuple(self._folders)
        self._open = Argoverse2Log(chosen[0])

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Frame ids, log by log in order of time."""
        return tuple(frame_id(log, int(t)) for log in self.log_ids for t in Argoverse2Log(self._folders[log]).times())

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        return self.frame(self.ids[index])

    def log(self, log_id: str) -> Argoverse2Log:
        """The log of that id; the last one asked for stays in memory.

        Raises:
            DatasetError: there is none.
        """
        if log_id not in self._folders:
            raise DatasetError(f"{self.root} has no log {log_id!r}; its first is {self.log_ids[0]}")
        if self._open.id != log_id:
            self._open = Argoverse2Log(self._folders[log_id])
        return self._open

    def frame(self, id: str) -> Frame:
        """The frame ``LOG_TIME``; sweep, images and labels are read when first asked for.

        Raises:
            DatasetError: no such log, or no ego pose at that time.
            FormatError: its calibration or poses are malformed.
        """
        log_id, time = split_id(id)
        log = self.log(log_id)
        sweep = log.sweeps.get(time)
        if sweep is None and log.annotations is None:
            raise DatasetError(f"log {log_id} has no sweep at {time} ns")
        city_from_ego = log.city_from_ego(time)
        cameras, images = [], {}
        for name in self.camera_names:
            if name not in log.calibration.intrinsics:
                continue
            image = log.image(name, time, self.max_camera_delay_s)
            taken = time
            if image is not None:
                taken, images[name] = image
            cameras.append(_camera(log, name, log.city_from_ego(taken), city_from_ego))
        return Frame(
            id,
            points=None if sweep is None else lambda: read_sweep(sweep),
            cameras=cameras,
            images=ImageFiles(images),
            labels=None if log.annotations is None else lambda: log.labels(time, self.min_points),
            timestamp=time * 1e-9,
            world_from_lidar=city_from_ego,
            sequence=log_id,
        )

    def ground_truth(self) -> Cuboids:
        """Annotations of all logs that have any."""
        found = [Argoverse2Log(folder).annotations for folder in self._folders.values()]
        return Cuboids.concatenate([part for part in found if part is not None])


def results_of_frames(detections: Mapping[str, Detections3D]) -> Cuboids:
    """Cuboids of detections by frame id, in each frame's LiDAR frame."""
    by_log: dict[str, dict[int, Detections3D]] = {}
    for id, found in detections.items():
        log_id, time = split_id(id)
        by_log.setdefault(log_id, {})[time] = found
    return Cuboids.concatenate([Cuboids.from_detections(log_id, found) for log_id, found in by_log.items()])


def detections_by_frame(cuboids: Cuboids) -> dict[str, Detections3D]:
    """Detections by frame id of the sweeps that have any."""
    order = np.lexsort((cuboids.timestamps_ns, cuboids.logs))
    ordered = cuboids[order]
    change = (np.diff(ordered.timestamps_ns) != 0) | (np.diff(ordered.logs) != 0)
    starts = np.concatenate([[0], np.flatnonzero(change) + 1, [len(ordered)]])
    return {
        frame_id(ordered.log_ids[ordered.logs[a]], int(ordered.timestamps_ns[a])): ordered[a:b].detections()
        for a, b in pairwise(starts.tolist())
        if b > a
    }


def find_logs(root: Path) -> list[Path]:
    """Folders of logs: ``root`` itself or up to three folders below it, by split and name."""
    found = [path.parent.parent for depth in ("", "*/", "*/*/", "*/*/*/") for path in root.glob(depth + _CALIBRATION)]
    return sorted(found)


def frame_id(log_id: str, time: int) -> str:
    """The id of a log's frame at a time in nanoseconds."""
    return f"{log_id}_{time}"


def split_id(id: str) -> tuple[str, int]:
    """Log and time in nanoseconds of a frame id.

    Raises:
        DatasetError: it is none.
    """
    log_id, _, time = id.rpartition("_")
    if not log_id or not time.isdigit():
        raise DatasetError(f"an Argoverse 2 frame is named LOG_TIME with the time in nanoseconds, got {id!r}")
    return log_id, int(time)


def nearest(times: IntArray, time: int) -> int:
    """Row of the entry of ascending ``times`` (N,) nearest to ``time``, or -1 of none."""
    if not len(times):
        return -1
    after = int(np.searchsorted(times, time))
    if after == 0 or after == len(times):
        return min(after, len(times) - 1)
    return after if times[after] - time < time - times[after - 1] else after - 1


def _camera(log: Argoverse2Log, name: str, city_from_camera_ego: FloatArray, city_from_ego: FloatArray) -> Camera:
    camera_from_ego = invert_rigid(log.calibration.ego_from_sensor[name])
    camera_from_lidar = camera_from_ego @ invert_rigid(city_from_camera_ego) @ city_from_ego
    projection = np.hstack([log.calibration.intrinsics[name], np.zeros((3, 1))])
    return Camera(name, projection, camera_from_lidar, *log.calibration.sizes[name])


def _by_time(paths: Iterable[Path]) -> dict[int, Path]:
    return {int(path.stem): path for path in paths if path.stem.isdigit()}

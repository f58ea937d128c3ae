"""KITTI's drives: raw recordings, the tracking and the odometry benchmark, as ordered frames with time and ego pose.

All three are sequences of the same sensors, laid out differently; a `Drive` hides how. The LiDAR frame is the
Velodyne's, cameras are ``left`` and ``right`` (the colour pair, rectified), as in `lcf3d.datasets.kitti`. A frame's id
is ``SEQUENCE_NUMBER``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from lcf3d.datasets.kitti_calibration import KittiCalibration, read_calibration, read_raw_calibration
from lcf3d.errors import DatasetError
from lcf3d.files import list_files
from lcf3d.formats.kitti import KittiObjects, detections_3d
from lcf3d.formats.kitti_drives import (
    TrackedObjects,
    Tracklets,
    poses_from_oxts,
    read_camera_poses,
    read_oxts,
    read_times,
    read_tracking_labels,
    read_tracklets,
)
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import Detections3D, FloatArray

SCAN_PERIOD_S = 0.1
"""Time between scans; what a frame's time is counted in where a drive comes without time stamps."""


class Drive:
    """One sequence: where its files lie and what they say, each read when first asked for.

    Attributes:
        name: of the sequence, unique in its dataset.
        digits: of a frame number, as it is written in file names and frame ids.
        scan_folder: holds ``NUMBER.bin``.
        image_folders: hold the images, by camera name.
    """

    digits = 6

    def __init__(self, name: str, scan_folder: Path, image_folders: Mapping[str, Path]) -> None:
        self.name = name
        self.scan_folder = scan_folder
        self.image_folders = image_folders

    @cached_property
    def calibration(self) -> KittiCalibration:
        """Calibration of all frames."""
        raise NotImplementedError

    @cached_property
    def image_sizes(self) -> Mapping[str, tuple[int, int]]:
        """(width, height) by camera name, where the calibration says."""
        return {}

    @cached_property
    def scans(self) -> dict[int, Path]:
        """Scan files by frame number."""
        return _by_number(list_files(self.scan_folder, ".bin", ".npy"))

    @cached_property
    def images(self) -> dict[str, dict[int, Path]]:
        """Image files by camera name and frame number."""
        return {name: _by_number(list_files(folder)) for name, folder in self.image_folders.items()}

    @cached_property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the frames of which there is a scan, an image or a label."""
        found = set(self.scans).union(*self.images.values(), self._labelled())
        return tuple(sorted(found))

    def _labelled(self) -> set[int]:
        return set()

    @property
    def has_labels(self) -> bool:
        """Whether the drive is labelled; its frames without an object then have no labels, not unknown ones."""
        return False

    def labels(self, number: int, class_names: tuple[str, ...]) -> Detections3D:
        """Labelled boxes of a frame in the LiDAR frame."""
        raise NotImplementedError

    def time(self, number: int) -> float | None:
        """Seconds of a frame, None where a time file lacks it."""
        return _entry(self._times, number) if self._times is not None else number * SCAN_PERIOD_S

    @cached_property
    def _times(self) -> FloatArray | None:
        return None

    def world_from_lidar(self, number: int) -> FloatArray | None:
        """(4, 4) pose of a frame's LiDAR, in a frame of the drive's own; None where it is not known."""
        pose: FloatArray | None = self._poses.get(number)
        return pose

    @cached_property
    def _poses(self) -> dict[int, FloatArray]:
        return {}


class RawDrive(Drive):
    """``DATE/DRIVE_sync`` of the raw data, with the calibration in ``DATE``.

    Args:
        folder: of the drive, the rectified and synchronised form.
    """

    digits = 10

    def __init__(self, folder: Path) -> None:
        super().__init__(
            folder.name,
            folder / "velodyne_points/data",
            {"left": folder / "image_02/data", "right": folder / "image_03/data"},
        )
        self.folder = folder

    @cached_property
    def calibration(self) -> KittiCalibration:
        """From ``calib_cam_to_cam.txt`` and ``calib_velo_to_cam.txt`` (and ``calib_imu_to_velo.txt``)."""
        return self._day[0]

    @cached_property
    def image_sizes(self) -> Mapping[str, tuple[int, int]]:
        """From the sizes of the rectified images."""
        return self._day[1]

    @cached_property
    def _day(self) -> tuple[KittiCalibration, dict[str, tuple[int, int]]]:
        return read_raw_calibration(self.folder.parent)

    @cached_property
    def _tracklets(self) -> Tracklets | None:
        path = self.folder / "tracklet_labels.xml"
        return read_tracklets(path) if path.is_file() else None

    @property
    def has_labels(self) -> bool:
        """Whether there are tracklets."""
        return (self.folder / "tracklet_labels.xml").is_file()

    def labels(self, number: int, class_names: tuple[str, ...]) -> Detections3D:
        """Boxes of the tracklets."""
        assert self._tracklets is not None
        rows = self._tracklets.frames == number
        names = self._tracklets.class_names[rows]
        labels = np.array([class_names.index(n) if n in class_names else -1 for n in names.tolist()], dtype=np.int64)
        kept = labels >= 0
        return Detections3D(self._tracklets.boxes[rows][kept], np.ones(int(kept.sum())), labels[kept], class_names)

    @cached_property
    def _times(self) -> FloatArray | None:
        path = self.folder / "velodyne_points/timestamps.txt"
        return read_times(path) if path.is_file() else None

    @cached_property
    def _poses(self) -> dict[int, FloatArray]:
        paths = _by_number(list_files(self.folder / "oxts/data", ".txt"))
        if not paths or self.calibration.lidar_from_imu is None:
            return {}
        records = np.concatenate([read_oxts(paths[number])[:1] for number in sorted(paths)])
        poses = poses_from_oxts(records) @ invert_rigid(self.calibration.lidar_from_imu)
        return dict(zip(sorted(paths), poses, strict=True))


class TrackingDrive(Drive):
    """A sequence of the tracking benchmark: ``PART/{calib,velodyne,image_02,image_03,label_02,oxts}/SEQUENCE``.

    Args:
        part: the folder ``training`` or ``testing``.
        name: of the sequence.
    """

    def __init__(self, part: Path, name: str) -> None:
        super().__init__(
            name, part / "velodyne" / name, {"left": part / "image_02" / name, "right": part / "image_03" / name}
        )
        self.part = part

    @cached_property
    def calibration(self) -> KittiCalibration:
        """From ``calib/SEQUENCE.txt``."""
        return read_calibration(self.part / "calib" / f"{self.name}.txt")

    @cached_property
    def tracked(self) -> dict[int, TrackedObjects]:
        """Labels with track ids by frame number; frames without a line are not in it."""
        return read_tracking_labels(self.part / "label_02" / f"{self.name}.txt")

    def _labelled(self) -> set[int]:
        return set(self.tracked) if self.has_labels else set()

    @property
    def has_labels(self) -> bool:
        """Whether there is a label file."""
        return (self.part / "label_02" / f"{self.name}.txt").is_file()

    def objects(self, number: int) -> KittiObjects:
        """Labels of a frame as the object benchmark writes them."""
        found = self.tracked.get(number)
        return KittiObjects.empty(results=False) if found is None else found.objects

    def labels(self, number: int, class_names: tuple[str, ...]) -> Detections3D:
        """Labelled boxes of a frame in the LiDAR frame."""
        return detections_3d(self.objects(number), self.calibration.camera_from_lidar, class_names)

    @cached_property
    def _poses(self) -> dict[int, FloatArray]:
        """From ``oxts/SEQUENCE.txt``, else from camera poses in ``poses/SEQUENCE.txt`` beside or above the part."""
        oxts = self.part / "oxts" / f"{self.name}.txt"
        if oxts.is_file() and self.calibration.lidar_from_imu is not None:
            poses = poses_from_oxts(read_oxts(oxts)) @ invert_rigid(self.calibration.lidar_from_imu)
            return dict(enumerate(poses))
        return _camera_poses(
            (self.part / "poses" / f"{self.name}.txt", self.part.parent / "poses" / f"{self.name}.txt"),
            self.calibration,
        )


class OdometryDrive(Drive):
    """A sequence of the odometry benchmark: ``ROOT/sequences/NAME/{calib.txt,times.txt,velodyne,image_2,image_3}``.

    Args:
        folder: of the sequence.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder.name, folder / "velodyne", {"left": folder / "image_2", "right": folder / "image_3"})
        self.folder = folder

    @cached_property
    def calibration(self) -> KittiCalibration:
        """From ``calib.txt``."""
        return read_calibration(self.folder / "calib.txt")

    @cached_property
    def _times(self) -> FloatArray | None:
        path = self.folder / "times.txt"
        return read_times(path) if path.is_file() else None

    @cached_property
    def _poses(self) -> dict[int, FloatArray]:
        return _camera_poses((self.folder.parents[1] / "poses" / f"{self.name}.txt",), self.calibration)


def _camera_poses(paths: Iterable[Path], calibration: KittiCalibration) -> dict[int, FloatArray]:
    """``world_from_lidar`` by frame number from the first of the files that exists; it says ``world_from_camera``."""
    for path in paths:
        if path.is_file():
            return dict(enumerate(read_camera_poses(path) @ calibration.camera_from_lidar))
    return {}


def _by_number(paths: Iterable[Path]) -> dict[int, Path]:
    return {int(path.stem): path for path in paths if path.stem.isdigit()}


def _entry(values: FloatArray, number: int) -> float | None:
    known = number < len(values) and np.isfinite(values[number])
    return float(values[number]) if known else None


def raw_drives(root: Path) -> list[Drive]:
    """Raw drives in ``root``: itself, or up to two folders below.

    Raises:
        DatasetError: there is only the form that is neither rectified nor synchronised.
    """
    depths = ("", "*/", "*/*/")
    markers = ("velodyne_points", "image_02/data", "oxts/data")
    folders = sorted({p.parents[m.count("/")] for d in depths for m in markers for p in root.glob(d + m) if p.is_dir()})
    synced = [folder for folder in folders if not folder.name.endswith("_extract")]
    if folders and not synced:
        raise DatasetError(
            f"{folders[0]} is a drive whose images are neither rectified nor synchronised; use its _sync form"
        )
    return [RawDrive(folder) for folder in synced]


def tracking_drives(part: Path) -> list[Drive]:
    """Sequences of the tracking benchmark's folder ``training`` or ``testing``: those with a calibration."""
    return [TrackingDrive(part, path.stem) for path in list_files(part / "calib", ".txt")]


def odometry_drives(root: Path) -> list[Drive]:
    """Sequences of the odometry benchmark."""
    return [OdometryDrive(path.parent) for path in sorted((root / "sequences").glob("*/calib.txt"))]

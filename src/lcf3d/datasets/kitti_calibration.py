"""KITTI's calibration files: one a frame (or sequence), or the three of a recording day of the raw data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import read_text
from lcf3d.structures import FloatArray

RAW_CAMERAS = "calib_cam_to_cam.txt"
RAW_LIDAR = "calib_velo_to_cam.txt"
RAW_IMU = "calib_imu_to_velo.txt"


@dataclass(frozen=True, eq=False)
class KittiCalibration:
    """What a KITTI calibration file says.

    Attributes:
        projections: (3, 4) by name ``P0`` to ``P3``, pixels from the rectified reference camera.
        camera_from_lidar: (4, 4) rectified reference camera from Velodyne, ``R0_rect @ Tr_velo_to_cam``.
        lidar_from_imu: (4, 4) Velodyne from the GPS/IMU unit, or None where the file does not say.
    """

    projections: Mapping[str, FloatArray]
    camera_from_lidar: FloatArray
    lidar_from_imu: FloatArray | None = None


def read_calibration(path: Path) -> KittiCalibration:
    """Read a calibration file; spellings of the object, tracking and odometry benchmarks are understood.

    Raises:
        DatasetError: the file does not exist.
        FormatError: an entry is missing or malformed; names it.
    """
    entries = read_entries(path)
    rectification, reference_from_lidar = np.eye(4), np.eye(4)
    if "Tr" in entries:
        # odometry: from the Velodyne to the rectified reference camera at once
        reference_from_lidar[:3] = matrix_entry(path, entries, ("Tr",), (3, 4))
    else:
        rectification[:3, :3] = matrix_entry(path, entries, ("R0_rect", "R_rect"), (3, 3))
        reference_from_lidar[:3] = matrix_entry(path, entries, ("Tr_velo_to_cam", "Tr_velo_cam"), (3, 4))
    projections: dict[str, FloatArray] = {"P2": matrix_entry(path, entries, ("P2",), (3, 4))}
    others: tuple[str, ...] = ("P0", "P1", "P3")
    for name in others:
        if name in entries:
            projections[name] = matrix_entry(path, entries, (name,), (3, 4))
    for name in ("P2", "P3"):
        if name in projections and not (projections[name][0, 0] > 0 and projections[name][1, 1] > 0):
            raise FormatError(f"{path}: {name} has no focal length; expected the projection of a camera")
    lidar_from_imu = None
    if "Tr_imu_to_velo" in entries or "Tr_imu_velo" in entries:
        lidar_from_imu = np.eye(4)
        lidar_from_imu[:3] = matrix_entry(path, entries, ("Tr_imu_to_velo", "Tr_imu_velo"), (3, 4))
    return KittiCalibration(projections, rectification @ reference_from_lidar, lidar_from_imu)


# lines of raw drives that say when and how it was calibrated
NOT_NUMBERS = ("calib_time", "corner_dist")


def read_entries(path: Path) -> dict[str, FloatArray]:
    """The numbers of a calibration file by the name that begins each line; `NOT_NUMBERS` are passed over.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is malformed; names it.
    """
    try:
        text = read_text(path)
    except DatasetError:
        raise DatasetError(f"calibration file {path} does not exist") from None
    entries: dict[str, FloatArray] = {}
    for number, line in enumerate(text.splitlines(), 1):
        name, *fields = line.replace(":", " ").split() or [""]
        if name in NOT_NUMBERS:
            continue
        try:
            entries[name] = np.array([float(f) for f in fields])
        except ValueError:
            raise FormatError(f"{path}:{number}: {name} must be followed by numbers") from None
        if not np.isfinite(entries[name]).all():
            raise FormatError(f"{path}:{number}: {name} holds NaN or infinite values")
    return entries


def matrix_entry(
    path: Path, entries: Mapping[str, FloatArray], names: Sequence[str], shape: tuple[int, int]
) -> FloatArray:
    """The matrix under the first of ``names`` that the file at ``path`` has.

    Raises:
        FormatError: it has none of them, or of another size.
    """
    for name in names:
        if name in entries:
            if entries[name].size != shape[0] * shape[1]:
                raise FormatError(f"{path}: {name} must hold {shape[0] * shape[1]} numbers, got {entries[name].size}")
            return entries[name].reshape(shape)
    raise FormatError(f"{path} has no entry {' or '.join(names)}")


def read_raw_calibration(folder: Path) -> tuple[KittiCalibration, dict[str, tuple[int, int]]]:
    """The calibration of a recording day, and (width, height) of its rectified images by camera name.

    Args:
        folder: holds ``calib_cam_to_cam.txt``, ``calib_velo_to_cam.txt`` and perhaps ``calib_imu_to_velo.txt``.

    Raises:
        DatasetError: one of the first two does not exist.
        FormatError: an entry is missing or malformed; names it.
    """
    path = folder / RAW_CAMERAS
    entries = read_entries(path)
    rectification = np.eye(4)
    rectification[:3, :3] = matrix_entry(path, entries, ("R_rect_00",), (3, 3))
    projections = {
        f"P{i}": matrix_entry(path, entries, (f"P_rect_0{i}",), (3, 4))
        for i in range(4)
        if i == 2 or f"P_rect_0{i}" in entries
    }
    sizes = {}
    for name, key in (("left", "S_rect_02"), ("right", "S_rect_03")):
        if key in entries:
            width, height = matrix_entry(path, entries, (key,), (1, 2))[0]
            sizes[name] = int(width), int(height)
    lidar_from_imu = _rigid(folder / RAW_IMU) if (folder / RAW_IMU).is_file() else None
    return KittiCalibration(projections, rectification @ _rigid(folder / RAW_LIDAR), lidar_from_imu), sizes


def _rigid(path: Path) -> FloatArray:
    """(4, 4) transform from the entries ``R`` and ``T`` of a raw drive's calibration file."""
    entries = read_entries(path)
    transform = np.eye(4)
    transform[:3, :3] = matrix_entry(path, entries, ("R",), (3, 3))
    transform[:3, 3] = matrix_entry(path, entries, ("T",), (1, 3))[0]
    return transform

"""A KITTI calibration file, and the cameras that it describes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lcf3d.datasets.images import image_size
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.files import read_text, shortened
from lcf3d.structures import Camera, FloatArray

# (camera name, image folder, projection in the calibration file)
CAMERAS = (("left", "image_2", "P2"), ("right", "image_3", "P3"))
# (width, height) of the rectified images of each recording day, known by the focal length that its calibration gave
IMAGE_SIZES = {
    721.5377: (1242, 375),
    707.0493: (1224, 370),
    718.3351: (1238, 374),
    707.0912: (1226, 370),
    718.856: (1241, 376),
}
DEFAULT_IMAGE_SIZE = (1242, 375)
# how far from the middle, as a share of the image, the principal point of an unknown camera may be
NEAR_MIDDLE = 0.1


RAW_CAMERAS = "calib_cam_to_cam.txt"
RAW_LIDAR = "calib_velo_to_cam.txt"
RAW_IMU = "calib_imu_to_velo.txt"

# calibrations that are kept: the files of a drive's frames are alike
KEPT = 256


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

    Files of the same text give the same object.

    Raises:
        DatasetError: the file does not exist.
        FormatError: an entry is missing or malformed; names it.
    """
    text = _text(path)
    if text not in _parsed:
        if len(_parsed) >= KEPT:
            _parsed.clear()
        _parsed[text] = _parse_calibration(path, text)
    return _parsed[text]


_parsed: dict[str, KittiCalibration] = {}


def _parse_calibration(path: Path, text: str) -> KittiCalibration:
    """What the text of the calibration file at ``path`` says."""
    entries = _parse_entries(path, text)
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
    camera_from_lidar = rectification @ reference_from_lidar
    for matrix in (*projections.values(), camera_from_lidar, *(() if lidar_from_imu is None else (lidar_from_imu,))):
        # frames share them
        matrix.setflags(write=False)
    return KittiCalibration(projections, camera_from_lidar, lidar_from_imu)


# lines of raw drives that say when and how it was calibrated
NOT_NUMBERS = ("calib_time", "corner_dist")


def read_entries(path: Path) -> dict[str, FloatArray]:
    """The numbers of a calibration file by the name that begins each line; `NOT_NUMBERS` are passed over.

    Raises:
        DatasetError: the file does not exist.
        FormatError: a line is malformed; names it.
    """
    return _parse_entries(path, _text(path))


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except DatasetError:
        raise DatasetError(f"calibration file {path} does not exist") from None


def _parse_entries(path: Path, text: str) -> dict[str, FloatArray]:
    """See `read_entries`."""
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


def _check_image_size(path: Path, size: tuple[int, int], projection: FloatArray) -> None:
    """Refuse an image that was resized without its calibration: the principal point leaves the middle of the image."""
    for length, centre, name in zip(size, projection[:2, 2], ("width", "height"), strict=True):
        if not 0.25 < centre / length < 0.75:
            raise FormatError(
                f"{path} is {size[0]} x {size[1]} pixels, but its calibration puts the image centre at "
                f"({projection[0, 2]:.0f}, {projection[1, 2]:.0f}): wrong {name}; use the original image"
            )


def _require_default_size(name: str, projection: FloatArray) -> None:
    """Refuse to take a camera without images for one of KITTI's against the evidence of its principal point."""
    shares = projection[:2, 2] / np.array(DEFAULT_IMAGE_SIZE)
    if (np.abs(shares - 0.5) > NEAR_MIDDLE).any():
        x, y = projection[:2, 2]
        raise FormatError(
            f"camera {name} has no image, and its calibration (principal point {x:.0f}, {y:.0f}) is none of a "
            f"{DEFAULT_IMAGE_SIZE[0]} x {DEFAULT_IMAGE_SIZE[1]} image: say the size as "
            "kitti:ROOT?image_size=WIDTHxHEIGHT, or add the images"
        )


def cameras_of(
    calibration: KittiCalibration,
    images: Mapping[str, Path],
    sizes: Mapping[str, tuple[int, int]],
    default_size: tuple[int, int] | None = None,
) -> list[Camera]:
    """The colour cameras that a calibration describes.

    Args:
        calibration: of the frame.
        images: image files by camera name, of which the size is taken.
        sizes: (width, height) by name of cameras without an image; KITTI's own are known.
        default_size: of all others; without it KITTI's usual one, if the principal point is near its middle.

    Raises:
        FormatError: an image that its calibration does not fit, or a camera whose image size nothing tells.
    """
    cameras = []
    for name, _, key in CAMERAS:
        if key not in calibration.projections:
            continue
        matrix = calibration.projections[key]
        if name in images:
            size = image_size(images[name])
            _check_image_size(images[name], size, matrix)
        else:
            known = sizes.get(name) or IMAGE_SIZES.get(round(float(matrix[0, 0]), 4)) or default_size
            if known is None and images:
                # the two cameras of a pair have images of one size
                known = image_size(next(iter(images.values())))
            if known is None:
                _require_default_size(name, matrix)
            size = known or DEFAULT_IMAGE_SIZE
        cameras.append(_camera(calibration, name, key, size))
    return cameras


@lru_cache(maxsize=2 * KEPT)
def _camera(calibration: KittiCalibration, name: str, key: str, size: tuple[int, int]) -> Camera:
    """A camera; the frames of a drive share it, as they share the calibration."""
    return Camera(name, calibration.projections[key], calibration.camera_from_lidar, *size)


def parse_image_size(size: tuple[int, int] | str | None) -> tuple[int, int] | None:
    """(width, height) of ``WIDTHxHEIGHT`` or such a pair.

    Raises:
        ConfigError: it is neither.
    """
    if size is None:
        return None
    parts = size.lower().split("x") if isinstance(size, str) else size
    try:
        width, height = (int(part) for part in parts)
    except (TypeError, ValueError):
        width = height = 0
    if width < 1 or height < 1:
        raise ConfigError(f"image_size must read WIDTHxHEIGHT, in pixels, got {shortened(size)!r}")
    return width, height

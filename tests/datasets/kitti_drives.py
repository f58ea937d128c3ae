"""Small drives in KITTI's raw, tracking and odometry layouts, with the objects of `tests.datasets.kitti_folder`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from lcf3d.formats.kitti import format_objects
from lcf3d.geometry.rotation import invert_rigid
from tests.datasets.kitti_folder import CAMERA_FROM_LIDAR, OBJECTS, P2, P3, SIZE, ground, labels
from tests.fusion.scenes import surface_points

RAW = "2011_09_26_drive_0001_sync"
LIDAR_FROM_IMU = np.array([[1.0, 0, 0, -0.8], [0, 1, 0, 0.3], [0, 0, 1, -0.8], [0, 0, 0, 1]])
STEP_DEGREES = 1e-5
"""Northward from one frame to the next, driving north: about 1.1 m."""


def oxts_line(number: int) -> str:
    heading = np.pi / 2
    return f"{49 + number * STEP_DEGREES:.9f} 8.0 116.0 0 0 {heading!r} " + "0 " * 23 + "0\n"


def _row(name: str, values: object) -> str:
    return f"{name} {' '.join(f'{v:.12e}' for v in np.ravel(np.asarray(values)))}\n"


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def _scan(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.concatenate([surface_points(OBJECTS), ground()])
    path.write_bytes(points.astype("<f4").tobytes())


def _image(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", SIZE, (80, 90, 100)).save(path)


def make_tracking(root: Path, sequences: tuple[str, ...] = ("0000", "0001")) -> Path:
    """Frames 0 to 2; the scan of frame 1 is missing; frame 2 has no label; sequence 0001 has no scans."""
    part = root / "training"
    for name in sequences:
        calibration = "".join(_row(f"P{i}:", P3 if i == 3 else P2) for i in range(4))
        calibration += _row("R_rect", np.eye(3)) + _row("Tr_velo_cam", CAMERA_FROM_LIDAR[:3])
        _write(part / f"calib/{name}.txt", calibration + _row("Tr_imu_velo", LIDAR_FROM_IMU[:3]))
        lines = format_objects(labels()).splitlines()
        _write(
            part / f"label_02/{name}.txt",
            "".join(f"{i} {k} {text}\n" for i in range(2) for k, text in enumerate(lines)),
        )
        _write(part / f"oxts/{name}.txt", "".join(oxts_line(i) for i in range(3)))
        for i in range(3):
            _image(part / f"image_02/{name}/{i:06d}.png")
            if i != 1 and name == "0000":
                _scan(part / f"velodyne/{name}/{i:06d}.bin")
    return root


def make_raw(root: Path) -> Path:
    """One drive of two frames with tracklets of the first car, times and poses."""
    day = root / "2011_09_26"
    cameras = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
    for i in range(4):
        cameras += _row(f"R_rect_0{i}:", np.eye(3)) + _row(f"P_rect_0{i}:", P3 if i == 3 else P2)
        cameras += _row(f"S_rect_0{i}:", SIZE)
    _write(day / "calib_cam_to_cam.txt", cameras)
    velodyne = "calib_time: 15-Mar-2012 11:37:16\n" + _row("R:", CAMERA_FROM_LIDAR[:3, :3])
    _write(day / "calib_velo_to_cam.txt", velodyne + _row("T:", CAMERA_FROM_LIDAR[:3, 3]) + "delta_f: 0 0\n")
    imu = "calib_time: 25-May-2012 16:47:16\n" + _row("R:", LIDAR_FROM_IMU[:3, :3]) + _row("T:", LIDAR_FROM_IMU[:3, 3])
    _write(day / "calib_imu_to_velo.txt", imu)
    drive = day / RAW
    for i in range(2):
        _scan(drive / f"velodyne_points/data/{i:010d}.bin")
        _image(drive / f"image_02/data/{i:010d}.png")
        _write(drive / f"oxts/data/{i:010d}.txt", oxts_line(i))
    _write(drive / "velodyne_points/timestamps.txt", "1970-01-01 00:00:10.25\n1970-01-01 00:00:10.353\n")
    x, y, z, length, width, height, yaw = OBJECTS[0]
    pose = f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z - height / 2}</tz><rx>0</rx><ry>0</ry><rz>{yaw}</rz></item>"
    item = f"<item><objectType>Car</objectType><h>{height}</h><w>{width}</w><l>{length}</l>"
    item += f"<first_frame>0</first_frame><poses><count>1</count>{pose}</poses></item>"
    _write(drive / "tracklet_labels.xml", f"<archive><tracklets><count>1</count>{item}</tracklets></archive>")
    return root


def make_odometry(root: Path) -> Path:
    """One sequence of two frames; the camera moves 1 m ahead between them."""
    folder = root / "sequences/00"
    calibration = "".join(_row(f"P{i}:", P3 if i == 3 else P2) for i in range(4))
    _write(folder / "calib.txt", calibration + _row("Tr:", CAMERA_FROM_LIDAR[:3]))
    _write(folder / "times.txt", "0.0\n1.037e-01\n")
    _write(root / "poses/00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1\n")
    for i in range(2):
        _scan(folder / f"velodyne/{i:06d}.bin")
        _image(folder / f"image_2/{i:06d}.png")
    return root


def moved_lidar(number: int, metres: float) -> np.ndarray:
    """``world_from_lidar`` after ``number`` steps of ``metres`` north, the vehicle heading north."""
    world_from_imu = np.array([[0.0, -1, 0, 0], [1, 0, 0, number * metres], [0, 0, 1, 0], [0, 0, 0, 1]])
    return world_from_imu @ invert_rigid(LIDAR_FROM_IMU)

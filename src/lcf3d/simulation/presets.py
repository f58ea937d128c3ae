"""Named sensor sets and weather: what is mounted on the car and what it drives through."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.simulation.worlds import PLAIN, RICH, Mounting, World
from lcf3d.structures import Camera

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LidarSpec:
    """A spinning LiDAR.

    Attributes:
        elevations_deg: elevation of every beam, lowest ring number first.
        steps: firings of each beam a turn.
        rate_hz: turns a second.
        max_range_m: nothing is measured beyond.
        min_range_m: nothing is measured nearer.
        noise_m: standard deviation of the range.
        height_m: above the ground.
        sensitivity: a beam returns with chance ``1 - exp(-4 sensitivity * reflected share / range^2)``.
        base_loss: share of beams lost for no visible reason.
        uneven_beams: intensities with the zeros, low values and gains by beam of a real scanner.
    """

    elevations_deg: tuple[float, ...]
    steps: int
    rate_hz: float
    max_range_m: float
    min_range_m: float
    noise_m: float
    height_m: float
    sensitivity: float
    base_loss: float
    uneven_beams: bool = False


@dataclass(frozen=True, eq=False)
class Preset:
    """A sensor set, its dataset layout and the weather.

    Attributes:
        name: what ``--preset`` takes.
        layout: ``kitti`` or ``nuscenes``.
        lidar: the LiDAR.
        cameras: the cameras, in the LiDAR frame (x forward, y left, z up).
        rain: 0 dry to 1 heavy: lost beams, droplets, wet road, haze.
        night: images by headlamps and street lamps.
        rate_hz: frames a second of a sequence.
        description: one line for the help.
        world: what the streets hold beyond the ordinary.
        camera_delays_s: when each camera fires, in seconds after the middle of the LiDAR's turn; empty for all at once.
        sweeps: scans before every key frame but a drive's first that are written with it (nuScenes layout).
    """

    name: str
    layout: str
    lidar: LidarSpec
    cameras: tuple[Camera, ...]
    rain: float
    night: bool
    rate_hz: float
    description: str
    world: World = PLAIN
    camera_delays_s: tuple[float, ...] = ()
    sweeps: int = 0

    def delay(self, number: int) -> float:
        """Seconds after the middle of the LiDAR's turn at which a camera fires."""
        return self.camera_delays_s[number] if self.camera_delays_s else 0.0

    def resized(self, factor: float, steps: int | None = None) -> Preset:
        """The same preset with images scaled by ``factor`` and fewer LiDAR firings, for tests and previews."""
        if not 0 < factor <= 1:
            raise ConfigError(f"the image scale must lie above 0 and at most 1, got {factor:g}")
        scale = np.diag([factor, factor, 1.0])
        cameras = tuple(
            replace(
                c,
                projection=scale @ c.projection,
                width=max(8, round(c.width * factor)),
                height=max(8, round(c.height * factor)),
            )
            for c in self.cameras
        )
        return replace(self, cameras=cameras, lidar=replace(self.lidar, steps=steps or self.lidar.steps))


HDL64: Final = LidarSpec(
    tuple(np.round(np.concatenate([np.linspace(-23.7, -8.4, 32), np.linspace(-7.9, 2.5, 32)]), 3).tolist()),
    2083,
    10.0,
    80.0,
    1.5,
    0.02,
    1.73,
    6000.0,
    0.015,
)
"""A 64-beam scanner; beam elevations measured as the medians over 32 scans of KITTI (0.335 and 0.494 degrees apart)."""
HDL32: Final = LidarSpec(
    tuple(np.round(np.linspace(-30.67, 10.67, 32), 3).tolist()), 1084, 20.0, 100.0, 1.0, 0.02, 1.84, 6000.0, 0.02
)
"""A 32-beam scanner with the published elevations of nuScenes' sensor."""
VLP16: Final = LidarSpec(tuple(np.linspace(-15.0, 15.0, 16).tolist()), 1800, 10.0, 100.0, 0.5, 0.03, 1.73, 6000.0, 0.02)
"""A 16-beam scanner, two degrees between beams."""

KITTI_FOCAL: Final = 721.5377
KITTI_CENTRE: Final = (609.5593, 172.854)
KITTI_SIZE: Final = (1242, 375)
KITTI_OFFSETS: Final = (0.0, -387.5744, 44.85728, -339.5242)
"""Fourth column of P0 to P3: minus focal length times baseline, relative to camera 0."""


@lru_cache(maxsize=1)
def kitti_calibration() -> dict[str, Matrix]:
    """P0 to P3 (3, 4), R0_rect (3, 3), Tr_velo_to_cam (3, 4), Tr_imu_to_velo (3, 4).

    Focal length, image centre and baseline are KITTI's. The rotations are ours: R0_rect is a small rotation,
    and together with Tr_velo_to_cam it turns the LiDAR's axes exactly (but for a small yaw): a box upright for one is
    upright for the other.
    """
    result: dict[str, Matrix] = {}
    for number, offset in enumerate(KITTI_OFFSETS):
        p = np.array([[KITTI_FOCAL, 0, KITTI_CENTRE[0], offset], [0, KITTI_FOCAL, KITTI_CENTRE[1], 0], [0, 0, 1, 0.0]])
        result[f"P{number}"] = p
    rectify = _rotation((0.0043, -0.0075, -0.0098))
    yaw = 0.0072
    axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]]) @ np.array(
        [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    )
    rotation = rectify.T @ axes
    translation = rectify.T @ np.array([-0.004, -0.076, -0.272])
    result["R0_rect"] = rectify
    result["Tr_velo_to_cam"] = np.concatenate([rotation, translation[:, None]], axis=1)
    result["Tr_imu_to_velo"] = np.concatenate(
        [_rotation((0.0148, 0.002, -0.0008)), np.array([[-0.81], [0.32], [-0.80]])], axis=1
    )
    return result


def _rotation(angles: tuple[float, float, float]) -> Matrix:
    """Rotation by angles about x, then y, then z."""
    result = np.eye(3)
    for axis, angle in enumerate(angles):
        c, s = np.cos(angle), np.sin(angle)
        one = np.eye(3)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        one[i, i] = one[j, j] = c
        one[i, j], one[j, i] = -s, s
        result = one @ result
    return result


def _kitti_cameras() -> tuple[Camera, ...]:
    calibration = kitti_calibration()
    to_camera = np.eye(4)
    to_camera[:3] = calibration["R0_rect"] @ calibration["Tr_velo_to_cam"]
    return (
        Camera("left", calibration["P2"], to_camera, *KITTI_SIZE),
        Camera("right", calibration["P3"], to_camera, *KITTI_SIZE),
    )


NUSCENES_LIDAR: Final = ((0.943713, 0.0, 1.84023), -1.5687)
"""Position of LIDAR_TOP on the car, and its yaw: the raw frame has x to the right and y ahead, as the real one."""
NUSCENES_CAMERAS: Final = (
    ("CAM_FRONT", (1.722, 0.005, 1.495), 0.0, (1252.8, 826.6, 470.0)),
    ("CAM_FRONT_RIGHT", (1.581, -0.499, 1.517), -56.4, (1256.7, 817.8, 452.0)),
    ("CAM_BACK_RIGHT", (1.059, -0.467, 1.551), -112.6, (1250.0, 825.4, 462.5)),
    ("CAM_BACK", (0.055, 0.011, 1.568), 180.0, (796.9, 857.8, 476.9)),
    ("CAM_BACK_LEFT", (1.049, 0.483, 1.562), 108.6, (1255.0, 829.6, 467.2)),
    ("CAM_FRONT_LEFT", (1.575, 0.501, 1.507), 55.0, (1257.9, 827.2, 450.9)),
)
"""Name, position on the car, yaw in degrees, and (focal length, cx, cy) of nuScenes' six cameras, rounded."""


def ego_from_nuscenes_camera(position: tuple[float, float, float], yaw_deg: float) -> Matrix:
    """(4, 4) car coordinates from camera coordinates (x right, y down, z forward) of a level camera."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    result = np.eye(4)
    result[:3, :3] = np.array([[s, 0, c], [-c, 0, s], [0, -1, 0.0]])
    result[:3, 3] = position
    return result


def ego_from_nuscenes_lidar() -> Matrix:
    """(4, 4) car coordinates from the raw frame of LIDAR_TOP (x right, y ahead, z up)."""
    position, yaw = NUSCENES_LIDAR
    result = np.eye(4)
    result[:3, :3] = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    result[:3, 3] = position
    return result


def nuscenes_lidar_from_forward() -> Matrix:
    """(4, 4) raw frame of LIDAR_TOP from our LiDAR frame (x forward, y left): a quarter turn."""
    result = np.eye(4)
    result[:2, :2] = [[0, -1], [1, 0]]
    return result


def _nuscenes_cameras() -> tuple[Camera, ...]:
    ego_from_lidar = ego_from_nuscenes_lidar() @ nuscenes_lidar_from_forward()
    cameras = []
    for name, position, yaw, (focal, cx, cy) in NUSCENES_CAMERAS:
        projection = np.array([[focal, 0, cx, 0], [0, focal, cy, 0], [0, 0, 1, 0.0]])
        to_camera = np.linalg.inv(ego_from_nuscenes_camera(position, yaw)) @ ego_from_lidar
        cameras.append(Camera(name, projection, to_camera, 1600, 900))
    return tuple(cameras)


def _to_train_on(preset: Preset, name: str, description: str, world: World = RICH) -> Preset:
    lidar = replace(preset.lidar, uneven_beams=True)
    return replace(preset, name=name, lidar=lidar, world=world, description=description)


@lru_cache(maxsize=1)
def all_presets() -> dict[str, Preset]:
    """All presets by name."""
    kitti = Preset(
        "kitti64",
        "kitti",
        HDL64,
        _kitti_cameras(),
        0.0,
        False,
        10.0,
        "64-beam LiDAR and rectified stereo pair, KITTI layout",
    )
    nuscenes = Preset(
        "nuscenes32",
        "nuscenes",
        HDL32,
        _nuscenes_cameras(),
        0.0,
        False,
        2.0,
        "32-beam LiDAR and six cameras, nuScenes layout",
    )
    every = (
        kitti,
        nuscenes,
        replace(
            kitti,
            name="mono64",
            cameras=kitti.cameras[:1],
            description="kitti64 with the left camera only: quicker, for large sets",
        ),
        replace(kitti, name="sparse16", lidar=VLP16, description="kitti64 with a 16-beam LiDAR"),
        replace(kitti, name="rain", rain=0.7, description="kitti64 in rain: lost beams, droplets, wet road, haze"),
        _to_train_on(
            kitti, "train_kitti", "kitti64 to train on: many people and riders, hidden objects, uneven ground"
        ),
        _to_train_on(
            replace(kitti, cameras=kitti.cameras[:1]), "train_mono", "train_kitti with the left camera only: quicker"
        ),
        replace(
            nuscenes,
            name="nuscenes_sweeps",
            camera_delays_s=tuple(-yaw / 360 / HDL32.rate_hz for _, _, yaw, _ in NUSCENES_CAMERAS),
            sweeps=9,
            description="nuscenes32 with nine sweeps before a key frame, cameras that fire as the LiDAR passes them",
        ),
        _to_train_on(
            nuscenes,
            "train_nuscenes",
            "nuscenes32 to train on: many people and riders, uneven ground",
            replace(RICH, mounting=Mounting((0.0, 0.03), (0.0, 0.006), (0.0, 0.008))),
        ),
        replace(kitti, name="night", night=True, description="kitti64 at night: head and street lamps"),
    )
    return {preset.name: preset for preset in every}


def get_preset(name: str) -> Preset:
    """The preset of that name.

    Raises:
        ConfigError: there is none.
    """
    table = all_presets()
    if name not in table:
        raise ConfigError(f"unknown preset {name!r}; use one of {', '.join(table)}")
    return table[name]

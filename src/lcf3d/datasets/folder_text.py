"""What was understood of a plain folder, in words."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from lcf3d.datasets.folder_results import FolderLabels
from lcf3d.datasets.folder_sensors import Sensors
from lcf3d.frame import Frame
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import Camera, FloatArray


class FolderContent(Protocol):
    """What is told of a plain folder."""

    ids: tuple[str, ...]
    sensors: Sensors

    @property
    def times(self) -> dict[str, float]:
        """Seconds by frame."""
        ...

    @property
    def poses(self) -> dict[str, FloatArray]:
        """``world_from_lidar`` by frame."""
        ...

    @property
    def labels_from(self) -> FolderLabels | None:
        """Where the labels come from."""
        ...

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras."""
        ...

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id."""
        ...


def describe_folder(dataset: FolderContent) -> list[str]:
    """Sentences about frames, sensors, their places, times, poses and labels."""
    first = dataset.frame(dataset.ids[0])
    lines = [
        f"{len(dataset.ids)} frames, {dataset.ids[0]} to {dataset.ids[-1]}, files matched by {dataset.sensors.match}"
    ]
    for name, setup in dataset.sensors.lidars.items():
        lines.append(f"LiDAR {name}: {setup.scans}, {setup.axes}{_place(dataset.sensors.lidar_from_own(name))}")
    points = first.points
    if points is not None and len(points):
        low, high = (np.percentile(points[:, :3], q, axis=0) for q in (1, 99))
        spans = ", ".join(f"{w} {a:.0f} to {b:.0f} m" for w, a, b in zip(("x", "y", "z"), low, high, strict=True))
        lines.append(f"  first scan: {len(points):,} points, {spans} forward, left and up of the first LiDAR")
    for camera in dataset.cameras:
        lens = "pinhole" if camera.distortion is None else camera.distortion.model
        images = "with" if camera.name in first.images else "without"
        lines.append(
            f"camera {camera.name}: {camera.width} x {camera.height}, {lens}, looks {_direction(camera)}"
            f"{_place(invert_rigid(camera.camera_from_lidar))}; first frame {images} its image"
        )
    if dataset.times:
        times = np.sort(np.fromiter(dataset.times.values(), dtype=np.float64))
        every = f", one every {np.median(np.diff(times)):.3f} s" if len(times) > 1 else ""
        lines.append(f"times of {len(times)} frames{every}")
    if dataset.poses:
        lines.append(f"poses of {len(dataset.poses)} frames")
    if dataset.labels_from is not None:
        counts = dataset.labels_from.class_counts(dataset.ids)
        names = ", ".join(f"{n} {name}" for name, n in sorted(counts.items(), key=lambda item: -item[1]))
        lines.append(f"labels: {dataset.labels_from.form}: {names or 'no objects'}")
    return lines


def _place(lidar_from_sensor: FloatArray) -> str:
    """Where a sensor is, empty at the LiDAR's own place."""
    x, y, z = lidar_from_sensor[:3, 3]
    if np.hypot(np.hypot(x, y), z) < 1e-9:
        return ""
    parts = ((x, "in front", "behind"), (y, "left", "right"), (z, "above", "below"))
    words = [f"{abs(v):.2f} m {a if v > 0 else b}" for v, a, b in parts if abs(v) >= 0.005]
    return f", {', '.join(words)} of the LiDAR" if words else ""


def _direction(camera: Camera) -> str:
    """Where the optical axis points and whether the image stands upright."""
    axis, up = camera.camera_from_lidar[2, :3], -camera.camera_from_lidar[1, 2]
    angle = np.degrees(np.arctan2(axis[1], axis[0]))
    names = ("forward", "forward left", "left", "back left", "back", "back right", "right", "forward right")
    flat = names[round(angle / 45) % 8] if np.hypot(axis[0], axis[1]) > 0.5 else "up" if axis[2] > 0 else "down"
    return f"{flat} ({angle:+.0f} degrees)" + ("" if up > 0.5 else ", its image on its side or head")

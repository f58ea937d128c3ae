"""Frames of any dataset written as a plain folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np

from lcf3d.datasets.folder_sensors import FILE, CameraSetup, Lens, LidarSetup, Sensors
from lcf3d.errors import ConfigError
from lcf3d.files import atomic_path, write_text
from lcf3d.formats.plain import write_detections_3d
from lcf3d.frame import Frame
from lcf3d.geometry.rotation import quaternions_from_matrices
from lcf3d.structures import Camera, FloatArray


def write_folder(
    frames: Iterable[Frame], root: str | Path, image_format: Literal["png", "jpg", "webp"] = "png"
) -> list[str]:
    """Write scans (``.bin``), images, labels, times, poses and ``sensors.yaml``.

    Args:
        frames: of one calibration; names of files are their ids.
        root: folder to write to.
        image_format: of the images; ``png`` keeps every pixel.

    Returns:
        Ids of the frames.

    Raises:
        ConfigError: the calibration changes from frame to frame, or a projection is no camera matrix with a pose.
    """
    root = Path(root).expanduser()
    ids: list[str] = []
    cameras: dict[str, Camera] = {}
    times: list[str] = []
    poses: list[str] = []
    classes: tuple[str, ...] = ()
    has = {"lidar": False, "labels": False}
    for frame in frames:
        ids.append(frame.id)
        for camera in frame.cameras:
            if not _equal(cameras.setdefault(camera.name, camera), camera):
                raise ConfigError(f"frame {frame.id}: the calibration of camera {camera.name} differs from the first's")
            if camera.name in frame.images:
                _write_image(root / "images" / camera.name / f"{frame.id}.{image_format}", frame.images[camera.name])
        points, labels = frame.points, frame.labels
        if points is not None:
            has["lidar"] = True
            with atomic_path(root / "scans" / f"{frame.id}.bin") as temporary:
                temporary.write_bytes(np.ascontiguousarray(points[:, :4], dtype="<f4").tobytes())
        if labels is not None:
            has["labels"], classes = True, labels.class_names
            write_detections_3d(root / "labels" / f"{frame.id}.json", labels)
        if frame.timestamp is not None:
            times.append(f"{frame.id},{frame.timestamp:.9f}\n")
        if frame.world_from_lidar is not None:
            x, y, z = frame.world_from_lidar[:3, 3]
            quaternion = quaternions_from_matrices(frame.world_from_lidar[None, :3, :3])[0]
            poses.append(",".join([frame.id, *(f"{v:.9f}" for v in (x, y, z, *quaternion))]) + "\n")
    if times:
        write_text(root / "timestamps.csv", "frame,timestamp\n" + "".join(times))
    if poses:
        write_text(root / "poses.csv", "frame,x,y,z,qw,qx,qy,qz\n" + "".join(poses))
    sensors = Sensors(
        lidars={"lidar": LidarSetup(scans="scans")} if has["lidar"] else {},
        cameras={name: _setup(camera) for name, camera in cameras.items() if (root / "images" / name).is_dir()},
        classes=list(classes) or list(Sensors.model_fields["classes"].default),
        labels="labels" if has["labels"] else None,
        timestamps="timestamps.csv" if times else None,
        poses="poses.csv" if poses else None,
    )
    sensors.dump(root / FILE)
    return ids


def pose_without_offset(camera: Camera) -> FloatArray:
    """(4, 4) ``camera_from_lidar`` with which ``[K | 0]`` projects as the camera does.

    A stereo baseline in the last column of the projection goes into the pose.
    """
    pose = np.array(camera.camera_from_lidar)
    pose[:3, 3] += np.linalg.solve(camera.intrinsics, camera.projection[:, 3])
    return pose


def _setup(camera: Camera) -> CameraSetup:
    pose = pose_without_offset(camera)
    lens = camera.distortion
    return CameraSetup.model_validate(
        {
            "images": f"images/{camera.name}",
            "intrinsics": (camera.intrinsics / camera.intrinsics[2, 2]).tolist(),
            "size": (camera.width, camera.height),
            "distortion": None if lens is None else Lens(model=lens.model, coefficients=list(lens.coefficients)),
            "camera_from_lidar": pose.tolist(),
        }
    )


def _equal(a: Camera, b: Camera) -> bool:
    same = np.array_equal(a.projection, b.projection) and np.array_equal(a.camera_from_lidar, b.camera_from_lidar)
    return same and (a.width, a.height, a.distortion) == (b.width, b.height, b.distortion)


def _write_image(path: Path, image: np.ndarray) -> None:  # type: ignore[type-arg]
    from PIL import Image

    forms = {".png": {"format": "PNG", "compress_level": 1}, ".jpg": {"format": "JPEG", "quality": 95}}
    options = forms.get(path.suffix, {"format": "WEBP", "quality": 90})
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, **options)  # type: ignore[arg-type]

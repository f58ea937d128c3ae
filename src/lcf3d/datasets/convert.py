"""Frames of any dataset written in the KITTI object layout or as nuScenes tables, for cross-dataset evaluation.

Domain shift experiments (paper section 5.8) read one dataset with tools made for the other. Both writers take `Frame`
objects, so they also serve sensors of one's own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.nuscenes import RAW_FROM_CANONICAL
from lcf3d.datasets.nuscenes_tables import CAMERAS, DETECTION_CLASS_OF_CATEGORY, LIDAR
from lcf3d.errors import ConfigError
from lcf3d.files import atomic_path, write_json, write_text
from lcf3d.formats.kitti import KittiObjects, objects_from_detections, write_objects
from lcf3d.formats.nuscenes_boxes import NUSCENES_ATTRIBUTES, global_from_detections
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes, require_pinhole
from lcf3d.geometry.iou import image_area
from lcf3d.geometry.rotation import invert_rigid, quaternions_from_matrices
from lcf3d.structures import NUSCENES_CLASSES, Camera, Detections3D, FloatArray

KITTI_NAMES = ("Car", "Truck", "Pedestrian", "Cyclist")
"""Classes that `kitti_labels` gives."""

_KITTI_NAME = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian"}
_NUSCENES_NAME = {"Car": "car", "Van": "car", "Truck": "truck", "Pedestrian": "pedestrian", "Cyclist": "bicycle"}
_INTENSITY_SCALE = 255.0
_START_US = 1_600_000_000_000_000
_PADDING = 10


def kitti_labels(labels: Detections3D) -> Detections3D:
    """nuScenes labels in KITTI's classes: bicycles and motorcycles with a rider are Cyclist.

    Those without a rider and classes that KITTI does not have are left out. Labels in KITTI's classes pass as they are.
    """
    names = np.array(labels.class_names)[labels.labels] if len(labels) else np.zeros(0, dtype=np.str_)
    ridden = np.zeros(len(labels), dtype=bool)
    if labels.attributes is not None:
        ridden = np.isin(names, ("bicycle", "motorcycle")) & (labels.attributes == "cycle.with_rider")
    translated = [
        "Cyclist" if rider else _KITTI_NAME.get(str(name), str(name)) for name, rider in zip(names, ridden, strict=True)
    ]
    kept = np.array([name in KITTI_NAMES for name in translated], dtype=bool)
    indices = np.array([KITTI_NAMES.index(name) for name in translated if name in KITTI_NAMES], dtype=np.int64)
    return replace(labels[kept], labels=indices, class_names=KITTI_NAMES)


def nuscenes_labels(labels: Detections3D) -> Detections3D:
    """KITTI labels in the nuScenes classes: Cyclist is a bicycle with a rider, Van a car.

    Classes that nuScenes does not have are left out. Labels in the nuScenes classes pass as they are.
    """
    riders = np.array([name == "Cyclist" for name in labels.class_names], dtype=bool)[labels.labels]
    attributes = np.full(len(labels), "") if labels.attributes is None else labels.attributes
    marked = replace(labels, attributes=np.where(riders, "cycle.with_rider", attributes))
    return marked.with_classes(NUSCENES_CLASSES, _NUSCENES_NAME)


def write_kitti(
    frames: Iterable[Frame],
    root: str | Path,
    camera: str,
    split: str = "val",
    intensity_scale: float = 1 / _INTENSITY_SCALE,
) -> dict[str, str]:
    """Write frames in the KITTI object layout, with one camera as the left colour camera.

    Scans, images and labels are written where a frame has them: points as ``x, y, z, intensity``, images as PNG,
    labels of the boxes that the camera sees, in KITTI's classes (`kitti_labels`). Occlusion is not known and written as
    0, so that KITTI's difficulty follows from height and truncation alone.

    Args:
        frames: what to write; ids become running numbers of six digits.
        root: folder to write to.
        camera: name of the camera to keep.
        split: name of the list in ``ImageSets``.
        intensity_scale: factor on intensities; KITTI's go to 1, those of nuScenes to 255.

    Returns:
        Frame id by KITTI id, also written to ``frames.txt``.

    Raises:
        ConfigError: a frame lacks the camera.
    """
    ids: dict[str, str] = {}
    root = Path(root).expanduser()
    folder = root / "training"
    for number, frame in enumerate(frames):
        name = f"{number:06d}"
        ids[name] = frame.id
        view = frame.camera(camera)
        write_text(folder / "calib" / f"{name}.txt", _calibration_text(view))
        points = frame.points
        if points is not None:
            scaled = points[:, :4] * np.array([1, 1, 1, intensity_scale], dtype=np.float32)
            _write_bytes(folder / "velodyne" / f"{name}.bin", scaled.astype("<f4").tobytes())
        if camera in frame.images:
            _write_png(folder / "image_2" / f"{name}.png", frame.images[camera])
        if frame.labels is not None:
            write_objects(folder / "label_2" / f"{name}.txt", _label_objects(kitti_labels(frame.labels), view))
    write_text(root / "ImageSets" / f"{split}.txt", "".join(f"{name}\n" for name in ids))
    write_text(root / "frames.txt", "".join(f"{name} {token}\n" for name, token in ids.items()))
    return ids


def write_nuscenes(
    frames: Iterable[Frame],
    root: str | Path,
    cameras: Mapping[str, str],
    version: str = "v1.0-converted",
    intensity_scale: float = _INTENSITY_SCALE,
) -> dict[str, str]:
    """Write frames as nuScenes tables and sensor files, each frame a scene of one sample.

    The global frame of each sample is its canonical LiDAR frame. Scans are written in the raw LIDAR_TOP axes with ring
    0, images as PNG, labels in the nuScenes classes (`nuscenes_labels`) with their point counts (1 without a scan);
    velocities do not survive, since no sample has neighbours.

    Args:
        frames: what to write.
        root: folder to write to.
        cameras: nuScenes channel by camera name, for example ``{"left": "CAM_FRONT"}``; other cameras are left out.
        version: name of the folder of tables.
        intensity_scale: factor on intensities.

    Returns:
        Frame id by sample token, also written to ``frames.txt``.

    Raises:
        ConfigError: a channel that nuScenes does not have, or two frames of one id.
    """
    root = Path(root).expanduser()
    unknown = [channel for channel in cameras.values() if channel not in CAMERAS]
    if unknown:
        raise ConfigError(f"nuScenes has no camera {unknown[0]!r}; its cameras are {', '.join(CAMERAS)}")
    tables = _empty_tables(tuple(cameras.values()))
    ids: dict[str, str] = {}
    for number, frame in enumerate(frames):
        token = _token("sample", frame.id)
        if token in ids:
            raise ConfigError(f"two frames have the id {frame.id!r}; ids must differ")
        ids[token] = frame.id
        _append_sample(tables, root, frame, token, _START_US + number * 1_000_000, cameras, intensity_scale)
    for name, records in tables.items():
        write_json(root / version / f"{name}.json", records, indent=0)
    write_text(root / "frames.txt", "".join(f"{token} {id}\n" for token, id in ids.items()))
    return ids


def _label_objects(labels: Detections3D, camera: Camera) -> KittiObjects:
    """KITTI labels of the boxes that the camera sees."""
    boxes2d, visible = project_boxes(labels.boxes, camera)
    labels, boxes2d = labels[visible], boxes2d[visible]
    objects = objects_from_detections(labels, boxes2d, camera.camera_from_lidar)
    # an image many times as large shows what lies outside
    width, height = camera.width, camera.height
    shift = np.eye(3)
    shift[:2, 2] = _PADDING * width, _PADDING * height
    scale = 2 * _PADDING + 1
    wide = Camera(camera.name, shift @ camera.projection, camera.camera_from_lidar, scale * width, scale * height)
    whole = image_area(project_boxes(labels.boxes, wide)[0])
    truncated = np.clip(1 - image_area(boxes2d) / np.maximum(whole, 1e-9), 0, 1)
    return replace(objects, truncated=truncated, occluded=np.zeros(len(labels), dtype=np.int64), scores=None)


def _calibration_text(camera: Camera) -> str:
    """A KITTI calibration file in which all four cameras are this one."""
    require_pinhole(camera, "the KITTI layout")
    entries: dict[str, NDArray[Any]] = {f"P{i}": camera.projection for i in range(4)}
    entries["R0_rect"] = np.eye(3)
    entries["Tr_velo_to_cam"] = camera.camera_from_lidar[:3]
    entries["Tr_imu_to_velo"] = np.eye(4)[:3]
    return "".join(f"{name}: {' '.join(f'{v:.12e}' for v in matrix.ravel())}\n" for name, matrix in entries.items())


def _empty_tables(channels: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    tables: dict[str, list[dict[str, Any]]] = {
        name: []
        for name in (
            *("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "instance", "sample_annotation"),
            *("sensor", "category", "attribute", "log", "map", "visibility"),
        )
    }
    for channel in (LIDAR, *channels):
        modality = "lidar" if channel == LIDAR else "camera"
        tables["sensor"].append({"token": _token("sensor", channel), "channel": channel, "modality": modality})
    for category in DETECTION_CLASS_OF_CATEGORY:
        tables["category"].append({"token": _token("category", category), "name": category, "description": ""})
    for attribute in NUSCENES_ATTRIBUTES:
        tables["attribute"].append({"token": _token("attribute", attribute), "name": attribute, "description": ""})
    tables["log"].append(
        {"token": _token("log"), "logfile": "", "vehicle": "", "date_captured": "", "location": "converted"}
    )
    return tables


def _append_sample(
    tables: dict[str, list[dict[str, Any]]],
    root: Path,
    frame: Frame,
    token: str,
    timestamp_us: int,
    cameras: Mapping[str, str],
    intensity_scale: float,
) -> None:
    """Add one frame to the tables and write its sensor files."""
    _append_scene(tables, frame.id, token, timestamp_us)
    scan = f"samples/{LIDAR}/{frame.id}.pcd.bin"
    _append_recording(tables, frame.id, token, timestamp_us, LIDAR, invert_rigid(RAW_FROM_CANONICAL), scan)
    points = frame.points
    if points is not None:
        raw = np.stack([-points[:, 1], points[:, 0], points[:, 2], points[:, 3] * intensity_scale], axis=1)
        _write_bytes(root / scan, np.column_stack([raw, np.zeros(len(raw))]).astype("<f4").tobytes())
    for camera in frame.cameras:
        if camera.name not in cameras:
            continue
        channel = cameras[camera.name]
        image = f"samples/{channel}/{frame.id}.png"
        ego_from_camera = invert_rigid(_without_offset(camera))
        _append_recording(tables, frame.id, token, timestamp_us, channel, ego_from_camera, image, camera)
        if camera.name in frame.images:
            _write_png(root / image, frame.images[camera.name])
    if frame.labels is not None:
        _append_annotations(tables, frame.id, token, nuscenes_labels(frame.labels), points)


def _append_scene(tables: dict[str, list[dict[str, Any]]], id: str, token: str, timestamp_us: int) -> None:
    """Add a scene of one sample, and the vehicle's pose: its frame is the global one."""
    scene = _token("scene", id)
    tables["scene"].append(
        {
            "token": scene,
            "log_token": _token("log"),
            "nbr_samples": 1,
            "first_sample_token": token,
            "last_sample_token": token,
            "name": f"scene-{id}",
            "description": "",
        }
    )
    tables["sample"].append({"token": token, "timestamp": timestamp_us, "prev": "", "next": "", "scene_token": scene})
    tables["ego_pose"].append(
        {
            "token": _token("ego_pose", id),
            "timestamp": timestamp_us,
            "rotation": [1.0, 0.0, 0.0, 0.0],
            "translation": [0.0, 0.0, 0.0],
        }
    )


def _append_recording(
    tables: dict[str, list[dict[str, Any]]],
    id: str,
    token: str,
    timestamp_us: int,
    channel: str,
    ego_from_sensor: FloatArray,
    filename: str,
    camera: Camera | None = None,
) -> None:
    """Add one sensor's calibration and key frame."""
    calibration = _token("calibrated_sensor", id, channel)
    tables["calibrated_sensor"].append(
        {
            "token": calibration,
            "sensor_token": _token("sensor", channel),
            "translation": ego_from_sensor[:3, 3].tolist(),
            "rotation": quaternions_from_matrices(ego_from_sensor[None, :3, :3])[0].tolist(),
            "camera_intrinsic": [] if camera is None else camera.intrinsics.tolist(),
        }
    )
    tables["sample_data"].append(
        {
            "token": _token("sample_data", id, channel),
            "sample_token": token,
            "ego_pose_token": _token("ego_pose", id),
            "calibrated_sensor_token": calibration,
            "timestamp": timestamp_us,
            "fileformat": filename.rsplit(".", 1)[-1],
            "is_key_frame": True,
            "width": 0 if camera is None else camera.width,
            "height": 0 if camera is None else camera.height,
            "filename": filename,
            "prev": "",
            "next": "",
        }
    )


def _append_annotations(
    tables: dict[str, list[dict[str, Any]]],
    id: str,
    token: str,
    labels: Detections3D,
    points: NDArray[np.float32] | None,
) -> None:
    """Add a frame's labels, each an object of its own."""
    category_of = {name: category for category, name in reversed(DETECTION_CLASS_OF_CATEGORY.items())}
    boxes = global_from_detections({token: labels}, {token: np.eye(4)})
    counts = (
        np.ones(len(labels), dtype=np.int64) if points is None else points_in_boxes(points, labels.boxes).sum(axis=1)
    )
    given = labels.attributes if labels.attributes is not None else [""] * len(labels)
    for i in range(len(boxes)):
        instance, annotation = _token("instance", id, i), _token("sample_annotation", id, i)
        category = category_of[labels.class_names[labels.labels[i]]]
        tables["instance"].append(
            {
                "token": instance,
                "category_token": _token("category", category),
                "nbr_annotations": 1,
                "first_annotation_token": annotation,
                "last_annotation_token": annotation,
            }
        )
        tables["sample_annotation"].append(
            {
                "token": annotation,
                "sample_token": token,
                "instance_token": instance,
                "visibility_token": "",
                "attribute_tokens": [_token("attribute", str(given[i]))] if given[i] else [],
                "translation": boxes.translations[i].tolist(),
                "size": boxes.sizes[i].tolist(),
                "rotation": boxes.rotations[i].tolist(),
                "prev": "",
                "next": "",
                "num_lidar_pts": int(counts[i]),
                "num_radar_pts": 0,
            }
        )


def _without_offset(camera: Camera) -> FloatArray:
    """``camera_from_lidar`` (4, 4) with which ``P = K [I | 0]`` projects as the camera's own ``P`` does.

    KITTI's projections hold the stereo baseline in their last column; nuScenes has no place for it but the pose.
    """
    require_pinhole(camera, "the nuScenes layout")
    transform = np.array(camera.camera_from_lidar)
    transform[:3, 3] += np.linalg.solve(camera.intrinsics, camera.projection[:, 3])
    return transform


def _token(*parts: object) -> str:
    """The 32-digit token of a thing, the same in every run."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def _write_bytes(path: Path, data: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG", compress_level=1)

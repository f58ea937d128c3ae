"""Frames of any dataset, and what a run made of them, written as a bag: MCAP, rosbag2 or ROS 1."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.datasets.folder_export import pose_without_offset
from lcf3d.formats import ros_messages as ros
from lcf3d.formats.bag_files import BagWriter
from lcf3d.frame import Frame
from lcf3d.geometry.rotation import invert_rigid, quaternions_from_matrices, quaternions_from_yaws
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Camera, Detections2D, Detections3D, FloatArray

LIDAR, WORLD = "lidar", "world"
POINTS, OBJECTS, LABELS = "/lidar/points", "/lidar/objects", "/labels"
FUSED, MARKERS = "/fused/objects", "/fused/markers"
PERIOD_S = 0.1
"""Time between frames that have none."""

_COLOURS = ((0.34, 0.71, 0.91), (0.0, 0.62, 0.45), (0.9, 0.62, 0.0), (0.8, 0.47, 0.65), (0.94, 0.89, 0.26))


def write_bag(
    frames: Iterable[Frame],
    path: str | Path,
    fused: Callable[[str], FusedDetections] | None = None,
    detections: Callable[[Frame], tuple[Detections3D, Mapping[str, Detections2D]]] | None = None,
    quality: int | None = 90,
) -> int:
    """Write clouds, images, calibration, poses, labels and fused boxes, frame by frame.

    Topics: ``/lidar/points``, ``/CAMERA/image/compressed`` (or ``/CAMERA/image``), ``/CAMERA/camera_info``, ``/tf``,
    ``/labels``, ``/lidar/objects`` and ``/CAMERA/objects``, ``/fused/objects`` and, for viewers, ``/fused/markers``.

    Args:
        frames: of any dataset.
        path: ``.mcap``, ``.bag``, or a folder for rosbag2; must not exist.
        fused: gives the result of a frame, see `lcf3d.run.folder.RunFolder.read`.
        detections: gives both branches of a frame, 3D and 2D by camera.
        quality: of JPEG images; None writes them raw, every pixel as it is.

    Returns:
        How many frames were written.

    Raises:
        ConfigError: the path exists.
        MissingExtraError: the extra ``bag`` is not installed.
    """
    writer = BagWriter(Path(path).expanduser())
    count = 0
    try:
        for frame in frames:
            seconds = count * PERIOD_S if frame.timestamp is None else frame.timestamp
            _write_sensors(writer, frame, seconds, quality)
            if frame.labels is not None:
                message = ros.vision_from_detections_3d(writer.make, frame.labels, seconds, LIDAR)
                writer.write(LABELS, message, seconds)
            if detections is not None:
                _write_detections(writer, *detections(frame), seconds)
            if fused is not None:
                found = fused(frame.id).detections
                writer.write(FUSED, ros.vision_from_detections_3d(writer.make, found, seconds, LIDAR), seconds)
                writer.write(MARKERS, _markers(writer.make, found, seconds), seconds)
            count += 1
    finally:
        writer.close()
    return count


def _write_detections(
    writer: BagWriter, lidar: Detections3D, cameras: Mapping[str, Detections2D], seconds: float
) -> None:
    writer.write(OBJECTS, ros.vision_from_detections_3d(writer.make, lidar, seconds, LIDAR), seconds)
    for name, seen in cameras.items():
        writer.write(f"/{name}/objects", ros.vision_from_detections_2d(writer.make, seen, seconds, name), seconds)


def _write_sensors(writer: BagWriter, frame: Frame, seconds: float, quality: int | None) -> None:
    make = writer.make
    # a camera hangs on the LiDAR: its pose is the inverse
    transforms = [
        _transform(make, seconds, LIDAR, camera.name, invert_rigid(pose_without_offset(camera)))
        for camera in frame.cameras
    ]
    if frame.world_from_lidar is not None:
        transforms.append(_transform(make, seconds, WORLD, LIDAR, frame.world_from_lidar))
    if transforms:
        writer.write("/tf", make("tf2_msgs/msg/TFMessage", transforms=transforms), seconds)
    points = frame.points
    if points is not None:
        writer.write(POINTS, ros.cloud_from_points(make, points, seconds, LIDAR), seconds)
    for camera in frame.cameras:
        writer.write(f"/{camera.name}/camera_info", _info(make, camera, seconds), seconds)
        if camera.name not in frame.images:
            continue
        image = np.asarray(frame.images[camera.name])
        header = ros.make_header(make, seconds, camera.name)
        if quality is None:
            raw = np.ascontiguousarray(image).reshape(-1)
            height, width = image.shape[:2]
            shape = {"height": height, "width": width, "encoding": "rgb8", "is_bigendian": 0, "step": 3 * width}
            message = make("sensor_msgs/msg/Image", header=header, **shape, data=raw)
            writer.write(f"/{camera.name}/image", message, seconds)
        else:
            data = np.frombuffer(_jpeg(image, quality), np.uint8)
            message = make("sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=data)
            writer.write(f"/{camera.name}/image/compressed", message, seconds)


def _jpeg(image: Any, quality: int) -> bytes:
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image).save(data, format="JPEG", quality=quality)
    return data.getvalue()


def _transform(make: Any, seconds: float, parent: str, child: str, parent_from_child: FloatArray) -> Any:
    w, x, y, z = quaternions_from_matrices(parent_from_child[None, :3, :3])[0].tolist()
    moved = dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True))
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=ros.make_header(make, seconds, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", **moved),
            rotation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )


def _info(make: Any, camera: Camera, seconds: float) -> Any:
    lens = camera.distortion
    coefficients = np.zeros(5) if lens is None else np.array(lens.coefficients)
    model = "plumb_bob" if len(coefficients) <= 5 else "rational_polynomial"
    if lens is not None and lens.model == "fisheye":
        model = "equidistant"
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=ros.make_header(make, seconds, camera.name),
        height=camera.height,
        width=camera.width,
        distortion_model=model,
        d=coefficients,
        k=np.ascontiguousarray(camera.intrinsics).reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.hstack([camera.intrinsics, np.zeros((3, 1))]).reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _markers(make: Any, found: Detections3D, seconds: float) -> Any:
    """A ``visualization_msgs/msg/MarkerArray`` of half transparent boxes, the old ones removed first."""
    colour = make("std_msgs/msg/ColorRGBA", r=0.0, g=0.0, b=0.0, a=0.0)
    markers = [_marker(make, seconds, 0, 3, np.array([0, 0, 0, 1.0, 1, 1, 0]), colour)]
    for i, (box, label) in enumerate(zip(found.boxes, found.labels, strict=True)):
        r, g, b = _COLOURS[label % len(_COLOURS)]
        colour = make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=0.5)
        markers.append(_marker(make, seconds, i + 1, 0, box, colour))
    return make("visualization_msgs/msg/MarkerArray", markers=markers)


def _marker(make: Any, seconds: float, number: int, action: int, box: FloatArray, colour: Any) -> Any:
    w, x, y, z = quaternions_from_yaws(box[6:7])[0].tolist()
    time = make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    return make(
        "visualization_msgs/msg/Marker",
        header=ros.make_header(make, seconds, LIDAR),
        ns="fused",
        id=number,
        type=1,
        action=action,
        pose=make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", **dict(zip("xyz", box[:3].tolist(), strict=True))),
            orientation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
        scale=make("geometry_msgs/msg/Vector3", **dict(zip("xyz", box[3:6].tolist(), strict=True))),
        color=colour,
        lifetime=time,
        frame_locked=False,
        points=[],
        colors=[],
        text="",
        mesh_resource="",
        mesh_use_embedded_materials=False,
        **_newer(make, seconds),
    )


def _newer(make: Any, seconds: float) -> dict[str, Any]:
    """Fields that markers have since ROS 2 Humble."""
    known = make.__self__.fields_of("visualization_msgs/msg/Marker")
    fields: dict[str, Any] = {}
    if "texture_resource" in known:
        image = make(
            "sensor_msgs/msg/CompressedImage",
            header=ros.make_header(make, seconds, ""),
            format="",
            data=np.zeros(0, np.uint8),
        )
        fields = {"texture_resource": "", "texture": image, "uv_coordinates": []}
    if "mesh_file" in known:
        mesh = make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8))
        fields["mesh_file"] = mesh
    return fields

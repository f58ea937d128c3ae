"""ROS 2 messages to and from our structures, by their fields alone: rclpy's objects and those of rosbags look the same.

Nothing of ROS is imported. Messages are read by attribute; they are built by a function ``make(type, **fields)`` that
the caller gives, for example ``make("std_msgs/msg/Header", stamp=..., frame_id="lidar")``, with every field named.
Boxes are in the frame of the message's header; whoever calls brings them into the LiDAR frame.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.distortion import Distortion
from lcf3d.errors import FormatError
from lcf3d.geometry.rotation import quaternions_from_yaws, rigid_transforms, yaws_from_quaternions
from lcf3d.structures import Camera, Detections2D, Detections3D, FloatArray

Make = Callable[..., Any]

# sensor_msgs/msg/PointField
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
INTENSITY_NAMES = ("intensity", "i", "reflectivity", "reflectance")
# autoware_perception_msgs/msg/ObjectClassification
AUTOWARE_LABELS = {
    "car": 1, "truck": 2, "bus": 3, "trailer": 4, "motorcycle": 5, "bicycle": 6, "cyclist": 6, "pedestrian": 7,
}  # fmt: skip
_AUTOWARE_NAMES = {code: name for name, code in AUTOWARE_LABELS.items() if name != "cyclist"}
_CHANNELS = {
    "rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "8UC3": (3, (2, 1, 0)), "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)), "mono8": (1, (0, 0, 0)), "8UC1": (1, (0, 0, 0)),
}  # fmt: skip
_LENSES = {"plumb_bob": "brown_conrady", "rational_polynomial": "brown_conrady", "equidistant": "fisheye"}


def seconds_of(stamp: Any) -> float:
    """Seconds of a ``builtin_interfaces/msg/Time``."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def make_header(make: Make, seconds: float, frame_id: str) -> Any:
    """A ``std_msgs/msg/Header``."""
    nanoseconds = round(seconds * 1e9)
    stamp = make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def points_from_cloud(message: Any) -> NDArray[np.float32]:
    """(N, 4) float32 ``x y z intensity`` of a ``sensor_msgs/msg/PointCloud2``; 0 without an intensity.

    Raises:
        FormatError: no x, y or z, fields outside of a point, or less data than the header says.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: (order + _POINT_TYPES.get(f.datatype, "V1"), int(f.offset)) for f in message.fields}
    intensity = next((name for name in INTENSITY_NAMES if name in fields), None)
    wanted = ["x", "y", "z", *([intensity] if intensity else [])]
    absent = [name for name in wanted if name not in fields]
    if absent:
        raise FormatError(f"a point cloud needs the fields x, y and z, it has {sorted(fields)}")
    layout = np.dtype(
        {
            "names": wanted,
            "formats": [fields[name][0] for name in wanted],
            "offsets": [fields[name][1] for name in wanted],
            "itemsize": max(int(message.point_step), max(o + np.dtype(t).itemsize for t, o in fields.values())),
        }
    )
    data = np.frombuffer(bytes(message.data), np.uint8)
    rows, columns, step = int(message.height), int(message.width), int(message.row_step)
    if layout.itemsize != message.point_step or len(data) < rows * step or step < columns * layout.itemsize:
        raise FormatError(
            f"a point cloud of {rows} x {columns} points of {message.point_step} bytes needs {rows} rows of {step} "
            f"bytes, it has {len(data)} bytes: the message is cut off or its layout is wrong"
        )
    packed = data[: rows * step].reshape(rows, step)[:, : columns * layout.itemsize]
    points = np.ascontiguousarray(packed).view(layout).ravel()
    result = np.zeros((len(points), 4), np.float32)
    for column, name in enumerate(wanted):
        result[:, column] = points[name]
    return result


def cloud_from_points(make: Make, points: NDArray[np.float32], seconds: float, frame_id: str) -> Any:
    """A ``sensor_msgs/msg/PointCloud2`` of (N, 4) ``x y z intensity``."""
    packed = np.ascontiguousarray(points[:, :4], dtype="<f4")
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate(("x", "y", "z", "intensity"))
    ]
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=make_header(make, seconds, frame_id),
        height=1,
        width=len(packed),
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=16 * len(packed),
        data=np.frombuffer(packed.tobytes(), np.uint8),
        is_dense=bool(np.isfinite(packed).all()),
    )


def pixels_from_image(message: Any) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of a ``sensor_msgs/msg/Image`` or ``CompressedImage``.

    Raises:
        FormatError: an encoding that is not 8 bit RGB, BGR or grey, or less data than the header says.
    """
    if not hasattr(message, "encoding"):
        return _decompressed(message)
    if message.encoding not in _CHANNELS:
        raise FormatError(f"an image is encoded as {message.encoding!r}; expected one of {', '.join(_CHANNELS)}")
    channels, order = _CHANNELS[message.encoding]
    data = np.frombuffer(bytes(message.data), np.uint8)
    height, width, step = int(message.height), int(message.width), int(message.step)
    if len(data) < height * step or step < width * channels:
        raise FormatError(
            f"an image of {width} x {height} {message.encoding} pixels needs {height} rows of {step} bytes, it has "
            f"{len(data)} bytes: the message is cut off"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    return np.ascontiguousarray(rows.reshape(height, width, channels)[..., list(order)])


def _decompressed(message: Any) -> NDArray[np.uint8]:
    from PIL import Image, UnidentifiedImageError

    try:
        return np.asarray(Image.open(io.BytesIO(bytes(message.data))).convert("RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise FormatError(f"a compressed image ({message.format}) cannot be read: {error}") from None


def camera_from_info(name: str, message: Any, camera_from_lidar: FloatArray, rectified: bool = False) -> Camera:
    """A camera of a ``sensor_msgs/msg/CameraInfo``: of its images as taken, with the lens, or of rectified ones.

    Raises:
        FormatError: no camera matrix, or an unknown lens model.
    """
    matrix = np.asarray(message.p if rectified else message.k, dtype=np.float64).reshape(3, -1)
    if not matrix[0, 0] > 0:
        raise FormatError(f"the camera info of {name!r} holds no {'P' if rectified else 'K'}: it is not calibrated")
    projection = matrix if rectified else np.column_stack([matrix, np.zeros(3)])
    coefficients = tuple(float(value) for value in message.d)
    lens = None
    if not rectified and any(coefficients):
        model = _LENSES.get(message.distortion_model)
        if model is None:
            raise FormatError(
                f"the lens model {message.distortion_model!r} of camera {name!r} is unknown; expected one of "
                f"{', '.join(_LENSES)}"
            )
        lens = Distortion(model, coefficients)  # type: ignore[arg-type]
    return Camera(name, projection, camera_from_lidar, int(message.width), int(message.height), lens)


def transform_of(message: Any) -> FloatArray:
    """(4, 4) ``parent_from_child`` of a ``TransformStamped``, ``Transform``, ``Pose`` or ``Odometry``."""
    for name in ("transform", "pose"):
        while hasattr(message, name):
            message = getattr(message, name)
    position = message.translation if hasattr(message, "translation") else message.position
    turn = message.rotation if hasattr(message, "rotation") else message.orientation
    quaternion = np.array([[turn.w, turn.x, turn.y, turn.z]])
    if not np.linalg.norm(quaternion) > 0:
        raise FormatError("a transform's quaternion is zero")
    matrix: FloatArray = rigid_transforms(quaternion, np.array([[position.x, position.y, position.z]]))[0]
    return matrix


def detections_3d_from_vision(message: Any, class_names: Sequence[str]) -> Detections3D:
    """Boxes of a ``vision_msgs/msg/Detection3DArray``: each by its best hypothesis among ``class_names``."""
    rows, scores, labels = [], [], []
    for found in message.detections:
        best = _best_hypothesis(found.results, class_names)
        if best is None:
            continue
        centre, size = found.bbox.center, found.bbox.size
        rows.append([*_xyz(centre.position), size.x, size.y, size.z, _yaw(centre.orientation)])
        labels.append(best[0])
        scores.append(best[1])
    return Detections3D(np.array(rows), np.array(scores), np.array(labels, dtype=np.int64), tuple(class_names))


def vision_from_detections_3d(make: Make, detections: Detections3D, seconds: float, frame_id: str) -> Any:
    """A ``vision_msgs/msg/Detection3DArray``; the id of each box is its place in the list."""
    header = make_header(make, seconds, frame_id)
    found = []
    for i, (box, score, label) in enumerate(zip(detections.boxes, detections.scores, detections.labels, strict=True)):
        pose = _make_pose(make, box)
        size = make("geometry_msgs/msg/Vector3", x=float(box[3]), y=float(box[4]), z=float(box[5]))
        found.append(
            make(
                "vision_msgs/msg/Detection3D",
                header=header,
                results=[_make_hypothesis(make, detections.class_names[label], float(score), pose)],
                bbox=make("vision_msgs/msg/BoundingBox3D", center=pose, size=size),
                id=str(i),
            )
        )
    return make("vision_msgs/msg/Detection3DArray", header=header, detections=found)


def detections_2d_from_vision(message: Any, class_names: Sequence[str]) -> Detections2D:
    """Boxes of a ``vision_msgs/msg/Detection2DArray``: each by its best hypothesis among ``class_names``."""
    rows, scores, labels = [], [], []
    for found in message.detections:
        best = _best_hypothesis(found.results, class_names)
        if best is None:
            continue
        # before version 4 the centre was a pose with x and y of its own
        centre = getattr(found.bbox.center, "position", found.bbox.center)
        half_x, half_y = found.bbox.size_x / 2, found.bbox.size_y / 2
        rows.append([centre.x - half_x, centre.y - half_y, centre.x + half_x, centre.y + half_y])
        labels.append(best[0])
        scores.append(best[1])
    return Detections2D(np.array(rows), np.array(scores), np.array(labels, dtype=np.int64), tuple(class_names))


def vision_from_detections_2d(make: Make, detections: Detections2D, seconds: float, frame_id: str) -> Any:
    """A ``vision_msgs/msg/Detection2DArray``."""
    header = make_header(make, seconds, frame_id)
    nowhere = _make_pose(make, np.zeros(7))
    found = []
    for i, (box, score, label) in enumerate(zip(detections.boxes, detections.scores, detections.labels, strict=True)):
        x, y = (box[:2] + box[2:]) / 2
        point = make("vision_msgs/msg/Point2D", x=float(x), y=float(y))
        bounds = make(
            "vision_msgs/msg/BoundingBox2D",
            center=make("vision_msgs/msg/Pose2D", position=point, theta=0.0),
            size_x=float(box[2] - box[0]),
            size_y=float(box[3] - box[1]),
        )
        results = [_make_hypothesis(make, detections.class_names[label], float(score), nowhere)]
        found.append(make("vision_msgs/msg/Detection2D", header=header, results=results, bbox=bounds, id=str(i)))
    return make("vision_msgs/msg/Detection2DArray", header=header, detections=found)


def detections_3d_from_autoware(message: Any, class_names: Sequence[str]) -> Detections3D:
    """Boxes of an ``autoware_perception_msgs/msg/DetectedObjects``; the score is the existence probability."""
    lower = {name.lower(): i for i, name in enumerate(class_names)}
    if "bicycle" not in lower and "cyclist" in lower:
        lower["bicycle"] = lower["cyclist"]
    rows, scores, labels, speeds = [], [], [], []
    for found in message.objects:
        best = max(found.classification, key=lambda entry: float(entry.probability), default=None)
        label = None if best is None else lower.get(_AUTOWARE_NAMES.get(int(best.label), ""))
        if label is None:
            continue
        pose, size = found.kinematics.pose_with_covariance.pose, found.shape.dimensions
        yaw = _yaw(pose.orientation)
        rows.append([*_xyz(pose.position), size.x, size.y, size.z, yaw])
        labels.append(label)
        scores.append(float(found.existence_probability))
        along = found.kinematics.twist_with_covariance.twist.linear
        cos, sin = np.cos(yaw), np.sin(yaw)
        moving = (cos * along.x - sin * along.y, sin * along.x + cos * along.y)
        speeds.append(moving if found.kinematics.has_twist else (np.nan, np.nan))
    return Detections3D(
        np.array(rows), np.array(scores), np.array(labels, dtype=np.int64), tuple(class_names), np.array(speeds)
    )


def autoware_from_detections_3d(make: Make, detections: Detections3D, seconds: float, frame_id: str) -> Any:
    """An ``autoware_perception_msgs/msg/DetectedObjects``; classes that Autoware does not know are UNKNOWN."""
    objects = []
    for i, (box, score, label) in enumerate(zip(detections.boxes, detections.scores, detections.labels, strict=True)):
        code = AUTOWARE_LABELS.get(detections.class_names[label].lower(), 0)
        speed = np.full(2, np.nan) if detections.velocities is None else detections.velocities[i]
        kind = make("autoware_perception_msgs/msg/ObjectClassification", label=code, probability=1.0)
        shape = make(
            "autoware_perception_msgs/msg/Shape",
            type=0,
            footprint=make("geometry_msgs/msg/Polygon", points=[]),
            dimensions=make("geometry_msgs/msg/Vector3", x=float(box[3]), y=float(box[4]), z=float(box[5])),
        )
        objects.append(
            make(
                "autoware_perception_msgs/msg/DetectedObject",
                existence_probability=float(score),
                classification=[kind],
                kinematics=_make_kinematics(make, box, speed),
                shape=shape,
            )
        )
    header = make_header(make, seconds, frame_id)
    return make("autoware_perception_msgs/msg/DetectedObjects", header=header, objects=objects)


def diagnostics_message(make: Make, entries: Sequence[Mapping[str, Any]], seconds: float, *, level_bytes: bool) -> Any:
    """A ``diagnostic_msgs/msg/DiagnosticArray`` of `lcf3d.live.fuser.Fuser.diagnostics`.

    Args:
        make: see the module.
        entries: the diagnostics.
        seconds: the stamp.
        level_bytes: rclpy has the level as one byte, rosbags as a number.
    """
    status = [
        make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=bytes([entry["level"]]) if level_bytes else entry["level"],
            name=entry["name"],
            message=entry["message"],
            hardware_id=entry["hardware_id"],
            values=[make("diagnostic_msgs/msg/KeyValue", **value) for value in entry["values"]],
        )
        for entry in entries
    ]
    return make("diagnostic_msgs/msg/DiagnosticArray", header=make_header(make, seconds, ""), status=status)


def _best_hypothesis(results: Sequence[Any], class_names: Sequence[str]) -> tuple[int, float] | None:
    """Label and score of the best hypothesis of a known class; None without one."""
    known = []
    for result in results:
        # version 3 had id and score beside the pose
        named = getattr(result, "hypothesis", result)
        name = str(getattr(named, "class_id", getattr(named, "id", "")))
        if name in class_names:
            known.append((class_names.index(name), float(named.score)))
    return max(known, key=lambda entry: entry[1], default=None)


def _make_hypothesis(make: Make, name: str, score: float, pose: Any) -> Any:
    return make(
        "vision_msgs/msg/ObjectHypothesisWithPose",
        hypothesis=make("vision_msgs/msg/ObjectHypothesis", class_id=name, score=score),
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
    )


def _make_pose(make: Make, box: FloatArray) -> Any:
    w, x, y, z = quaternions_from_yaws(box[6:7])[0].tolist()
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=float(box[0]), y=float(box[1]), z=float(box[2])),
        orientation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )


def _make_kinematics(make: Make, box: FloatArray, speed: FloatArray) -> Any:
    """Pose and, in the box's own axes, velocity."""
    known = bool(np.isfinite(speed).all())
    cos, sin = np.cos(box[6]), np.sin(box[6])
    along = (cos * speed[0] + sin * speed[1], cos * speed[1] - sin * speed[0]) if known else (0.0, 0.0)
    twist = make(
        "geometry_msgs/msg/Twist",
        linear=make("geometry_msgs/msg/Vector3", x=float(along[0]), y=float(along[1]), z=0.0),
        angular=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
    )
    return make(
        "autoware_perception_msgs/msg/DetectedObjectKinematics",
        pose_with_covariance=make(
            "geometry_msgs/msg/PoseWithCovariance", pose=_make_pose(make, box), covariance=np.zeros(36)
        ),
        has_position_covariance=False,
        orientation_availability=2,
        twist_with_covariance=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        has_twist=known,
        has_twist_covariance=False,
    )


def _xyz(point: Any) -> list[float]:
    return [float(point.x), float(point.y), float(point.z)]


def _yaw(turn: Any) -> float:
    return float(yaws_from_quaternions(np.array([[turn.w, turn.x, turn.y, turn.z]]))[0])

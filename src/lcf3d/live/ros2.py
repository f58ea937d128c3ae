"""A ROS 2 node: topics in, `Fuser`, topics out. A thin shell; rclpy is imported when the node is made, and only here.

What it reads and writes is in `lcf3d.formats.ros_messages`. Its parameters are in `PARAMETERS`, with a sentence each.
"""

from __future__ import annotations

from importlib import import_module
from time import monotonic
from typing import Any

import numpy as np

from lcf3d.errors import ConfigError, FormatError, Lcf3dError
from lcf3d.formats import ros_messages as ros
from lcf3d.fusion.alignment_watch import WatchSettings
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.rotation import transform_points
from lcf3d.live.fuser import Fuser
from lcf3d.live.messages import CameraBoxes, CameraModel, EgoPose, LidarBoxes, Message, Scan
from lcf3d.live.settings import LiveResult, LiveSettings
from lcf3d.live.synchronizer import SyncSettings
from lcf3d.live.warming import settle_memory
from lcf3d.structures import Camera, FloatArray

PARAMETERS: dict[str, tuple[Any, str]] = {
    "config": ("default", "preset or YAML file of the fusion's settings"),
    "messages": ("vision", "vision for vision_msgs, autoware for autoware_perception_msgs, in and out"),
    "lidar_frame": ("lidar", "frame of the boxes; what comes in another is brought into it with tf2"),
    "lidar_boxes": ("lidar/detections", "topic of the 3D detections"),
    "scan": ("", "topic of the PointCloud2 for recovery; none if empty"),
    "odometry": ("", "topic of the Odometry; none if empty"),
    "fused": ("fused/detections", "topic of the result"),
    "cameras": ([""], "names of the cameras: CAMERA/detections and CAMERA/camera_info are subscribed to"),
    "rectified": (True, "whether 2D detections are of rectified images"),
    "tolerance": (0.04, "seconds that a camera may be off its moment"),
    "deadline": (0.2, "seconds after which a moment is fused without what is missing"),
    "self_calibrate": (False, "turn each camera as the calibration watch says"),
}
# of each camera, under its name
CAMERA_PARAMETERS: dict[str, tuple[Any, str]] = {
    "frame": ("", "its optical frame for tf2; that of its camera_info if empty"),
    "offset": (0.0, "seconds that it looks after the scan by design"),
    "camera_from_lidar": ([0.0], "16 numbers, row by row, in place of tf2"),
}
# stamps of messages kept, so that a result has its scan's to the nanosecond
STAMPS = 256
# seconds before the same warning is given again
QUIET = 60.0


class FuserNode:
    """The node: subscriptions, publishers and a timer around one `Fuser`.

    Args:
        node: an ``rclpy.node.Node``.
        tf_buffer: a ``tf2_ros.Buffer`` that listens.

    Raises:
        ConfigError: parameters that cannot work.
    """

    def __init__(self, node: Any, tf_buffer: Any) -> None:
        self.node, self._tf = node, tf_buffer
        values = {name: node.declare_parameter(name, default).value for name, (default, _) in PARAMETERS.items()}
        if values["messages"] not in ("vision", "autoware"):
            raise ConfigError(f"messages must be vision or autoware, got {values['messages']!r}")
        self._values = values
        self.cameras = [name for name in values["cameras"] if name]
        self._own = {
            camera: {
                key: node.declare_parameter(f"{camera}.{key}", default).value
                for key, (default, _) in CAMERA_PARAMETERS.items()
            }
            for camera in self.cameras
        }
        config = FusionConfig.load(values["config"])
        if not values["scan"]:
            config = config.updated(recovery=False)
        sync = SyncSettings(
            offsets={camera: own["offset"] for camera, own in self._own.items()},
            tolerance=values["tolerance"],
            deadline=values["deadline"],
            scans=bool(values["scan"]),
        )
        settings = LiveSettings(sync, realtime=True, watch=WatchSettings(), correct=values["self_calibrate"])
        self.fuser = Fuser(LateCascadeFusion(config), settings=settings, on_result=self._publish)
        self.names = config.class_names
        self._stamps: dict[float, Any] = {}
        self._models: dict[str, bytes] = {}
        self._told: dict[str, float] = {}
        self._connect()

    def _connect(self) -> None:
        node, values = self.node, self._values
        kind = _message("autoware_perception_msgs/msg/DetectedObjects" if self._autoware else _VISION_3D)
        quality = import_module("rclpy.qos").qos_profile_sensor_data
        node.create_subscription(kind, values["lidar_boxes"], self._guarded(self._on_lidar), quality)
        if values["scan"]:
            cloud = _message("sensor_msgs/msg/PointCloud2")
            node.create_subscription(cloud, values["scan"], self._guarded(self._on_scan), quality)
        if values["odometry"]:
            odometry = _message("nav_msgs/msg/Odometry")
            node.create_subscription(odometry, values["odometry"], self._guarded(self._on_odometry), quality)
        for camera in self.cameras:
            self._connect_camera(camera, quality)
        self._output = node.create_publisher(kind, values["fused"], 10)
        self._diagnostics = node.create_publisher(_message("diagnostic_msgs/msg/DiagnosticArray"), "/diagnostics", 10)
        node.create_timer(0.02, self._guarded(self.fuser.poll))
        node.create_timer(1.0, self._guarded(self._report))

    def _connect_camera(self, camera: str, quality: Any) -> None:
        boxes, info = _message("vision_msgs/msg/Detection2DArray"), _message("sensor_msgs/msg/CameraInfo")

        def on_boxes(message: Any) -> None:
            found = ros.detections_2d_from_vision(message, self.names)
            self.fuser.push(CameraBoxes(ros.seconds_of(message.header.stamp), camera, found))

        def on_info(message: Any) -> None:
            self._on_info(camera, message)

        self.node.create_subscription(boxes, f"{camera}/detections", self._guarded(on_boxes), quality)
        self.node.create_subscription(info, f"{camera}/camera_info", self._guarded(on_info), quality)

    @property
    def _autoware(self) -> bool:
        return bool(self._values["messages"] == "autoware")

    def _guarded(self, callback: Any) -> Any:
        """A callback whose errors stop nothing and are told, each again after `QUIET` seconds at the soonest."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Lcf3dError as error:
                now, text = monotonic(), str(error)
                self._told = {told: when for told, when in self._told.items() if now - when < QUIET}
                if text not in self._told:
                    self._told[text] = now
                    self.node.get_logger().warning(text)

        return guarded

    def _push(self, message: Message, stamp: Any) -> None:
        self._stamps[message.time] = stamp
        while len(self._stamps) > STAMPS:
            del self._stamps[next(iter(self._stamps))]
        self.fuser.push(message)

    def _on_lidar(self, message: Any) -> None:
        read = ros.detections_3d_from_autoware if self._autoware else ros.detections_3d_from_vision
        found = read(message, self.names)
        into = self._lidar_from(message.header.frame_id)
        if into is not None:
            object.__setattr__(found, "boxes", transform_boxes(found.boxes, into))
        self._push(LidarBoxes(ros.seconds_of(message.header.stamp), found), message.header.stamp)

    def _on_scan(self, message: Any) -> None:
        points = ros.points_from_cloud(message)
        into = self._lidar_from(message.header.frame_id)
        if into is not None:
            points[:, :3] = transform_points(points[:, :3].astype(np.float64), into)
        self._push(Scan(ros.seconds_of(message.header.stamp), points), message.header.stamp)

    def _on_odometry(self, message: Any) -> None:
        pose = ros.transform_of(message)
        base_from_lidar = self._transform(message.child_frame_id, self._values["lidar_frame"])
        self.fuser.push(EgoPose(ros.seconds_of(message.header.stamp), pose @ base_from_lidar))

    def _on_info(self, name: str, message: Any) -> None:
        """A calibration; one that is known already costs nothing."""
        content = repr((message.width, message.height, list(message.k), list(message.p), list(message.d))).encode()
        if self._models.get(name) == content:
            return
        own = self._own[name]
        if len(own["camera_from_lidar"]) == 16:
            transform = np.array(own["camera_from_lidar"]).reshape(4, 4)
        else:
            transform = self._transform(own["frame"] or message.header.frame_id, self._values["lidar_frame"])
        camera: Camera = ros.camera_from_info(name, message, transform, rectified=self._values["rectified"])
        self.fuser.push(CameraModel(ros.seconds_of(message.header.stamp), camera))
        self._models[name] = content

    def _lidar_from(self, frame: str) -> FloatArray | None:
        """Into the LiDAR's frame from another; None from itself."""
        own = self._values["lidar_frame"]
        return None if frame == own else self._transform(own, frame)

    def _transform(self, target: str, source: str) -> FloatArray:
        """``target_from_source`` of tf2.

        Raises:
            FormatError: there is none yet.
        """
        if target == source:
            return np.eye(4)
        try:
            return ros.transform_of(self._tf.lookup_transform(target, source, import_module("rclpy.time").Time()))
        except import_module("tf2_ros").TransformException as error:
            raise FormatError(f"no transform from {source!r} to {target!r} yet: {error}") from None

    def _publish(self, result: LiveResult) -> None:
        write = ros.autoware_from_detections_3d if self._autoware else ros.vision_from_detections_3d
        message = write(make_message, result.fused.detections, result.time, self._values["lidar_frame"])
        if result.time in self._stamps:
            message.header.stamp = self._stamps[result.time]
        self._output.publish(message)

    def _report(self) -> None:
        now = self.node.get_clock().now().nanoseconds * 1e-9
        entries = self.fuser.diagnostics()
        self._diagnostics.publish(ros.diagnostics_message(make_message, entries, now, level_bytes=True))


_VISION_3D = "vision_msgs/msg/Detection3DArray"


def _message(kind: str) -> Any:
    """The Python class of a message type such as ``std_msgs/msg/Header``.

    Raises:
        ConfigError: its package is not installed in this ROS.
    """
    package, _, name = kind.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ImportError:
        raise ConfigError(f"{package} is not there: install ros-$ROS_DISTRO-{package.replace('_', '-')}") from None


def make_message(kind: str, /, **fields: Any) -> Any:
    """A message of rclpy's kind with these fields."""
    return _message(kind)(**fields)


def spin(arguments: list[str] | None = None) -> None:
    """Make the node and run it until ROS stops.

    Raises:
        ConfigError: there is no rclpy, or parameters that cannot work.
    """
    try:
        rclpy = import_module("rclpy")
        tf2_ros = import_module("tf2_ros")
    except ImportError as error:
        raise ConfigError(
            f"the ROS 2 node needs {error.name}: source a ROS 2 installation first (source /opt/ros/DISTRO/setup.bash)"
        ) from None
    rclpy.init(args=arguments)
    node = rclpy.create_node("lcf3d")
    try:
        buffer = tf2_ros.Buffer()
        # it listens for as long as it lives
        listener = tf2_ros.TransformListener(buffer, node)
        shell = FuserNode(node, buffer)
        shell.fuser.warm_up()
        settle_memory()
        rclpy.spin(node)
        del listener
    except (KeyboardInterrupt, import_module("rclpy.executors").ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()

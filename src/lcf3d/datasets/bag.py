"""``bag:FILE``: a recording of ROS 1 or ROS 2 as frames, without ROS (see `lcf3d.formats.bag_files`).

A frame is a point cloud and is named by its stamp in nanoseconds; each camera gives its image nearest in time. The
LiDAR frame is the cloud's, turned to forward-left-up; poses come from ``/tf`` and ``/tf_static``, through the fixed
root where the vehicle moves between a scan and an image.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.bag_transforms import TransformTree
from lcf3d.datasets.base import BaseDataset
from lcf3d.datasets.folder_sensors import CANONICAL_AXES, turn
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.formats import ros_messages as ros
from lcf3d.formats.bag_files import BagReader, TopicIndex
from lcf3d.formats.ros_objects import (
    CLOUDS,
    IMAGES,
    OBJECTS_2D,
    OBJECTS_3D,
    class_names_of,
    detections_2d_of,
    detections_3d_of,
)
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D, FloatArray

# what the last parts of image topics are called; what is before them is the camera
_IMAGE_PARTS = (
    "image",
    "image_raw",
    "image_color",
    "image_rect",
    "image_rect_color",
    "image_mono",
    "compressed",
    "raw",
)
_INFO = "sensor_msgs/msg/CameraInfo"
# messages that classes are looked for in
_LOOKED_AT = 50


class BagDataset(BaseDataset):
    """Frames of a bag.

    Args:
        path: ``.bag``, ``.mcap``, ``.db3`` or a rosbag2 folder.
        points: topic of the point clouds; the one with the most messages without it.
        cameras: topics of images, with commas; all that have a ``camera_info`` beside them without it.
        labels: topic of 3D objects that are the ground truth.
        classes: names of the classes, with commas; those of the messages of objects without it.
        axes: of the clouds, see `lcf3d.datasets.folder_sensors`.
        max_delay_s: longest accepted time between a cloud and an image or objects.

    Raises:
        DatasetError: no clouds, no transforms, a topic without calibration, or a clock that jumps.
        FormatError: the bag is cut off.
        ConfigError: a topic that is not there or of another type.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        points: str = "",
        cameras: str = "",
        labels: str = "",
        classes: str = "",
        axes: str = CANONICAL_AXES,
        max_delay_s: float = 0.05,
    ) -> None:
        self.path = Path(path).expanduser()
        self.max_delay_s = max_delay_s
        try:
            self.lidar_turn = turn(axes)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        self.bag = BagReader(self.path)
        self.points_topic = points or self._guess_points()
        self.bag.require(self.points_topic, CLOUDS)
        self.left_out: list[str] = []
        self._camera_topics = self._find_cameras([name for name in cameras.split(",") if name])
        self.labels_topic = labels
        if labels:
            self.bag.require(labels, OBJECTS_3D)
        wanted = [self.points_topic, *self._camera_topics.values(), *([labels] if labels else [])]
        self._indices = self.bag.index(wanted)
        self.transforms = self._read_transforms()
        self._infos = {name: self._read_info(name) for name in self._camera_topics}
        self.camera_names = tuple(self._camera_topics)
        self.class_names = tuple(name for name in classes.split(",") if name) or self._find_classes()
        self._numbers: dict[str, int] = {}
        for number, stamp in enumerate(self._indices[self.points_topic].stamps_ns.tolist()):
            self._numbers.setdefault(str(stamp), number)
        self.ids = tuple(self._numbers)
        if not self.ids:
            raise DatasetError(f"topic {self.points_topic} of {self.path} holds no messages")
        self.lidar_frame = str(self.bag.message(self.points_topic, self.index_of(self.points_topic), 0).header.frame_id)

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether it is a bag by its suffix or its ``metadata.yaml``."""
        return root.suffix in (".bag", ".mcap", ".db3") or (root / "metadata.yaml").is_file()

    def index_of(self, topic: str) -> TopicIndex:
        """Index of a topic, made when first asked for.

        Raises:
            DatasetError: its clock jumps.
        """
        if topic not in self._indices:
            self._indices.update(self.bag.index([topic]))
        return self._indices[topic]

    def _guess_points(self) -> str:
        clouds = {name: t.messages for name, t in self.bag.topics.items() if t.kind in CLOUDS and t.messages}
        if not clouds:
            kinds = ", ".join(f"{name} ({t.kind})" for name, t in self.bag.topics.items()) or "none"
            raise DatasetError(f"{self.path} has no topic of point clouds; its topics: {kinds}"[:600])
        best: str = max(clouds, key=lambda name: (clouds[name], -len(name)))
        return best

    def _find_cameras(self, named: list[str]) -> dict[str, str]:
        """Image topic by camera name."""
        topics = named or [name for name, t in self.bag.topics.items() if t.kind in IMAGES and t.messages]
        by_place: dict[str, str] = {}
        for topic in sorted(topics, key=lambda name: (_namespace(name), len(name))):
            self.bag.require(topic, IMAGES)
            if self._info_topic(topic) in self.bag.topics:
                # the shorter of a raw and a compressed topic of one camera
                by_place.setdefault(_namespace(topic), topic)
            elif named:
                raise DatasetError(f"topic {topic} has no calibration: {self._info_topic(topic)} is not in {self.path}")
            else:
                self.left_out.append(f"{topic} has no calibration ({self._info_topic(topic)})")
        if self.left_out and not by_place:
            raise DatasetError(f"{self.path}: no image topic has a calibration: {self.left_out[0]}")
        last = [place.rsplit("/", 1)[-1] for place in by_place]
        unique = len(set(last)) == len(last)
        return {
            (short if unique and short else place.strip("/").replace("/", "_") or "camera"): topic
            for (place, topic), short in zip(by_place.items(), last, strict=True)
        }

    def _info_topic(self, topic: str) -> str:
        return f"{_namespace(topic)}/camera_info"

    def _read_info(self, camera: str) -> Any:
        topic = self._info_topic(self._camera_topics[camera])
        for _, _, message in self.bag.messages([topic], 1):
            lower = {name: getattr(message, name, None) for name in ("width", "height", "distortion_model", "header")}
            # ROS 1 writes the matrices large
            lower.update({name: getattr(message, name, getattr(message, name.upper(), None)) for name in "dkrp"})
            return SimpleNamespace(**lower)
        raise DatasetError(f"topic {topic} of {self.path} holds no messages: camera {camera} has no calibration")

    def _read_transforms(self) -> TransformTree:
        tree = TransformTree()
        for topic, _, message in self.bag.messages(["/tf_static", "/tf"]):
            for found in message.transforms:
                time = None if topic == "/tf_static" else ros.seconds_of(found.header.stamp)
                tree.add(found.header.frame_id, found.child_frame_id, ros.transform_of(found), time)
        return tree

    def _find_classes(self) -> tuple[str, ...]:
        found: set[str] = set()
        for name, topic in self.bag.topics.items():
            if topic.kind in (*OBJECTS_3D, *OBJECTS_2D):
                for _, _, message in self.bag.messages([name], _LOOKED_AT):
                    found |= class_names_of(message, topic.kind)
        return tuple(sorted(found)) or KITTI_CLASSES

    def describe(self) -> list[str]:
        """Topics used and left out, frames and classes."""
        lines = [f"{len(self.ids)} frames, clouds of {self.points_topic} in frame {self.lidar_frame!r}"]
        for name, topic in self._camera_topics.items():
            count = len(self.index_of(topic).stamps_ns)
            lines.append(f"camera {name}: {count} images of {topic}, frame {self._frame_of(name)!r}")
        lines += [f"left out: {what}" for what in self.left_out]
        for name, topic_ in self.bag.topics.items():
            if topic_.kind in (*OBJECTS_3D, *OBJECTS_2D):
                lines.append(f"objects: {name}, {topic_.messages} messages of {topic_.kind}")
        return [*lines, f"classes {', '.join(self.class_names)}"]

    def _frame_of(self, camera: str) -> str:
        return str(self._infos[camera].header.frame_id)

    def frame(self, frame_id: str) -> Frame:
        """The frame of a stamp; cloud, images and labels are read when first asked for.

        Raises:
            DatasetError: no such frame, or a transform is missing.
        """
        if frame_id not in self._numbers:
            raise DatasetError(f"{self.path} has no cloud of stamp {frame_id}; its first is {self.ids[0]}")
        time = int(frame_id) * 1e-9
        images: dict[str, int] = {}
        cameras = []
        for name, topic in self._camera_topics.items():
            number = self._nearest(topic, int(frame_id))
            taken = time
            if number is not None:
                images[name], taken = number, self.index_of(topic).stamps_ns[number] * 1e-9
            cameras.append(self._camera(name, taken, time))
        moving = self.transforms.moves(self.lidar_frame)
        return Frame(
            frame_id,
            points=lambda: self._points(self._numbers[frame_id]),
            cameras=cameras,
            images=_BagImages(self, images),
            labels=(lambda: self.objects_3d(self.labels_topic, frame_id)) if self.labels_topic else None,
            timestamp=time,
            world_from_lidar=(
                self.transforms.root_from(self.lidar_frame, time) @ invert_rigid(self.lidar_turn) if moving else None
            ),
            sequence=self.path.stem,
        )

    def _camera(self, name: str, taken: float, time: float) -> Camera:
        camera_from_cloud = self.transforms.lookup(self._frame_of(name), taken, self.lidar_frame, time)
        return ros.camera_from_info(name, self._infos[name], camera_from_cloud @ invert_rigid(self.lidar_turn))

    def _nearest(self, topic: str, stamp: int) -> int | None:
        """Number of the message nearest in time; None if it is too far."""
        stamps = self.index_of(topic).stamps_ns
        if not len(stamps):
            return None
        place = int(np.clip(np.searchsorted(stamps, stamp), 1, max(len(stamps) - 1, 1)))
        near = [number for number in (place - 1, place) if number < len(stamps)]
        best = min(near, key=lambda number: abs(int(stamps[number]) - stamp))
        return best if abs(int(stamps[best]) - stamp) <= self.max_delay_s * 1e9 else None

    def _points(self, number: int) -> NDArray[np.float32]:
        message = self.bag.message(self.points_topic, self.index_of(self.points_topic), number)
        points = ros.points_from_cloud(message)
        points = points[np.isfinite(points).all(axis=1)]
        points[:, :3] = points[:, :3] @ self.lidar_turn[:3, :3].T.astype(np.float32)
        return points

    def has_image(self, frame_id: str, camera: str) -> bool:
        """Whether there is an image, without reading it."""
        return self._nearest(self._camera_topics[camera], int(frame_id)) is not None

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """One image of a camera."""
        topic = self._camera_topics[camera]
        return ros.pixels_from_image(self.bag.message(topic, self.index_of(topic), number))

    def objects_3d(self, topic: str, frame_id: str) -> Detections3D:
        """3D objects of a topic nearest to a frame, in its LiDAR frame; none if there is no message near.

        Raises:
            DatasetError: no transform leads from their frame to the cloud's.
        """
        number = self._nearest(topic, int(frame_id))
        if number is None:
            return Detections3D.empty(self.class_names)
        message = self.bag.message(topic, self.index_of(topic), number)
        found = detections_3d_of(message, self.bag.topics[topic].kind, self.class_names)
        source, time = str(message.header.frame_id), int(frame_id) * 1e-9
        own_from_source: FloatArray = np.eye(4)
        if source.lstrip("/") != self.lidar_frame.lstrip("/"):
            taken = float(self.index_of(topic).stamps_ns[number]) * 1e-9
            own_from_source = self.transforms.lookup(self.lidar_frame, time, source, taken)
        lidar_from_source = self.lidar_turn @ own_from_source
        velocities = found.velocities
        return Detections3D(
            transform_boxes(found.boxes, lidar_from_source),
            found.scores,
            found.labels,
            found.class_names,
            None if velocities is None else velocities @ lidar_from_source[:2, :2].T,
        )

    def objects_2d(self, topic: str, camera: str, frame_id: str) -> Detections2D | None:
        """2D objects of a topic nearest to a frame; None without a message near."""
        number = self._nearest(topic, int(frame_id))
        if number is None:
            return None
        message = self.bag.message(topic, self.index_of(topic), number)
        return detections_2d_of(message, self.bag.topics[topic].kind, self.class_names)

    def camera_of_topic(self, topic: str) -> str | None:
        """The camera that 2D objects of a topic belong to, by the frame of their first message or their namespace."""
        for _, _, message in self.bag.messages([topic], 1):
            frame_id = str(message.header.frame_id).lstrip("/")
            for name in self.camera_names:
                if self._frame_of(name).lstrip("/") == frame_id:
                    return name
        return next((n for n, t in self._camera_topics.items() if topic.startswith(_namespace(t) + "/")), None)


def _namespace(topic: str) -> str:
    """An image topic without its last parts that say that it is one."""
    parts = topic.split("/")
    while len(parts) > 1 and parts[-1] in _IMAGE_PARTS:
        parts.pop()
    return "/".join(parts)


class _BagImages(Mapping[str, NDArray[np.uint8]]):
    """Images of one frame, read when asked for."""

    def __init__(self, dataset: BagDataset, numbers: Mapping[str, int]) -> None:
        self._dataset, self._numbers = dataset, numbers

    def __getitem__(self, name: str) -> NDArray[np.uint8]:
        return self._dataset.image(name, self._numbers[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)

"""The detector kind ``topic:/NAME``: detections that a bag already holds, as a branch of a run."""

from __future__ import annotations

from collections.abc import Sequence

from lcf3d.datasets.bag import BagDataset
from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.formats.ros_objects import OBJECTS_2D, OBJECTS_3D
from lcf3d.frame import Frame
from lcf3d.structures import Detections2D, Detections3D


class LidarTopic:
    """3D objects of a topic.

    Args:
        topic: its name.
        class_names: classes to take.
        dataset: the bag.

    Raises:
        ConfigError: no such topic, or of another type.
        DatasetError: none of its classes is wanted.
    """

    def __init__(self, topic: str, class_names: Sequence[str], dataset: BagDataset) -> None:
        dataset.bag.require(topic, OBJECTS_3D)
        self.topic, self.dataset = topic, dataset
        self.class_names = tuple(class_names)
        _require_known(topic, class_names, dataset)

    def detect(self, frame: Frame) -> Detections3D:
        """The objects of a frame."""
        return self.dataset.objects_3d(self.topic, frame.id).with_classes(self.class_names)


class CameraTopics:
    """2D objects of one topic a camera.

    Args:
        topics: with commas.
        class_names: classes to take.
        dataset: the bag.

    Raises:
        ConfigError: no such topic, of another type, or of no camera of the bag.
    """

    def __init__(self, topics: str, class_names: Sequence[str], dataset: BagDataset) -> None:
        self.dataset, self.class_names = dataset, tuple(class_names)
        self._topics: dict[str, str] = {}
        for topic in topics.split(","):
            dataset.bag.require(topic, OBJECTS_2D)
            _require_known(topic, class_names, dataset)
            camera = dataset.camera_of_topic(topic)
            if camera is None and len(dataset.camera_names) == 1:
                camera = dataset.camera_names[0]
            if camera is None:
                raise ConfigError(
                    f"the objects of {topic} are of no camera of the bag: their frame and name are none of "
                    f"{', '.join(dataset.camera_names) or 'any'}"
                )
            self._topics[camera] = topic

    def sees(self, frame: Frame, camera: str) -> bool:
        """Whether there is a message near the frame: a camera that was late did not look."""
        topic = self._topics.get(camera)
        return topic is not None and self.dataset.objects_2d(topic, camera, frame.id) is not None

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The objects of one camera of a frame, clipped to its image."""
        found = self.dataset.objects_2d(self._topics[camera], camera, frame.id)
        if found is None:
            return Detections2D.empty(self.class_names)
        return found.with_classes(self.class_names).clipped(frame.camera(camera))


def _require_known(topic: str, class_names: Sequence[str], dataset: BagDataset) -> None:
    if not set(class_names) & set(dataset.class_names):
        raise DatasetError(
            f"the objects of {dataset.path} are of the classes {', '.join(dataset.class_names)}, none of which is "
            f"one of {', '.join(class_names)}"
        )


def lidar_topic(topic: str, class_names: Sequence[str], dataset: Dataset) -> LidarSource:
    """3D detections of a topic of the bag that is run.

    Args:
        topic: its name.
        class_names: classes to take.
        dataset: a bag.

    Raises:
        ConfigError: the dataset is no bag, or has no such topic.
    """
    return LidarTopic(topic, class_names, _bag(dataset))


def camera_topic(topic: str, class_names: Sequence[str], dataset: Dataset) -> CameraSource:
    """2D detections of topics of the bag that is run, with commas; see `lidar_topic`."""
    return CameraTopics(topic, class_names, _bag(dataset))


def _bag(dataset: Dataset) -> BagDataset:
    if not isinstance(dataset, BagDataset):
        raise ConfigError("topic:NAME names objects in a bag; run it on bag:FILE")
    return dataset

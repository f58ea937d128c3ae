"""Detections in ROS messages of any of the known types, told by the type."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lcf3d.formats import ros_messages as ros
from lcf3d.structures import Detections2D, Detections3D

CLOUDS = ("sensor_msgs/msg/PointCloud2",)
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
ROIS = "tier4_perception_msgs/msg/DetectedObjectsWithFeature"
OBJECTS_3D = (
    "vision_msgs/msg/Detection3DArray",
    "autoware_perception_msgs/msg/DetectedObjects",
    "autoware_auto_perception_msgs/msg/DetectedObjects",
)
OBJECTS_2D = ("vision_msgs/msg/Detection2DArray", ROIS)


def detections_3d_of(message: Any, kind: str, class_names: Sequence[str]) -> Detections3D:
    """3D detections of a message, in the frame of its header."""
    if kind.startswith("vision_msgs"):
        return ros.detections_3d_from_vision(message, class_names)
    return ros.detections_3d_from_autoware(message, class_names)


def detections_2d_of(message: Any, kind: str, class_names: Sequence[str]) -> Detections2D:
    """2D detections of a message, pixels of the image that its header belongs to."""
    if kind != ROIS:
        return ros.detections_2d_from_vision(message, class_names)
    lower = {name.lower(): i for i, name in enumerate(class_names)}
    lower.setdefault("bicycle", lower.get("cyclist", -1))
    names = {code: name for name, code in ros.AUTOWARE_LABELS.items() if name != "cyclist"}
    boxes, scores, labels = [], [], []
    for found in message.feature_objects:
        best = max(found.object.classification, key=lambda entry: float(entry.probability), default=None)
        label = -1 if best is None else lower.get(names.get(int(best.label), ""), -1)
        if label < 0:
            continue
        roi = found.feature.roi
        boxes.append([roi.x_offset, roi.y_offset, roi.x_offset + roi.width, roi.y_offset + roi.height])
        scores.append(float(found.object.existence_probability))
        labels.append(label)
    return Detections2D(
        np.array(boxes, dtype=np.float64).reshape(-1, 4),
        np.array(scores),
        np.array(labels, np.int64),
        tuple(class_names),
    )


def class_names_of(message: Any, kind: str) -> set[str]:
    """Names of the classes in a message of detections."""
    if kind.startswith("vision_msgs"):
        results = [result for found in message.detections for result in found.results]
        named = [getattr(result, "hypothesis", result) for result in results]
        return {str(getattr(one, "class_id", getattr(one, "id", ""))) for one in named}
    objects = [found.object for found in message.feature_objects] if kind == ROIS else message.objects
    names = {code: name for name, code in ros.AUTOWARE_LABELS.items() if name != "cyclist"}
    codes = {int(entry.label) for found in objects for entry in found.classification}
    return {names[code] for code in codes if code in names}

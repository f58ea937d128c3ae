"""3D detection objects and results of other libraries, from memory; see `lcf3d.formats.objects`.

Each has its own box: mmdet3d has z at the bottom face, OpenPCDet at the centre, nuScenes writes width before length and
a quaternion. Ours: geometric centre, length, width, height, yaw counter-clockwise about +z.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DetectorError
from lcf3d.geometry.boxes import canonical_from_mmdet3d, canonical_from_openpcdet, transform_boxes
from lcf3d.geometry.rotation import yaws_from_quaternions
from lcf3d.structures import Detections3D, FloatArray, IntArray


def from_mmdet3d(sample: Any, class_names: Sequence[str]) -> Detections3D:
    """From a ``Det3DDataSample`` of mmdetection3d 1.x, its ``pred_instances_3d``, or that as a dictionary.

    Args:
        sample: with ``bboxes_3d`` (LiDAR boxes or their numbers), ``scores_3d``, ``labels_3d``.
        class_names: ``model.dataset_meta["classes"]``.

    Raises:
        DetectorError: no such object, boxes in a camera's or a depth sensor's frame, or labels beyond the names.
    """
    instances = sample.get("pred_instances_3d", sample) if isinstance(sample, Mapping) else sample
    instances, what = getattr(instances, "pred_instances_3d", instances), "a Det3DDataSample of mmdet3d"
    boxes = field_of(instances, "bboxes_3d", what)
    kind = instances.get("box_type_3d", "LiDAR") if isinstance(instances, Mapping) else type(boxes).__name__
    if str(kind).startswith(("Camera", "Depth")):
        raise DetectorError(
            f"these boxes of mmdet3d are of type {kind}, not in the LiDAR frame; convert them with "
            "bboxes_3d.convert_to(Box3DMode.LIDAR, ...) first"
        )
    numbers = as_array(getattr(boxes, "tensor", boxes), columns=7)
    return _detections(
        canonical_from_mmdet3d(numbers),
        as_array(field_of(instances, "scores_3d", what)),
        as_array(field_of(instances, "labels_3d", what)),
        class_names,
        numbers[:, 7:9] if numbers.shape[1] >= 9 else None,
    )


def from_openpcdet(prediction: Mapping[str, Any], class_names: Sequence[str] | None = None) -> Detections3D:
    """From a prediction of OpenPCDet: what a model returns for one scan, or one record of a ``result.pkl``.

    Args:
        prediction: ``pred_boxes``, ``pred_scores``, ``pred_labels`` (from 1), or ``boxes_lidar``, ``score``, ``name``.
        class_names: ``cfg.CLASS_NAMES``; records with names do not need it.

    Raises:
        DetectorError: no such dictionary, or labels without names.
    """
    if isinstance(prediction, Mapping) and "boxes_lidar" in prediction:
        what = "a record of OpenPCDet's result.pkl"
        boxes = as_array(prediction["boxes_lidar"], columns=7)
        # of a scan without detections the names are zeros
        names = [str(name) for name in as_array(field_of(prediction, "name", what))] if len(boxes) else []
        if class_names is None:
            class_names = tuple(dict.fromkeys(names))
        labels = labels_of(names, class_names, what)
        scores = as_array(field_of(prediction, "score", what))
    else:
        what = "a prediction of OpenPCDet"
        boxes = as_array(field_of(prediction, "pred_boxes", what), columns=7)
        if class_names is None:
            raise DetectorError("predictions of OpenPCDet hold numbers of classes: give class_names=cfg.CLASS_NAMES")
        labels = as_array(field_of(prediction, "pred_labels", what)).astype(np.int64) - 1
        scores = as_array(field_of(prediction, "pred_scores", what))
    velocities = boxes[:, 7:9] if boxes.shape[1] >= 9 else None
    return _detections(canonical_from_openpcdet(boxes), scores, labels, class_names, velocities)


def from_nuscenes_boxes(
    boxes: Sequence[Any],
    class_names: Sequence[str] | None = None,
    lidar_from_source: FloatArray | None = None,
) -> Detections3D:
    """From a list of the nuScenes devkit's ``Box`` or ``DetectionBox``.

    The devkit's LiDAR has x to the right and y ahead, and its results are in the global frame: say how to get from
    there to the LiDAR frame that the scan is given in.

    Args:
        boxes: with ``center``, ``wlh``, ``orientation``, ``name``, ``score``, ``velocity``, or with ``translation``,
            ``size``, ``rotation``, ``detection_name``, ``detection_score``, ``velocity``.
        class_names: names to count labels by; those that occur, without it.
        lidar_from_source: (4, 4) rigid transform from the frame of the boxes; None if that is the scan's.

    Raises:
        DetectorError: an object of another kind, or a name that is not among ``class_names``.
    """
    what = "a Box of the nuScenes devkit"
    rows = [_nuscenes_row(box, what) for box in boxes]
    names = [row[4] for row in rows]
    class_names = tuple(dict.fromkeys(names)) if class_names is None else tuple(class_names)
    if not rows:
        return Detections3D.empty(class_names)
    centres, sizes, rotations, velocities = (np.array([row[i] for row in rows], dtype=np.float64) for i in range(4))
    numbers = np.column_stack([centres, sizes[:, [1, 0, 2]], yaws_from_quaternions(rotations)])
    if lidar_from_source is not None:
        numbers = transform_boxes(numbers, lidar_from_source)
        velocities = velocities @ lidar_from_source[:2, :2].T
    scores = np.array([row[5] for row in rows], dtype=np.float64)
    labels = labels_of(names, class_names, what)
    return _detections(numbers, scores, labels, class_names, None if np.isnan(velocities).all() else velocities)


def _nuscenes_row(box: Any, what: str) -> tuple[Any, Any, Any, Any, str, float]:
    """Centre, width-length-height, quaternion, horizontal velocity, name, score (1 where there is none)."""
    if hasattr(box, "translation"):
        score = float(getattr(box, "detection_score", 1.0))
        name = str(field_of(box, "detection_name", what))
        velocity = np.asarray(getattr(box, "velocity", (np.nan, np.nan)), dtype=np.float64)[:2]
        # -1 is the devkit's default
        return box.translation, box.size, box.rotation, velocity, name, 1.0 if score < 0 else score
    orientation = field_of(box, "orientation", what)
    rotation = np.asarray(getattr(orientation, "elements", orientation), dtype=np.float64)
    score = float(getattr(box, "score", np.nan))
    velocity = np.asarray(getattr(box, "velocity", (np.nan, np.nan)), dtype=np.float64)[:2]
    name = str(field_of(box, "name", what))
    return field_of(box, "center", what), box.wlh, rotation, velocity, name, 1.0 if np.isnan(score) else score


def labels_of(names: Sequence[str], class_names: Sequence[str], what: str) -> IntArray:
    """(N,) places of names among the classes.

    Raises:
        DetectorError: one is not among them.
    """
    index = {name: i for i, name in enumerate(class_names)}
    unknown = [name for name in names if name not in index]
    if unknown:
        raise DetectorError(f"{what} has the class {unknown[0]!r}, which is not among {', '.join(class_names)}")
    return np.array([index[name] for name in names], dtype=np.int64)


def field_of(source: Any, name: str, what: str) -> Any:
    """A field of an object or an entry of a dictionary.

    Raises:
        DetectorError: it has none of that name.
    """
    if isinstance(source, Mapping):
        if name in source:
            return source[name]
    elif hasattr(source, name):
        return getattr(source, name)
    raise DetectorError(f"expected {what} with {name!r}, got {type(source).__name__} without it")


def as_array(values: Any, columns: int | None = None) -> NDArray[Any]:
    """A tensor of any device and precision, an array or a list, as an array; an empty one of ``columns`` if given."""
    if hasattr(values, "detach"):
        values = values.detach().cpu()
        # numpy has no bfloat16
        values = (values.float() if str(getattr(values, "dtype", "")) == "torch.bfloat16" else values).numpy()
    array = np.asarray(values)
    return array.reshape(0, columns) if columns is not None and not array.size else array


def _detections(
    boxes: FloatArray, scores: Any, labels: Any, class_names: Sequence[str], velocities: Any
) -> Detections3D:
    labels = np.asarray(labels).astype(np.int64)
    if len(labels) and not 0 <= labels.min() <= labels.max() < len(class_names):
        raise DetectorError(
            f"labels go from {labels.min()} to {labels.max()}, but there are {len(class_names)} class names: "
            f"{', '.join(class_names)}"
        )
    return Detections3D(boxes, scores, labels, tuple(class_names), velocities)

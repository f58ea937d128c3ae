"""The two branches' detections made ready for the fusion: classes, scores, thresholds, cameras that are there."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from lcf3d.decisions import Decisions
from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.reasons import Reason
from lcf3d.structures import Camera, Detections, Detections2D, Detections3D, IntArray


class Branches(NamedTuple):
    """What takes part in the fusion of one frame.

    Attributes:
        lidar: 3D detections that take part, labels in the fusion's class list.
        lidar_index: (N,) their indices in the detections given.
        cameras: the cameras used.
        camera: for each of them its 2D detections that take part, labels in the fusion's class list.
        camera_index: for each of them their indices in the detections given.
        camera_start: for each of them the row of its first detection in the table of camera decisions.
        lidar_table: decisions so far on all 3D detections given.
        camera_table: decisions so far on all 2D detections given, camera after camera.
        notes: what was missing or left out.
    """

    lidar: Detections3D
    lidar_index: IntArray
    cameras: tuple[Camera, ...]
    camera: tuple[Detections2D, ...]
    camera_index: tuple[IntArray, ...]
    camera_start: tuple[int, ...]
    lidar_table: Decisions
    camera_table: Decisions
    notes: tuple[str, ...]


def by_camera_name(frame: Frame, camera: Mapping[str, Detections2D] | Detections2D) -> Mapping[str, Detections2D]:
    """2D detections by camera name; those of a frame with one camera may come without it.

    Raises:
        ConfigError: detections without a name, of a frame with several cameras or none.
    """
    if not isinstance(camera, Detections2D):
        return camera
    names = [c.name for c in frame.cameras]
    if len(names) != 1:
        raise ConfigError(
            f"frame {frame.id} has {len(names)} cameras: pass 2D detections by camera name, for example "
            f"{{{names[0] if names else 'front'!r}: detections}}"
        )
    return {names[0]: camera}


def prepare_branches(
    frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D], config: FusionConfig
) -> Branches:
    """Select what takes part in the fusion, and write down what does not and why.

    Raises:
        ConfigError: scores outside [0, 1], detections of a camera that the frame does not have, or a class list that
            shares no name with the classes to detect.
    """
    cameras = [c for c in frame.cameras if c.name in camera]
    unknown = sorted(set(camera) - {c.name for c in frame.cameras})
    if unknown:
        known = [c.name for c in frame.cameras]
        raise ConfigError(f"frame {frame.id}: detections of cameras {unknown}, but its cameras are {known}")
    notes = [
        f"camera {c.name} has no detections and was not used: nobody looked there"
        for c in frame.cameras
        if c.name not in camera
    ]
    names = config.class_names
    lidar_table = Decisions.blank(len(lidar))
    lidar_table.lidar[:] = np.arange(len(lidar))
    lidar_table.lidar_score[:] = lidar.scores
    threshold = config.lidar_score_threshold
    lidar_index = _select(lidar, names, threshold, lidar_table.reason, f"frame {frame.id}: LiDAR")
    lidar_index = _cap(lidar, lidar_index, lidar_table, config.max_boxes)

    given = [camera[view.name] for view in cameras]
    start = [0, *accumulate(map(len, given))]
    table, chosen = Decisions.blank(start[-1]), []
    for c, (view, found) in enumerate(zip(cameras, given, strict=True)):
        rows = slice(start[c], start[c + 1])
        table.camera[rows], table.detection[rows], table.camera_score[rows] = c, np.arange(len(found)), found.scores
        who = f"frame {frame.id}, camera {view.name}:"
        chosen.append(_select(found, names, config.camera_score_threshold, table.reason[rows], who))
    return Branches(
        lidar=_taken(lidar, lidar_index).with_classes(names),
        lidar_index=lidar_index,
        cameras=tuple(cameras),
        camera=tuple(_taken(found, index).with_classes(names) for found, index in zip(given, chosen, strict=True)),
        camera_index=tuple(chosen),
        camera_start=tuple(start[:-1]),
        lidar_table=lidar_table,
        camera_table=table,
        notes=tuple(notes),
    )


def _taken(detections: Detections, index: IntArray) -> Detections:
    """Those of ``index``, which rises; nothing is copied where it is all of them."""
    return detections if len(index) == len(detections) else detections[index]


def _select(
    detections: Detections2D | Detections3D, names: tuple[str, ...], threshold: float, reason: IntArray, who: str
) -> IntArray:
    """The indices of what takes part; into ``reason`` (N,) why the rest does not."""
    scores, boxes = detections.scores, detections.boxes
    if not len(scores):
        return np.zeros(0, dtype=np.int64)
    low, high = scores.min(), scores.max()
    if not (low >= 0 and high <= 1):  # NaN fails both
        raise ConfigError(
            f"{who} scores must lie in [0, 1], got {low:.4g} to {high:.4g}; "
            "fit a calibration with 'lcf3d calibrate' and pass it"
        )
    takes_part = scores > threshold
    if detections.class_names != names:
        if not set(detections.class_names) & set(names):
            raise ConfigError(
                f"{who} classes {list(detections.class_names)} share no name with the classes to detect "
                f"{list(names)}; map them with Detections.with_classes"
            )
        of_class = np.array([name in names for name in detections.class_names], dtype=bool)[detections.labels]
        reason[~of_class] = Reason.OTHER_CLASS.value
        takes_part &= of_class
    sides = boxes[:, 3:6] if isinstance(detections, Detections3D) else boxes[:, 2:] - boxes[:, :2]
    # one bad value spoils the sum, and NaN is not above 0
    if not (np.isfinite(boxes.sum()) and sides.min() > 0):
        valid = np.isfinite(boxes).all(axis=1) & (sides > 0).all(axis=1)
        reason[~valid] = Reason.INVALID.value
        takes_part &= valid
    return takes_part.nonzero()[0]


def _cap(lidar: Detections3D, index: IntArray, table: Decisions, max_boxes: int) -> IntArray:
    """The ``max_boxes`` highest-scoring of ``index``, in input order; the rest marked."""
    if len(index) <= max_boxes:
        return index
    order = np.argsort(-lidar.scores[index], kind="stable")
    table.reason[index[order[max_boxes:]]] = Reason.TOO_MANY.value
    kept: IntArray = np.sort(index[order[:max_boxes]])
    return kept

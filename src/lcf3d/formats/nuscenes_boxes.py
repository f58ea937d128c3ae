"""Boxes of many samples in the nuScenes global frame, and their way to the canonical LiDAR frame and back.

nuScenes writes sizes as width, length, height and rotations as quaternions (w, x, y, z). Official metrics are computed
on these boxes as they are; nothing passes through the LiDAR frame unless asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lcf3d.errors import FormatError, ShapeError
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.geometry.rotation import quaternions_from_yaws, transform_points, yaws_from_quaternions
from lcf3d.structures import NUSCENES_CLASSES, Detections3D, FloatArray, IntArray

NUSCENES_ATTRIBUTES = (
    "pedestrian.moving",
    "pedestrian.sitting_lying_down",
    "pedestrian.standing",
    "cycle.with_rider",
    "cycle.without_rider",
    "vehicle.moving",
    "vehicle.parked",
    "vehicle.stopped",
)
"""Names that attribute indices stand for; -1 stands for none."""

_CLASSES = frozenset(NUSCENES_CLASSES)
# first part of the attributes that a class may have
_KIND_OF_CLASS = {
    **dict.fromkeys(NUSCENES_CLASSES, "vehicle"),
    "pedestrian": "pedestrian",
    "motorcycle": "cycle",
    "bicycle": "cycle",
    "traffic_cone": "",
    "barrier": "",
}

MOVING_SPEED = 0.2
"""Speed in m/s above which a default attribute says that an object moves."""


@dataclass(frozen=True, eq=False)
class GlobalBoxes:
    """Boxes of many samples in the global frame, as parallel arrays.

    Attributes:
        sample_tokens: tokens of the samples, also of those without a box.
        samples: (N,) index of each box's sample in ``sample_tokens``.
        translations: (N, 3) centres in metres.
        sizes: (N, 3) width, length, height in metres.
        rotations: (N, 4) quaternions (w, x, y, z).
        velocities: (N, 2) m/s along global x and y, NaN where unknown.
        labels: (N,) indices into `NUSCENES_CLASSES`.
        scores: (N,) confidences; -1 in ground truth.
        attributes: (N,) indices into `NUSCENES_ATTRIBUTES`, -1 for none.
        point_counts: (N,) LiDAR and radar points in each box; -1 where unknown, as in every prediction.
    """

    sample_tokens: tuple[str, ...]
    samples: IntArray
    translations: FloatArray
    sizes: FloatArray
    rotations: FloatArray
    velocities: FloatArray
    labels: IntArray
    scores: FloatArray
    attributes: IntArray
    point_counts: IntArray

    def __post_init__(self) -> None:
        n = len(self.samples)
        for name, columns in (("translations", 3), ("sizes", 3), ("rotations", 4), ("velocities", 2)):
            if getattr(self, name).shape != (n, columns):
                raise ShapeError(
                    f"GlobalBoxes.{name} must have shape ({n}, {columns}), got {getattr(self, name).shape}"
                )
        for name in ("labels", "scores", "attributes", "point_counts"):
            if getattr(self, name).shape != (n,):
                raise ShapeError(f"GlobalBoxes.{name} must have shape ({n},), got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: Any) -> GlobalBoxes:
        """The boxes selected by a slice, an integer array or a boolean mask; all sample tokens stay."""
        return GlobalBoxes(
            self.sample_tokens,
            self.samples[index],
            self.translations[index],
            self.sizes[index],
            self.rotations[index],
            self.velocities[index],
            self.labels[index],
            self.scores[index],
            self.attributes[index],
            self.point_counts[index],
        )

    def in_samples(self, sample_tokens: Sequence[str], sample: int) -> GlobalBoxes:
        """The same boxes, all as boxes of ``sample_tokens[sample]``."""
        return replace(self, sample_tokens=tuple(sample_tokens), samples=np.full(len(self), sample, dtype=np.int64))

    def numbered(self, sample_tokens: Sequence[str]) -> GlobalBoxes:
        """The same boxes, in their order, as boxes of other samples; ``samples`` of those that are of none is -1."""
        position = {token: i for i, token in enumerate(sample_tokens)}
        numbers = np.array([position.get(token, -1) for token in self.sample_tokens], dtype=np.int64)
        return replace(self, sample_tokens=tuple(sample_tokens), samples=numbers[self.samples])


def detections_from_global(boxes: GlobalBoxes, lidar_from_global: FloatArray) -> Detections3D:
    """Boxes of one sample in its canonical LiDAR frame.

    The heading and the velocity are projected along the global vertical axis onto the LiDAR's horizontal plane;
    `global_from_detections` undoes that exactly, so that centre, size, yaw and velocity, all that the official metrics
    read, survive the way there and back up to rounding. A box's own pitch and roll do not.

    Args:
        boxes: boxes of one sample.
        lidar_from_global: (4, 4) canonical LiDAR coordinates from global ones.
    """
    planar = lidar_from_global[:2, :2]
    yaws = yaws_from_quaternions(boxes.rotations)
    heading = np.stack([np.cos(yaws), np.sin(yaws)], axis=1) @ planar.T
    canonical = np.empty((len(boxes), 7))
    canonical[:, :3] = transform_points(boxes.translations, lidar_from_global)
    canonical[:, 3:6] = boxes.sizes[:, [1, 0, 2]]
    canonical[:, 6] = wrap_angle(np.arctan2(heading[:, 1], heading[:, 0]))
    names = np.array([*NUSCENES_ATTRIBUTES, ""])
    return Detections3D(
        canonical, boxes.scores, boxes.labels, NUSCENES_CLASSES, boxes.velocities @ planar.T, names[boxes.attributes]
    )


def global_from_detections(
    detections: Mapping[str, Detections3D],
    global_from_lidar: Mapping[str, FloatArray],
    sample_tokens: Sequence[str] | None = None,
) -> GlobalBoxes:
    """Detections of many samples in the global frame; the inverse of `detections_from_global`.

    Boxes are written upright. Attributes that are missing, or are none of the class, become `default_attributes`.
    Classes other than the ten of nuScenes are dropped.

    Args:
        detections: detections in the canonical LiDAR frame by sample token.
        global_from_lidar: (4, 4) global coordinates from canonical LiDAR ones by sample token.
        sample_tokens: every token to list (default: those of ``detections``).

    Raises:
        FormatError: detections of a sample that ``sample_tokens`` does not list, or of no nuScenes class at all.
    """
    tokens = tuple(detections if sample_tokens is None else sample_tokens)
    index = {token: i for i, token in enumerate(tokens)}
    unknown = [token for token in detections if token not in index]
    if unknown:
        raise FormatError(f"detections of sample {unknown[0]} (and {len(unknown) - 1} more) are not of this dataset")
    foreign = [names for names in {found.class_names for found in detections.values()} if not set(names) & _CLASSES]
    if foreign:
        raise FormatError(
            f"none of the classes {', '.join(foreign[0])} is a nuScenes class; map them with Detections3D.with_classes"
        )
    parts = [
        _global_from_one(tokens, index[token], found.with_classes(NUSCENES_CLASSES), global_from_lidar[token])
        for token, found in detections.items()
    ]
    return concatenate_global(tokens, parts)


def concatenate_global(sample_tokens: Sequence[str], parts: Sequence[GlobalBoxes]) -> GlobalBoxes:
    """All boxes of ``parts``, whose sample indices all refer to ``sample_tokens``, one after the other."""
    tokens = tuple(sample_tokens)
    if not parts:
        return empty_global(tokens)
    names = [name for name in GlobalBoxes.__dataclass_fields__ if name != "sample_tokens"]
    return GlobalBoxes(tokens, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def empty_global(sample_tokens: Sequence[str]) -> GlobalBoxes:
    """No boxes, for the given samples."""
    none, no_labels = np.zeros(0), np.zeros(0, np.int64)
    return GlobalBoxes(
        tuple(sample_tokens),
        no_labels,
        none.reshape(0, 3),
        none.reshape(0, 3),
        none.reshape(0, 4),
        none.reshape(0, 2),
        no_labels,
        none,
        no_labels,
        no_labels,
    )


def default_attributes(labels: IntArray, velocities: FloatArray) -> IntArray:
    """(N,) the likeliest attribute of each class, where a detector gives none.

    Known motion decides (faster than `MOVING_SPEED`: moving, with a rider). Of unknown motion, pedestrians move, buses
    move, other vehicles are parked and cycles have no rider, which are the most frequent values in the training data
    and the convention of common detectors. Cones and barriers have no attribute.

    Args:
        labels: (N,) indices into `NUSCENES_CLASSES`.
        velocities: (N, 2) m/s, NaN where unknown.
    """
    speed = np.hypot(velocities[:, 0], velocities[:, 1])
    moving, known = speed > MOVING_SPEED, np.isfinite(speed)
    names = np.array(NUSCENES_CLASSES)[labels]
    attribute = {name: i for i, name in enumerate(NUSCENES_ATTRIBUTES)}
    pedestrian, bus = names == "pedestrian", names == "bus"
    cycle = (names == "bicycle") | (names == "motorcycle")
    vehicle = ~pedestrian & ~cycle & (names != "traffic_cone") & (names != "barrier")
    result = np.full(len(labels), -1, dtype=np.int64)
    result[vehicle] = attribute["vehicle.parked"]
    result[bus & known] = attribute["vehicle.stopped"]
    result[(vehicle & moving) | (bus & ~known)] = attribute["vehicle.moving"]
    result[pedestrian] = attribute["pedestrian.moving"]
    result[pedestrian & known & ~moving] = attribute["pedestrian.standing"]
    result[cycle] = attribute["cycle.without_rider"]
    result[cycle & moving] = attribute["cycle.with_rider"]
    return result


def _global_from_one(
    tokens: tuple[str, ...], sample: int, detections: Detections3D, global_from_lidar: FloatArray
) -> GlobalBoxes:
    """One sample's detections in the global frame."""
    n = len(detections)
    # the same planar map as in detections_from_global, inverted, so that headings and velocities come back exactly
    planar = np.linalg.inv(global_from_lidar[:3, :3].T[:2, :2])
    yaw = detections.boxes[:, 6]
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) @ planar.T
    velocities = np.full((n, 2), np.nan)
    if detections.velocities is not None:
        velocities = detections.velocities @ planar.T
    attributes = default_attributes(detections.labels, velocities)
    if detections.attributes is not None:
        index = {name: i for i, name in enumerate(NUSCENES_ATTRIBUTES)}
        given = np.array([index.get(str(name), -1) for name in detections.attributes], dtype=np.int64).reshape(n)
        # a camera may have changed the class since: a pedestrian is not parked
        kinds = np.array([_KIND_OF_CLASS[name] for name in NUSCENES_CLASSES])[detections.labels]
        kinds_given = np.array([*(name.split(".")[0] for name in NUSCENES_ATTRIBUTES), "none"])[given]
        attributes = np.where(kinds_given == kinds, given, attributes)
    return GlobalBoxes(
        tokens,
        np.full(n, sample, dtype=np.int64),
        transform_points(detections.boxes[:, :3], global_from_lidar),
        detections.boxes[:, [4, 3, 5]],
        quaternions_from_yaws(np.arctan2(heading[:, 1], heading[:, 0])),
        velocities,
        detections.labels,
        detections.scores,
        attributes,
        np.full(n, -1, dtype=np.int64),
    )


def split_by_sample(boxes: GlobalBoxes) -> dict[str, GlobalBoxes]:
    """The boxes of each sample by its token, in order; each part lists its own token only."""
    order = np.argsort(boxes.samples, kind="stable")
    ends = np.cumsum(np.bincount(boxes.samples, minlength=len(boxes.sample_tokens)))
    result = {}
    for i, token in enumerate(boxes.sample_tokens):
        part = boxes[order[(ends[i - 1] if i else 0) : ends[i]]]
        result[token] = part.in_samples((token,), 0)
    return result

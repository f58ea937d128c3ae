"""The frozen array structures that every part of lcf3d speaks.

Conventions (all of the package, converted only at its edges, see ``lcf3d.geometry.boxes``):

- 3D box ``(x, y, z, length, width, height, yaw)``: geometric centre, metres and radians, LiDAR frame with x forward,
  y left, z up; yaw counter-clockwise about +z from +x, in [-pi, pi).
- 2D box ``(x1, y1, x2, y2)`` in pixels.
- Scores in [0, 1] unless a calibration follows; labels are indices into ``class_names``.
- Transforms are 4x4 and named ``target_from_source``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcf3d.converters import Converters2D, Converters3D
from lcf3d.distortion import Distortion, Field, checked_lens, field_of
from lcf3d.errors import ConfigError, ShapeError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Detections = TypeVar("Detections", "Detections2D", "Detections3D")

KITTI_CLASSES = ("Car", "Pedestrian", "Cyclist")
NUSCENES_CLASSES = (
    "car",
    "truck",
    "bus",
    "trailer",
    "construction_vehicle",
    "pedestrian",
    "motorcycle",
    "bicycle",
    "traffic_cone",
    "barrier",
)
# the categories that Argoverse 2's detection benchmark evaluates
# fmt: off
ARGOVERSE_CLASSES = (
    "ARTICULATED_BUS", "BICYCLE", "BICYCLIST", "BOLLARD", "BOX_TRUCK", "BUS", "CONSTRUCTION_BARREL",
    "CONSTRUCTION_CONE", "DOG", "LARGE_VEHICLE", "MESSAGE_BOARD_TRAILER", "MOBILE_PEDESTRIAN_CROSSING_SIGN",
    "MOTORCYCLE", "MOTORCYCLIST", "PEDESTRIAN", "REGULAR_VEHICLE", "SCHOOL_BUS", "SIGN", "STOP_SIGN", "STROLLER",
    "TRUCK", "TRUCK_CAB", "VEHICULAR_TRAILER", "WHEELCHAIR", "WHEELED_DEVICE", "WHEELED_RIDER",
)
# fmt: on


def checked_array(value: ArrayLike, dtype: Any, shape: tuple[int | None, ...], what: str) -> NDArray[Any]:
    """``value`` as a read-only array of ``dtype``; ``None`` in ``shape`` is any length; empty input is accepted."""
    if hasattr(value, "detach"):
        # a tensor of torch, which may be on a GPU and want a gradient
        value = value.detach().cpu().numpy()
    if type(value) is np.ndarray and value.flags.owndata and not value.flags.writeable and value.dtype == dtype:
        # nobody can change it
        array: NDArray[Any] = value
    else:
        array = np.array(value, dtype=dtype)
    if array.size == 0 and array.ndim <= len(shape):
        array = array.reshape([0 if n is None else n for n in shape])
    wrong = array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=False))
    if wrong:
        expected = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise ShapeError(f"{what} must have shape {expected}, got {array.shape}")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera, with its pose at the moment of the LiDAR scan.

    Attributes:
        name: unique within a frame, for example ``left`` or ``CAM_FRONT``.
        projection: (3, 4) ``P``, homogeneous pixels from camera coordinates (x right, y down, z forward).
        camera_from_lidar: (4, 4) camera coordinates from LiDAR coordinates.
        width: image width in pixels.
        height: image height in pixels.
        distortion: of the lens; None (and what a lens of zeros becomes) for a pinhole camera. ``projection`` is then
            the camera's without it, and pixels, those of 2D detections too, are the ones of the image as it was taken.
        delay: seconds from the scan to the image; boxes are moved on by their velocities for as long.
    """

    name: str
    projection: FloatArray
    camera_from_lidar: FloatArray
    width: int
    height: int
    distortion: Distortion | None = None
    delay: float = 0.0
    pixels_from_lidar: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        projection = checked_array(self.projection, np.float64, (3, 4), "Camera.projection")
        transform = checked_array(self.camera_from_lidar, np.float64, (4, 4), "Camera.camera_from_lidar")
        if not (np.isfinite(projection).all() and np.isfinite(transform).all()):
            raise ConfigError(f"calibration of camera {self.name!r} holds NaN or infinite values")
        if self.width <= 0 or self.height <= 0:
            raise ConfigError(f"camera {self.name!r} needs a positive image size, got {self.width} x {self.height}")
        object.__setattr__(self, "projection", projection)
        object.__setattr__(self, "camera_from_lidar", transform)
        pixels_from_lidar = projection @ transform
        pixels_from_lidar.setflags(write=False)
        object.__setattr__(self, "pixels_from_lidar", pixels_from_lidar)
        lens = checked_lens(self.distortion, projection[:, :3], self.width, self.height, self.name)
        object.__setattr__(self, "distortion", lens)

    @cached_property
    def lens_field(self) -> Field | None:
        """Where the lens sees; None for a pinhole camera, which sees all that is in front of it."""
        if self.distortion is None:
            return None
        return field_of(self.distortion, self.intrinsics, self.width, self.height, self.name)

    @property
    def intrinsics(self) -> FloatArray:
        """(3, 3) camera matrix ``K``, the left part of ``projection``."""
        return self.projection[:, :3]


@dataclass(frozen=True, eq=False)
class InstanceMask:
    """One object's pixels, stored only inside its bounding rectangle.

    Attributes:
        x: left-most image column that ``bitmap`` covers.
        y: top-most image row that ``bitmap`` covers.
        bitmap: (h, w) bool.
    """

    x: int
    y: int
    bitmap: BoolArray

    @classmethod
    def from_image(cls, mask: NDArray[Any]) -> InstanceMask:
        """From a full (H, W) mask of the image; any non-zero pixel belongs to the object."""
        full = np.asarray(mask) != 0
        if full.ndim != 2:
            raise ShapeError(f"an instance mask must have shape (H, W), got {full.shape}")
        rows, columns = np.flatnonzero(full.any(axis=1)), np.flatnonzero(full.any(axis=0))
        if not len(rows):
            return cls(0, 0, np.zeros((0, 0), dtype=bool))
        y, x = int(rows[0]), int(columns[0])
        return cls(x, y, full[y : rows[-1] + 1, x : columns[-1] + 1].copy())

    def contains(self, pixels: NDArray[Any]) -> BoolArray:
        """(N,) whether each of the (N, 2) pixel positions (u, v) falls on the object."""
        u = np.floor(pixels[:, 0]).astype(np.int64) - self.x
        v = np.floor(pixels[:, 1]).astype(np.int64) - self.y
        height, width = self.bitmap.shape
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        result = np.zeros(len(pixels), dtype=bool)
        result[inside] = self.bitmap[v[inside], u[inside]]
        return result


@dataclass(frozen=True, eq=False)
class Detections3D(Converters3D):
    """3D boxes of one frame with scores and labels, from a LiDAR detector, a fusion or an annotator.

    Attributes:
        boxes: (N, 7) float64 ``(x, y, z, length, width, height, yaw)``, geometric centre, LiDAR frame.
        scores: (N,) float64.
        labels: (N,) int64 indices into ``class_names``.
        class_names: names of the classes that ``labels`` index.
        velocities: (N, 2) m/s along LiDAR x and y, NaN where unknown; or None.
        attributes: (N,) nuScenes attribute names, empty where unknown; or None.
    """

    boxes: FloatArray
    scores: FloatArray
    labels: IntArray
    class_names: tuple[str, ...]
    velocities: FloatArray | None = None
    attributes: NDArray[np.str_] | None = None

    def __post_init__(self) -> None:
        _validate(self, (None, 7))
        n = len(self.boxes)
        for name, shape in (("velocities", (n, 2)), ("attributes", (n,))):
            value = getattr(self, name)
            if value is not None:
                dtype = np.float64 if name == "velocities" else np.str_
                object.__setattr__(self, name, checked_array(value, dtype, shape, f"Detections3D.{name}"))

    @classmethod
    def trusted(
        cls,
        boxes: FloatArray,
        scores: FloatArray,
        labels: IntArray,
        class_names: tuple[str, ...],
        velocities: FloatArray | None = None,
        attributes: NDArray[np.str_] | None = None,
    ) -> Detections3D:
        """As the constructor, for new arrays known to be right: nothing is copied or checked, they become read-only."""
        columns = {"boxes": boxes, "scores": scores, "labels": labels, "class_names": class_names}
        return _trusted(cls, **columns, velocities=velocities, attributes=attributes)

    @classmethod
    def empty(cls, class_names: Sequence[str]) -> Detections3D:
        """No detections, for the given classes."""
        return cls(np.zeros((0, 7)), np.zeros(0), np.zeros(0, np.int64), tuple(class_names))

    @classmethod
    def concatenate(cls, parts: Sequence[Detections3D]) -> Detections3D:
        """All detections of ``parts`` (at least one, of equal ``class_names``) one after the other."""
        _require_equal_classes(parts)
        velocities = attributes = None
        if any(p.velocities is not None for p in parts):
            velocities = np.concatenate(
                [np.full((len(p), 2), np.nan) if p.velocities is None else p.velocities for p in parts]
            )
        if any(p.attributes is not None for p in parts):
            attributes = np.concatenate([np.full(len(p), "") if p.attributes is None else p.attributes for p in parts])
        return cls.trusted(
            np.concatenate([p.boxes for p in parts]),
            np.concatenate([p.scores for p in parts]),
            np.concatenate([p.labels for p in parts]),
            parts[0].class_names,
            velocities,
            attributes,
        )

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, index: Any) -> Detections3D:
        """Those selected by a slice, an integer array or a boolean mask."""
        boxes = self.boxes[index]
        # the constructor says what is wrong with another kind of index
        create = Detections3D.trusted if boxes.ndim == 2 else Detections3D
        return create(
            boxes,
            self.scores[index],
            self.labels[index],
            self.class_names,
            None if self.velocities is None else self.velocities[index],
            None if self.attributes is None else self.attributes[index],
        )

    def with_classes(self, class_names: Sequence[str], mapping: Mapping[str, str] | None = None) -> Detections3D:
        """The same detections with labels of ``class_names``; those of classes that map to none are dropped.

        ``mapping`` goes from own name to new name; names missing from it (or all, without it) keep their name.
        """
        if mapping is None and tuple(class_names) == self.class_names:
            return self
        kept, labels = _relabel(self.labels, self.class_names, class_names, mapping)
        return with_columns(self[kept], labels=labels, class_names=tuple(class_names))


@dataclass(frozen=True, eq=False)
class Detections2D(Converters2D):
    """2D boxes of one image with scores, labels and, if the detector has them, instance masks.

    Attributes:
        boxes: (N, 4) float64 ``(x1, y1, x2, y2)`` pixels.
        scores: (N,) float64.
        labels: (N,) int64 indices into ``class_names``.
        class_names: names of the classes that ``labels`` index.
        masks: one `InstanceMask` (or None) a box, or None for a detector without masks.
    """

    boxes: FloatArray
    scores: FloatArray
    labels: IntArray
    class_names: tuple[str, ...]
    masks: tuple[InstanceMask | None, ...] | None = None

    def __post_init__(self) -> None:
        _validate(self, (None, 4))
        if self.masks is not None:
            object.__setattr__(self, "masks", tuple(self.masks))
            if len(self.masks) != len(self.boxes):
                raise ShapeError(f"Detections2D has {len(self.boxes)} boxes but {len(self.masks)} masks")

    @classmethod
    def trusted(
        cls,
        boxes: FloatArray,
        scores: FloatArray,
        labels: IntArray,
        class_names: tuple[str, ...],
        masks: tuple[InstanceMask | None, ...] | None = None,
    ) -> Detections2D:
        """As the constructor, for new arrays known to be right: nothing is copied or checked, they become read-only."""
        return _trusted(cls, boxes=boxes, scores=scores, labels=labels, class_names=class_names, masks=masks)

    @classmethod
    def empty(cls, class_names: Sequence[str]) -> Detections2D:
        """No detections, for the given classes."""
        return cls(np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64), tuple(class_names))

    @classmethod
    def concatenate(cls, parts: Sequence[Detections2D]) -> Detections2D:
        """All detections of ``parts`` (at least one, of equal ``class_names``) one after the other."""
        _require_equal_classes(parts)
        masks: tuple[InstanceMask | None, ...] | None = None
        if any(p.masks is not None for p in parts):
            masks = tuple(m for p in parts for m in (p.masks if p.masks is not None else (None,) * len(p)))
        return cls.trusted(
            np.concatenate([p.boxes for p in parts]),
            np.concatenate([p.scores for p in parts]),
            np.concatenate([p.labels for p in parts]),
            parts[0].class_names,
            masks,
        )

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, index: Any) -> Detections2D:
        """Those selected by a slice, an integer array or a boolean mask."""
        masks = self.masks
        if masks is not None:
            masks = tuple(masks[i] for i in np.arange(len(masks))[index])
        boxes = self.boxes[index]
        create = Detections2D.trusted if boxes.ndim == 2 else Detections2D
        return create(boxes, self.scores[index], self.labels[index], self.class_names, masks)

    def clipped(self, camera: Camera) -> Detections2D:
        """The same with boxes cut to the camera's image."""
        limits = np.array([camera.width, camera.height, camera.width, camera.height], dtype=np.float64)
        return with_columns(self, boxes=np.minimum(np.maximum(self.boxes, 0), limits))

    def with_classes(self, class_names: Sequence[str], mapping: Mapping[str, str] | None = None) -> Detections2D:
        """The same detections with labels of ``class_names``; those of classes that map to none are dropped.

        ``mapping`` goes from own name to new name; names missing from it (or all, without it) keep their name.
        """
        if mapping is None and tuple(class_names) == self.class_names:
            return self
        kept, labels = _relabel(self.labels, self.class_names, class_names, mapping)
        return with_columns(self[kept], labels=labels, class_names=tuple(class_names))


def _trusted(kind: type[Detections], **columns: Any) -> Detections:
    """Detections of arrays that are known to be right, see `Detections3D.trusted`."""
    made = object.__new__(kind)
    made.__dict__.update(columns)
    _freeze(columns)
    return made


def _freeze(columns: dict[str, Any]) -> None:
    """Make arrays read-only."""
    for column in columns.values():
        if type(column) is np.ndarray:
            column.setflags(write=False)


def with_columns(detections: Detections, **columns: Any) -> Detections:
    """The same detections with other columns, as many and of the same types; they become read-only, not copied."""
    made = object.__new__(type(detections))
    made.__dict__.update(detections.__dict__)
    made.__dict__.update(columns)
    _freeze(columns)
    return made


def _validate(detections: Detections2D | Detections3D, box_shape: tuple[int | None, int]) -> None:
    """Convert and check the parallel arrays of a detections object in place."""
    kind = type(detections).__name__
    boxes = checked_array(detections.boxes, np.float64, box_shape, f"{kind}.boxes")
    n = len(boxes)
    scores = checked_array(detections.scores, np.float64, (None,), f"{kind}.scores")
    labels = checked_array(detections.labels, np.int64, (None,), f"{kind}.labels")
    if len(scores) != n or len(labels) != n:
        raise ShapeError(f"{kind} has {n} boxes but {len(scores)} scores and {len(labels)} labels")
    class_names = tuple(detections.class_names)
    if n and (labels.min() < 0 or labels.max() >= len(class_names)):
        raise ShapeError(
            f"{kind}.labels must index its {len(class_names)} class names, got {labels.min()} to {labels.max()}"
        )
    for name, value in (("boxes", boxes), ("scores", scores), ("labels", labels), ("class_names", class_names)):
        object.__setattr__(detections, name, value)


def _require_equal_classes(parts: Sequence[Detections2D] | Sequence[Detections3D]) -> None:
    names = {part.class_names for part in parts}
    if len(names) != 1:
        raise ConfigError(f"detections to join must share one class list, got {sorted(names)}; use with_classes()")


def _relabel(
    labels: IntArray, old: Sequence[str], new: Sequence[str], mapping: Mapping[str, str] | None
) -> tuple[BoolArray, IntArray]:
    """Mask of the detections kept, and their labels in the ``new`` class list."""
    index = {name: i for i, name in enumerate(new)}
    table = np.array([index.get((mapping or {}).get(name, name), -1) for name in old], dtype=np.int64)
    relabelled = table[labels] if len(labels) else labels
    kept = relabelled >= 0
    return kept, relabelled[kept]

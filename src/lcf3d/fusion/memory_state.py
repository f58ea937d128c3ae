"""What the memory keeps between frames: tracks as parallel arrays in a fixed (world) frame, and who looked last."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from lcf3d.fusion.memory_config import ClassColumns, MemoryConfig
from lcf3d.geometry.boxes import HEIGHT, LENGTH, YAW, Z
from lcf3d.structures import Camera, FloatArray, Frame, IntArray


@dataclass(frozen=True, eq=False)
class Tracks:
    """T tracks, one row each; lengths in metres, angles in radians, times in seconds, all in the world frame.

    Attributes:
        ids: (T,) numbers that are never used again within a sequence.
        labels: (T,) class.
        positions: (T, 2) x and y of the centre.
        velocities: (T, 2) m/s.
        position_cov: (T, 3) of the filter along either axis: variance of position, covariance, variance of velocity.
        yaws: (T,) heading.
        yaw_rates: (T,) rad/s.
        yaw_cov: (T, 3) variance of yaw, covariance, variance of yaw rate.
        bottoms: (T,) height of the bottom face.
        sizes: (T, 3) length, width, height.
        size_weights: (T,) how much the past counts in ``sizes``.
        support: (T,) what past frames say for the object, see `memory_evidence.grown_support`.
        last_support: (T,) what the last frame said, not yet part of ``support``.
        hits: (T,) number of frames that saw the object.
        born: (T,) time of the first.
        seen: (T,) time of the last.
    """

    ids: IntArray
    labels: IntArray
    positions: FloatArray
    velocities: FloatArray
    position_cov: FloatArray
    yaws: FloatArray
    yaw_rates: FloatArray
    yaw_cov: FloatArray
    bottoms: FloatArray
    sizes: FloatArray
    size_weights: FloatArray
    support: FloatArray
    last_support: FloatArray
    hits: IntArray
    born: FloatArray
    seen: FloatArray

    @classmethod
    def empty(cls) -> Tracks:
        """No tracks."""
        none = np.zeros(0)
        whole = np.zeros(0, dtype=np.int64)
        pair, triple = np.zeros((0, 2)), np.zeros((0, 3))
        return cls(
            whole,
            whole,
            pair,
            pair,
            triple,
            none,
            none,
            triple,
            none,
            triple,
            none,
            none,
            none,
            whole,
            none,
            none,
        )

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: Any) -> Tracks:
        """Those selected by a slice, an integer array or a boolean mask."""
        return Tracks(*(getattr(self, column.name)[index] for column in fields(self)))

    def joined(self, other: Tracks) -> Tracks:
        """These and then the others."""
        if not len(self) or not len(other):
            return self if len(self) else other
        return Tracks(*(np.concatenate([getattr(self, c.name), getattr(other, c.name)]) for c in fields(self)))

    def updated(self, rows: IntArray, new: Tracks) -> Tracks:
        """These with ``rows`` replaced by those of ``new``."""
        columns = []
        for column in fields(self):
            values = getattr(self, column.name).copy()
            values[rows] = getattr(new, column.name)
            columns.append(values)
        return Tracks(*columns)

    @property
    def boxes(self) -> FloatArray:
        """(T, 7) canonical boxes in the world frame."""
        boxes = np.empty((len(self), 7))
        boxes[:, :2] = self.positions
        boxes[:, Z] = self.bottoms + self.sizes[:, 2] / 2
        boxes[:, LENGTH : HEIGHT + 1] = self.sizes
        boxes[:, YAW] = self.yaws
        return boxes


@dataclass(frozen=True, eq=False)
class Memory:
    """What is kept from frame to frame; of bounded size.

    Attributes:
        tracks: the objects.
        time_s: when the last frame was.
        world_from_lidar: (4, 4) where the sensor was then. The memory's world is the LiDAR frame of its first frame,
            so that z is up whatever the axes of the dataset's world.
        world_from_dataset: (4, 4) from the fixed frame of the dataset's poses; None where it has none.
        ego_velocity: (3,) the sensor's, ahead and left, m/s, and yaw rate, where it was estimated from the objects;
            None where the pose was given or nothing is known yet.
        cameras: what looked then; empty for nothing but the LiDAR.
        next_id: number of the next track.
        class_names: the classes that labels index.
        sequence: the drive it is of.
        config: the settings it was made with.
        classes: the same as one column a class.
    """

    tracks: Tracks
    time_s: float
    world_from_lidar: FloatArray
    world_from_dataset: FloatArray | None
    ego_velocity: FloatArray | None
    cameras: tuple[Camera, ...]
    next_id: int
    class_names: tuple[str, ...]
    sequence: str | None
    config: MemoryConfig
    classes: ClassColumns


class Moment(NamedTuple):
    """A frame that joins the memory.

    Attributes:
        frame: its scan is read only where a predicted box is tested for free space.
        time_s: when.
        world_from_lidar: (4, 4) where, given or estimated.
        ego_velocity: (3,) see `Memory`.
        cameras: what looked.
    """

    frame: Frame
    time_s: float
    world_from_lidar: FloatArray
    ego_velocity: FloatArray | None
    cameras: tuple[Camera, ...]

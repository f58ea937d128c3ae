"""What the memory keeps between frames: tracks as parallel arrays in a fixed (world) frame, and who looked last."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lcf3d.frame import Frame
from lcf3d.fusion.memory_config import ClassColumns, MemoryConfig
from lcf3d.structures import Camera, FloatArray, IntArray

# columns of `Tracks.numbers` and `Tracks.values`
ID, LABEL, HITS, NUMBER_HITS = range(4)
(
    POSITION_X,
    POSITION_Y,
    VELOCITY_X,
    VELOCITY_Y,
    COV,
    COV_BOTH,
    COV_RATE,
    HEADING,
    YAW_RATE,
    YAW_COV,
    YAW_COV_BOTH,
    YAW_COV_RATE,
    BOTTOM,
    SIZE,
    SIZE_W,
    SIZE_H,
    SIZE_WEIGHT,
    SUPPORT,
    LAST_SUPPORT,
    BORN,
    SEEN,
    STANDING_X,
    STANDING_Y,
    STANDING_COV,
    STANDING,
) = range(25)


@dataclass(frozen=True, eq=False)
class Tracks:
    """T tracks, one row each; lengths in metres, angles in radians, times in seconds, all in the world frame.

    Two tables, so that a step is a few calls whatever the number of tracks; the columns have names of their own.

    Attributes:
        numbers: (T, 4) id, never used again within a sequence; class; number of frames that saw the object; number of
            frames that saw what goes by the id, which tracks may exchange (`memory_identity`).
        values: (T, 25): position and velocity if the object moves, and what the properties below name; last, position
            and variance if it stands, and how probable that is.
    """

    numbers: IntArray
    values: FloatArray

    @classmethod
    def empty(cls) -> Tracks:
        """No tracks."""
        return cls(np.zeros((0, 4), dtype=np.int64), np.zeros((0, 25)))

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: Any) -> Tracks:
        """Those selected by a slice, an integer array or a boolean mask."""
        return Tracks(self.numbers[index], self.values[index])

    @property
    def ids(self) -> IntArray:
        """(T,) numbers that are never used again within a sequence."""
        return self.numbers[:, ID]

    @property
    def labels(self) -> IntArray:
        """(T,) class."""
        return self.numbers[:, LABEL]

    @property
    def hits(self) -> IntArray:
        """(T,) number of frames that saw the object."""
        return self.numbers[:, HITS]

    @property
    def number_hits(self) -> IntArray:
        """(T,) number of frames that saw what goes by the track's id."""
        return self.numbers[:, NUMBER_HITS]

    @property
    def positions(self) -> FloatArray:
        """(T, 2) x and y of the centre: where it is if it stands or if it moves, whichever is more probable."""
        likelier: FloatArray = np.where(
            self.standing[:, None] > 0.5, self.values[:, STANDING_X:STANDING_COV], self.moving_positions
        )
        return likelier

    @property
    def moving_positions(self) -> FloatArray:
        """(T, 2) x and y of the centre if it moves."""
        return self.values[:, :VELOCITY_X]

    @property
    def standing(self) -> FloatArray:
        """(T,) probability that it stands."""
        return self.values[:, STANDING]

    @property
    def velocities(self) -> FloatArray:
        """(T, 2) m/s; what stands has none."""
        mean: FloatArray = (1 - self.standing)[:, None] * self.values[:, VELOCITY_X:COV]
        return mean

    @property
    def position_variances(self) -> FloatArray:
        """(T,) of the position along either axis, if the object moves."""
        return self.values[:, COV]

    @property
    def yaws(self) -> FloatArray:
        """(T,) heading; the yaw rate and the (T, 3) covariance of both follow in ``values``."""
        return self.values[:, HEADING]

    @property
    def bottoms(self) -> FloatArray:
        """(T,) height of the bottom face."""
        return self.values[:, BOTTOM]

    @property
    def sizes(self) -> FloatArray:
        """(T, 3) length, width, height; how much the past counts in them follows in ``values``."""
        return self.values[:, SIZE:SIZE_WEIGHT]

    @property
    def support(self) -> FloatArray:
        """(T,) what past frames say for the object, see `memory_evidence.grown_support`."""
        return self.values[:, SUPPORT]

    @property
    def last_support(self) -> FloatArray:
        """(T,) what the last frame said, not yet part of ``support``."""
        return self.values[:, LAST_SUPPORT]

    @property
    def born(self) -> FloatArray:
        """(T,) time of the first frame that saw what goes by the track's id."""
        return self.values[:, BORN]

    @property
    def seen(self) -> FloatArray:
        """(T,) time of the last."""
        return self.values[:, SEEN]


class Odometry(NamedTuple):
    """How long the poses' steps really are.

    Attributes:
        scale: true length of a step by that of the poses.
        variance: of the scale.
    """

    scale: float
    variance: float


@dataclass(frozen=True, eq=False)
class Memory:
    """What is kept from frame to frame; of bounded size.

    Attributes:
        tracks: the objects.
        time_s: when the last frame was.
        world_from_lidar: (4, 4) where the sensor was then. The memory's world is the LiDAR frame of its first frame,
            so that z is up whatever the axes of the dataset's world.
        lidar_from_world: its inverse.
        world_from_dataset: (4, 4) from the fixed frame of the dataset's poses; None where it has none. It moves
            along as the scale of the poses' steps is corrected.
        odometry: what is known of that scale.
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
    lidar_from_world: FloatArray
    world_from_dataset: FloatArray | None
    odometry: Odometry
    ego_velocity: FloatArray | None
    cameras: tuple[Camera, ...]
    next_id: int
    class_names: tuple[str, ...]
    sequence: str | None
    config: MemoryConfig
    classes: ClassColumns

    def fits(self, class_names: tuple[str, ...], config: MemoryConfig) -> bool:
        """Whether a frame of these classes may join, with these settings."""
        # most often the very same object: comparing settings field by field takes longer than most steps
        same = self.config is config or self.config == config
        return same and self.class_names == class_names


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

    @property
    def estimated(self) -> bool:
        """Whether the place was estimated from the objects."""
        return self.ego_velocity is not None

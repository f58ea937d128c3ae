"""What the streets of a preset hold beyond the ordinary mix, how even the ground is, how the car rides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Mounting:
    """How the pose of the LiDAR strays from its nominal height and a level ride, frame by frame.

    Slopes are those of the ground in the LiDAR frame (rise by metre ahead, rise by metre to the left). The defaults are
    what plane fits through the boxes of 696 KITTI label files give.

    Attributes:
        height_m: mean and standard deviation of what is added to the preset's height.
        ahead: mean and standard deviation of the slope along the driving direction.
        left: mean and standard deviation of the slope across it.
    """

    height_m: tuple[float, float] = (-0.03, 0.05)
    ahead: tuple[float, float] = (0.0075, 0.008)
    left: tuple[float, float] = (-0.006, 0.015)

    def draw(self, rng: np.random.Generator) -> tuple[float, NDArray[np.float64]]:
        """Height to add in metres, and (3, 3) rotation into the car's level frame from the LiDAR's."""
        height, ahead, left = (
            mean + deviation * float(np.clip(rng.normal(), -2.5, 2.5))
            for mean, deviation in (self.height_m, self.ahead, self.left)
        )
        up = np.array([-ahead, -left, 1.0])
        return height, level_from_tilted(up / np.linalg.norm(up))


def level_from_tilted(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation that brings the unit vector ``up`` of a tilted frame to +z and keeps the heading."""
    forward = np.array([1.0, 0.0, 0.0]) - up[0] * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


@dataclass(frozen=True)
class World:
    """Ingredients of a preset's streets; the defaults add nothing.

    Attributes:
        density: factor on the number of ordinary road users, on top of the caller's.
        people: mean number of additional people around the sensors, placed so that their heights in the image follow
            KITTI's labels: on pavements, in groups, crossing, sitting, between and behind parked cars.
        riders: mean number of additional cyclists and motorcyclists around the sensors.
        two_wheelers: mean number of additional parked bicycles and motorcycles around the sensors.
        queues: chance of a queue of vehicles in each lane.
        rows: mean number of rows of cars parked side by side.
        large: factor on the share of vans, trucks, buses, trams and trailers.
        clutter: mean number of posts, trunks, cabinets, bushes and walls put beside the road around the sensors.
        relief_m: height of the rolling of the land; 0 keeps the gentle default.
        crown: fall of the carriageway from its middle to its edges, as a slope.
        varied_people: everybody with clothes, posture and a gait of their own.
        varied_photos: exposure, contrast, colours, sharpness and depth of the shade drawn anew for every drive.
        mounting: how the sensors ride, None for always level.
    """

    density: float = 1.0
    people: float = 0.0
    riders: float = 0.0
    two_wheelers: float = 0.0
    queues: float = 0.0
    rows: float = 0.0
    large: float = 1.0
    clutter: float = 0.0
    relief_m: float = 0.0
    crown: float = 0.0
    varied_people: bool = False
    varied_photos: bool = False
    mounting: Mounting | None = None

    @property
    def is_uneven(self) -> bool:
        """Whether the ground is so uneven that vehicles tilt with it."""
        return self.relief_m > 0 or self.crown > 0


PLAIN: Final = World()
"""Streets with KITTI's mix of road users on almost flat ground."""
RICH: Final = World(
    density=1.15,
    people=6.0,
    riders=2.0,
    two_wheelers=1.5,
    queues=0.3,
    rows=0.8,
    large=1.6,
    clutter=14.0,
    relief_m=0.9,
    crown=0.02,
    varied_people=True,
    varied_photos=True,
    mounting=Mounting(),
)
"""Streets to train on: several times as many people and riders, things mistaken for them, uneven ground."""

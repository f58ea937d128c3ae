"""A street of boxes that a car drives along: what stands where, and what each thing is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcf3d.structures import FloatArray

GROUND_Z = -1.75
SPEED_M_PER_FRAME = 1.2

# kinds that look like objects to a LiDAR detector and are none
POLE, BUSH, BUILDING = 3, 4, 5

_RED, _BLUE, _GREY, _WHITE, _DARK = (176, 46, 40), (44, 86, 150), (120, 124, 128), (214, 214, 208), (52, 56, 62)
_PAINTS = (_RED, _BLUE, _GREY, _WHITE, _DARK, (62, 120, 84), (196, 150, 60))
_CLOTHES = ((170, 70, 60), (60, 90, 160), (90, 130, 80), (190, 170, 70), (120, 80, 130), (70, 70, 76))
_SKIN, _GLASS, _LEAVES, _METAL = (214, 170, 140), (46, 58, 72), (62, 98, 52), (96, 100, 104)


@dataclass(frozen=True, eq=False)
class Street:
    """Things on a street at one moment, in the LiDAR frame.

    Attributes:
        boxes: (K, 7) one box a thing.
        kinds: (K,) 0 car, 1 pedestrian, 2 cyclist, then `POLE`, `BUSH`, `BUILDING`.
        parts: (M, 7) the cuboids that the things are made of.
        colours: (M, 3) their colours, 0 to 255.
        owner: (M,) the thing of each cuboid; -1 for shadows.
    """

    boxes: FloatArray
    kinds: NDArray[np.int64]
    parts: FloatArray
    colours: FloatArray
    owner: NDArray[np.int64]


@dataclass(frozen=True)
class _Thing:
    kind: int
    x: float
    y: float
    yaw: float
    speed: float  # metres a frame along yaw
    colour: tuple[int, int, int]


class Drive:
    """A street for all frames of a drive.

    Args:
        seed: of the random generator; equal seeds give equal streets.
    """

    def __init__(self, seed: int = 0) -> None:
        self._things = _place_things(np.random.default_rng(seed))

    def street(self, index: int) -> Street:
        """The street at frame ``index``, seen from the driving car."""
        boxes: list[list[float]] = []
        kinds: list[int] = []
        parts: list[list[float]] = []
        colours: list[tuple[int, int, int]] = []
        owner: list[int] = []
        for thing in self._things:
            x = thing.x + np.cos(thing.yaw) * thing.speed * index - SPEED_M_PER_FRAME * index
            y = thing.y + np.sin(thing.yaw) * thing.speed * index
            if not -30 < x < 75:
                continue
            pieces = _SHAPES[thing.kind](thing.colour)
            size = _SIZES[thing.kind]
            boxes.append([x, y, GROUND_Z + size[2] / 2, *size, thing.yaw])
            shadow = ((0.25, -0.25, 0.01), (size[0] * 1.1, size[1] * 1.15, 0.02), (44, 45, 48))
            for centre, extent, colour in (shadow, *pieces):
                cos, sin = np.cos(thing.yaw), np.sin(thing.yaw)
                parts.append(
                    [
                        x + cos * centre[0] - sin * centre[1],
                        y + sin * centre[0] + cos * centre[1],
                        GROUND_Z + centre[2],
                        *extent,
                        thing.yaw,
                    ]
                )
                colours.append(colour)
                owner.append(-1 if colour == shadow[2] else len(kinds))
            kinds.append(thing.kind)
        return Street(
            np.array(boxes), np.array(kinds), np.array(parts), np.array(colours, dtype=np.float64), np.array(owner)
        )


_Piece = tuple[tuple[float, float, float], tuple[float, float, float], tuple[int, int, int]]
_SIZES = {
    0: (4.2, 1.8, 1.55),
    1: (0.7, 0.65, 1.78),
    2: (1.8, 0.65, 1.75),
    POLE: (0.25, 0.25, 5.0),
    BUSH: (1.5, 1.1, 1.3),
    BUILDING: (14.0, 6.0, 9.0),
}


def _car(paint: tuple[int, int, int]) -> tuple[_Piece, ...]:
    wheels: tuple[_Piece, ...] = tuple(
        ((x, y, 0.32), (0.64, 0.2, 0.62), (30, 30, 32)) for x in (-1.3, 1.35) for y in (-0.8, 0.8)
    )
    lamps: tuple[_Piece, ...] = tuple(((-2.1, y, 0.75), (0.02, 0.3, 0.16), (200, 30, 28)) for y in (-0.65, 0.65))
    return (
        ((0, 0, 0.62), (4.2, 1.8, 0.7), paint),
        ((-0.25, 0, 1.2), (2.2, 1.56, 0.62), _GLASS),
        ((-0.25, 0, 1.52), (1.9, 1.5, 0.06), paint),
        *wheels,
        *lamps,
    )


def _pedestrian(clothes: tuple[int, int, int]) -> tuple[_Piece, ...]:
    return (
        ((0.14, 0.12, 0.42), (0.2, 0.18, 0.84), (56, 60, 84)),
        ((-0.14, -0.12, 0.42), (0.2, 0.18, 0.84), (50, 54, 78)),
        ((0, 0, 1.15), (0.3, 0.48, 0.64), clothes),
        ((0.05, 0.29, 1.1), (0.3, 0.12, 0.6), clothes),
        ((0.0, -0.29, 1.1), (0.3, 0.12, 0.6), clothes),
        ((0.02, 0, 1.63), (0.22, 0.2, 0.28), _SKIN),
    )


def _cyclist(clothes: tuple[int, int, int]) -> tuple[_Piece, ...]:
    return (
        ((-0.55, 0, 0.34), (0.66, 0.05, 0.66), (34, 34, 36)),
        ((0.55, 0, 0.34), (0.66, 0.05, 0.66), (34, 34, 36)),
        ((0, 0, 0.62), (0.9, 0.06, 0.12), (180, 40, 40)),
        ((0.42, 0, 0.98), (0.08, 0.56, 0.06), _METAL),
        ((-0.1, 0.12, 0.68), (0.3, 0.14, 0.55), (50, 54, 78)),
        ((-0.1, -0.12, 0.72), (0.3, 0.14, 0.5), (50, 54, 78)),
        ((-0.05, 0, 1.22), (0.4, 0.44, 0.56), clothes),
        ((0.1, 0, 1.62), (0.24, 0.2, 0.26), _SKIN),
    )


_SHAPES: dict[int, Callable[[tuple[int, int, int]], tuple[_Piece, ...]]] = {
    0: _car,
    1: _pedestrian,
    2: _cyclist,
    POLE: lambda colour: (((0.0, 0.0, 2.5), (0.18, 0.18, 5.0), colour), ((0.0, 0.0, 1.2), (0.25, 0.25, 0.5), colour)),
    BUSH: lambda colour: (((0.0, 0.0, 0.6), (1.5, 1.1, 1.2), colour), ((0.1, 0.1, 1.1), (0.9, 0.8, 0.5), colour)),
    BUILDING: lambda colour: (((0.0, 0.0, 4.5), (14.0, 6.0, 9.0), colour),),
}


def _place_things(rng: np.random.Generator) -> list[_Thing]:
    """Parked and moving cars, people, and what a LiDAR detector mistakes for them."""

    def pick(colours: tuple[tuple[int, int, int], ...]) -> tuple[int, int, int]:
        return colours[int(rng.integers(len(colours)))]

    # traffic ahead in our lane, and oncoming
    things = [_Thing(0, x, 0.0, 0.0, 1.0, pick(_PAINTS)) for x in (18.0, 42.0)]
    things += [_Thing(0, x, 3.6, np.pi, 1.1, pick(_PAINTS)) for x in (35.0, 62.0, 88.0)]
    for x in np.arange(6.0, 100.0, 6.8):
        if rng.uniform() < 0.55:
            things.append(_Thing(0, x + rng.normal(0, 0.4), -3.6, rng.normal(0, 0.04), 0.0, pick(_PAINTS)))
        if rng.uniform() < 0.5:
            things.append(_Thing(0, x + rng.normal(0, 0.4), 7.2, np.pi + rng.normal(0, 0.04), 0.0, pick(_PAINTS)))
    # cyclists between the parked cars and the traffic
    things += [
        _Thing(2, x, y, yaw, 0.45, pick(_CLOTHES)) for x, y, yaw in ((24, -1.9, 0.0), (47, -1.9, 0), (58, 5.6, np.pi))
    ]
    for x in np.arange(9.0, 105.0, 5.0):
        side = 1.0 if rng.uniform() < 0.5 else -1.0
        y = (8.7 if side > 0 else -5.3) + rng.normal(0, 0.4)
        things.append(_Thing(1, x + rng.normal(0, 1.2), y, rng.choice([0.0, np.pi]), 0.13, pick(_CLOTHES)))
    # people who cross the road ahead
    for x, y, yaw in ((27, -2.6, np.pi / 2), (36, -1.0, np.pi / 2), (51, 5.4, -np.pi / 2), (64, -3.4, np.pi / 2)):
        things.append(_Thing(1, x, y, yaw, 0.14, pick(_CLOTHES)))
    for x in np.arange(10.0, 110.0, 12.0):
        things.append(_Thing(POLE, x, -4.9, 0.0, 0.0, _METAL))
        things.append(_Thing(POLE, x + 6, 8.1, 0.0, 0.0, _METAL))
        things.append(_Thing(BUSH, x + rng.uniform(-3, 3), -6.9, rng.uniform(-0.3, 0.3), 0.0, _LEAVES))
        things.append(_Thing(BUSH, x + rng.uniform(-3, 3), 9.9, rng.uniform(-0.3, 0.3), 0.0, _LEAVES))
    for i, x in enumerate(np.arange(5.0, 110.0, 16.0)):
        walls = ((168, 140, 118), (150, 150, 146), (176, 164, 140), (140, 116, 104))
        things.append(_Thing(BUILDING, x, -13.5, 0.0, 0.0, walls[i % 4]))
        things.append(_Thing(BUILDING, x + 7, 16.5, 0.0, 0.0, walls[(i + 2) % 4]))
    return things

"""Things beside the road that detectors take for people, riders and cars: posts, trunks, cabinets, bushes, walls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from lcf3d.simulation.meshes import buildings
from lcf3d.simulation.meshes.primitives import Mesh, box, ellipsoid, tube
from lcf3d.simulation.roadside import WALLS, any_of

Colour = tuple[float, float, float]
_STEEL: Final[Colour] = (0.22, 0.23, 0.24)
_PAINTS: Final[tuple[Colour, ...]] = (
    (0.30, 0.31, 0.30),
    (0.05, 0.05, 0.05),
    (0.45, 0.05, 0.04),
    (0.55, 0.42, 0.03),
    (0.06, 0.14, 0.34),
    (0.07, 0.20, 0.09),
    (0.60, 0.59, 0.56),
    (0.24, 0.15, 0.08),
)


def _any(colours: tuple[Colour, ...], rng: np.random.Generator) -> Colour:
    return colours[int(rng.integers(len(colours)))]


def _post(rng: np.random.Generator) -> Mesh:
    """A bare post or pole, of wood, steel or concrete, 1 to 8 m high."""
    height = float(rng.choice([rng.uniform(1.0, 2.2), rng.uniform(2.5, 8.0)]))
    radius = float(rng.uniform(0.03, 0.08) if height < 2.5 else rng.uniform(0.05, 0.17))
    material = ("galvanised", "wood", "concrete", "plastic")[int(rng.integers(4))]
    return tube([(0, 0, 0), (0, 0, height)], [radius, radius * 0.85], material, _any(_PAINTS, rng), 8)


def _trunk(rng: np.random.Generator) -> Mesh:
    """A trunk whose crown begins high above, sometimes slanting or forked, with a sapling's stake now and then."""
    lean, radius = rng.normal(0, 0.12, 2), float(rng.uniform(0.08, 0.28))
    height = float(rng.uniform(2.6, 5.0))
    top = np.array([lean[0], lean[1], 1.0]) * height
    parts = [tube([np.zeros(3), top / 2, top], [radius * 1.2, radius, radius * 0.75], "bark", (0.10, 0.075, 0.05), 9)]
    if rng.random() < 0.4:
        fork = top * 0.55 + np.array([*rng.normal(0, 0.5, 2), height * 0.5])
        parts.append(tube([top * 0.5, fork], [radius * 0.6, radius * 0.4], "bark", (0.10, 0.075, 0.05), 7))
    crown = any_of("bush", rng).scaled(np.array([2.2, 2.2, 1.6]) * float(rng.uniform(0.6, 1.2)))
    return Mesh.join([*parts, crown.moved(top - [0, 0, 0.5])])


def _shrub(rng: np.random.Generator) -> Mesh:
    """A slim or round shrub, from the size of a child to that of a large adult."""
    height, width = float(rng.uniform(0.7, 2.3)), float(rng.uniform(0.4, 1.5))
    return any_of("bush", rng).scaled(np.array([width / 1.3, width / 1.2, height / 1.2]))


def _conical(rng: np.random.Generator) -> Mesh:
    """A small conifer or a clipped column of green."""
    height, width = float(rng.uniform(1.2, 3.5)), float(rng.uniform(0.5, 1.2))
    return any_of("conifer", rng).scaled(np.array([width / 3.8, width / 3.8, height / 9.5]))


def _cabinet(rng: np.random.Generator) -> Mesh:
    """A switch cabinet, parcel box or vending machine."""
    size = (float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.4, 1.6)), float(rng.uniform(0.9, 1.9)))
    colour = _any(_PAINTS, rng)
    foot = box((0, 0, 0.05), (size[0] * 0.9, size[1] * 0.9, 0.3), "concrete", (0.4, 0.4, 0.38))
    return Mesh.join([foot, box((0, 0, 0.1 + size[2] / 2), size, "plastic", colour)])


def _meter(rng: np.random.Generator) -> Mesh:
    """A parking meter, letter box or call point: a head on a slim post."""
    height = float(rng.uniform(1.0, 1.5))
    head = (float(rng.uniform(0.15, 0.35)), float(rng.uniform(0.2, 0.45)), float(rng.uniform(0.3, 0.7)))
    post = tube([(0, 0, 0), (0, 0, height)], [0.05, 0.05], "galvanised", _STEEL, 7)
    return Mesh.join([post, box((0, 0, height), head, "plastic", _any(_PAINTS, rng))])


def _column(rng: np.random.Generator) -> Mesh:
    """An advertising column or a slim stele."""
    radius, height = (
        (float(rng.uniform(0.45, 0.7)), 3.0) if rng.random() < 0.5 else (0.25, float(rng.uniform(1.4, 2.4)))
    )
    parts = [tube([(0, 0, 0), (0, 0, height)], [radius, radius], "wall", _any(WALLS, rng), 16)]
    for k in range(3):
        low, high = height * (0.1 + 0.28 * k), height * (0.33 + 0.28 * k)
        stuff = ("plain", "checks", "stripes")[int(rng.integers(3))]
        parts.append(tube([(0, 0, low), (0, 0, high)], [radius + 0.01] * 2, stuff, _any(_PAINTS, rng), 16))
    return Mesh.join([*parts, ellipsoid((0, 0, height), (radius * 1.1, radius * 1.1, 0.2), "plastic", _STEEL, 7)])


def _bins(rng: np.random.Generator) -> Mesh:
    """One to four wheeled bins side by side."""
    parts = []
    for k in range(int(rng.integers(1, 5))):
        width, height = float(rng.uniform(0.48, 0.62)), float(rng.uniform(0.95, 1.12))
        colour = _any(((0.04, 0.045, 0.05), (0.03, 0.10, 0.05), (0.30, 0.22, 0.02), (0.02, 0.06, 0.20)), rng)
        x, y = float(rng.normal(0, 0.06)), 0.68 * k
        parts.append(box((x, y, height / 2 + 0.03), (width * 1.15, width, height - 0.06), "plastic", colour))
        parts.append(
            box((x, y, height), (width * 1.25, width * 1.06, 0.06), "plastic", _any((colour, _PAINTS[3]), rng))
        )
    return Mesh.join(parts)


def _wall(rng: np.random.Generator) -> Mesh:
    """A piece of wall, 0.8 to 3 m high, or a pillar."""
    if rng.random() < 0.35:
        size = (float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.3, 0.6)), float(rng.uniform(1.2, 2.6)))
        return box((0, 0, size[2] / 2), size, "brick" if rng.random() < 0.4 else "concrete", _any(WALLS, rng))
    return buildings.garden_wall(float(rng.uniform(1.5, 7.0)), float(rng.uniform(0.8, 3.0)), bool(rng.random() < 0.4))


def _rack(rng: np.random.Generator) -> Mesh:
    """Hoops for bicycles, empty, or a railing."""
    parts = []
    for k in range(int(rng.integers(2, 6))):
        y = 0.75 * k
        hoop = [(-0.35, y, 0), (-0.35, y, 0.7), (0.0, y, 0.85), (0.35, y, 0.7), (0.35, y, 0)]
        parts.append(tube(hoop, [0.025] * 5, "galvanised", _STEEL, 6))
    return Mesh.join(parts)


def _board(rng: np.random.Generator) -> Mesh:
    """A sandwich board, sign or figure of a shop on the pavement, about as tall as a person."""
    width, height = float(rng.uniform(0.4, 0.8)), float(rng.uniform(0.9, 1.9))
    stuff = ("plain", "checks", "stripes", "wood")[int(rng.integers(4))]
    lower = box((0, 0, height / 2), (0.06, width, height), stuff, _any(_PAINTS, rng))
    if rng.random() < 0.5:
        return lower
    return Mesh.join([lower, ellipsoid((0, 0, height), (0.1, 0.15, 0.16), "plain", _any(_PAINTS, rng), 7)])


def _ready(kind: str) -> Callable[[np.random.Generator], Mesh]:
    return lambda rng: any_of(kind, rng)


MAKERS: Final[tuple[tuple[float, Callable[[np.random.Generator], Mesh]], ...]] = (
    (0.16, _post),
    (0.15, _trunk),
    (0.13, _shrub),
    (0.06, _conical),
    (0.07, _cabinet),
    (0.07, _meter),
    (0.04, _column),
    (0.07, _bins),
    (0.09, _wall),
    (0.03, _rack),
    (0.04, _board),
    (0.06, _ready("sign")),
    (0.03, _ready("bollard")),
)
"""Share and maker of every kind of thing."""


def thing(rng: np.random.Generator) -> Mesh:
    """Something at random, standing on z = 0 and turned any way."""
    shares = np.array([share for share, _ in MAKERS])
    make = MAKERS[int(rng.choice(len(MAKERS), p=shares / shares.sum()))][1]
    return make(rng).placed(0.0, 0.0, 0.0, float(rng.uniform(-np.pi, np.pi)))

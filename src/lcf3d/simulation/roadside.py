"""Ready-made trees, fences, lamps and signs, made once a process and put wherever a street needs them."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from lcf3d.simulation.meshes import buildings, plants
from lcf3d.simulation.meshes import street as build
from lcf3d.simulation.meshes.primitives import Mesh

Colour = tuple[float, float, float]

GREENS: Final[tuple[Colour, ...]] = (
    (0.07, 0.13, 0.03),
    (0.09, 0.15, 0.035),
    (0.06, 0.11, 0.035),
    (0.12, 0.15, 0.03),
    (0.19, 0.14, 0.03),
)
WALLS: Final[tuple[Colour, ...]] = (
    (0.62, 0.59, 0.52),
    (0.66, 0.64, 0.60),
    (0.55, 0.46, 0.30),
    (0.60, 0.53, 0.38),
    (0.45, 0.36, 0.28),
    (0.52, 0.50, 0.47),
    (0.58, 0.40, 0.30),
    (0.42, 0.45, 0.46),
)
BRICKS: Final[tuple[Colour, ...]] = ((0.34, 0.15, 0.10), (0.42, 0.24, 0.15), (0.28, 0.13, 0.10))
ROOFS: Final[tuple[Colour, ...]] = ((0.26, 0.10, 0.06), (0.20, 0.085, 0.055), (0.10, 0.09, 0.09), (0.30, 0.13, 0.07))
VARIANTS: Final = {
    "tree": 8,
    "fine_tree": 8,
    "conifer": 4,
    "bush": 8,
    "hedge": 4,
    "undergrowth": 8,
    "fine_undergrowth": 8,
    "fence": 2,
    "bollard": 1,
    "lamp": 2,
    "bin": 1,
    "bench": 1,
    "shelter": 1,
    "delineator": 1,
    "rail": 1,
    "light": 1,
    "sign": 4,
}


@lru_cache(maxsize=64)
def template(kind: str, variant: int) -> Mesh:
    """One of ``VARIANTS`` ready-made things, made when first used; plants and fences are stretched later."""
    rng = np.random.default_rng(7000 + variant)
    if kind == "tree":
        return plants.tree(8.5, 8.5 * float(rng.uniform(0.5, 0.7)), GREENS[variant % 5], 120, 0.32, rng)
    if kind == "fine_tree":
        return plants.tree(8.5, 8.5 * float(rng.uniform(0.5, 0.7)), GREENS[variant % 5], 480, 0.135, rng)
    if kind == "conifer":
        return plants.conifer(9.5, 3.8, (0.035, 0.065, 0.03), 300, rng)
    if kind == "bush":
        return plants.bush(1.3, 1.2, 1.2, GREENS[variant % 5], 620, rng)
    if kind == "hedge":
        return plants.hedge(5.0, 1.3, GREENS[variant], rng)
    if kind == "undergrowth":
        return plants.undergrowth(4.4, 5.0, float(rng.uniform(0.9, 2.6)), 350, 0.30, GREENS[variant % 5], rng)
    if kind == "fine_undergrowth":
        return plants.undergrowth(4.4, 5.0, float(rng.uniform(0.9, 2.6)), 1500, 0.14, GREENS[variant % 5], rng)
    if kind == "fence":
        return buildings.fence(5.0, 1.1, variant == 1)
    if kind == "lamp":
        return build.street_lamp(6.0 + 2.0 * variant, 1.2)
    if kind == "sign":
        return build.sign_post(variant)
    if kind == "rail":
        return build.guard_rail(4.02)
    makers = {
        "bollard": build.bollard,
        "bin": build.litter_bin,
        "bench": build.bench,
        "shelter": build.bus_shelter,
        "delineator": build.delineator,
        "light": build.traffic_light,
    }
    return makers[kind]()


def any_of(kind: str, rng: np.random.Generator) -> Mesh:
    """A template of a kind, chosen at random."""
    return template(kind, int(rng.integers(VARIANTS[kind])))

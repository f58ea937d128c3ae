"""What surfaces are made of: how a camera sees them and how a laser beam comes back from them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray


class Kind(IntEnum):
    """The shading model of a material."""

    DIFFUSE = 0
    PAINT = 1
    GLASS = 2
    ROAD = 3
    FACADE = 4
    LAMP = 5
    FOLIAGE = 6
    METAL = 7
    GROUND = 8


@dataclass(frozen=True)
class Material:
    """One surface.

    Attributes:
        name: unique name.
        kind: shading model.
        texture: name of a texture of ``lcf3d.simulation.textures``; its mean is 1, it multiplies the colour.
        tile_m: metres that one repetition of the texture covers.
        specular: share of light mirrored at normal incidence.
        gloss: sharpness of the mirror image, 0 (matt) to 1 (mirror).
        reflectance: LiDAR intensity at normal incidence for a surface of colour luminance 0.5, in [0, 1].
        colour_matters: how far the visible colour changes the reflectance (black paint swallows the beam), 0 to 1.
        retro: 1 for a surface that sends the beam straight back (plates, signs), else 0.
    """

    name: str
    kind: Kind = Kind.DIFFUSE
    texture: str = "plain"
    tile_m: float = 1.0
    specular: float = 0.0
    gloss: float = 0.0
    reflectance: float = 0.35
    colour_matters: float = 0.3
    retro: float = 0.0


MATERIALS: Final[tuple[Material, ...]] = (
    Material("plain", reflectance=0.35),
    Material("asphalt", Kind.ROAD, "asphalt", 3.0, 0.02, 0.3, 0.27, 0.0),
    Material("side_asphalt", Kind.GROUND, "asphalt", 3.0, 0.02, 0.3, 0.26, 0.0),
    Material("pavement", Kind.GROUND, "slabs", 2.0, 0.01, 0.2, 0.33, 0.0),
    Material("cobbles", Kind.GROUND, "cobbles", 1.6, 0.01, 0.2, 0.33, 0.0),
    Material("kerb", Kind.DIFFUSE, "concrete", 2.0, 0.0, 0.0, 0.36, 0.0),
    Material("grass", Kind.GROUND, "grass", 5.0, 0.0, 0.0, 0.38, 0.0),
    Material("earth", Kind.GROUND, "earth", 4.0, 0.0, 0.0, 0.33, 0.0),
    Material("plaster", Kind.FACADE, "plaster", 4.0, 0.0, 0.0, 0.42, 0.3),
    Material("brick_front", Kind.FACADE, "brick", 1.2, 0.0, 0.0, 0.36, 0.3),
    Material("wall", Kind.DIFFUSE, "plaster", 4.0, 0.0, 0.0, 0.40, 0.3),
    Material("brick", Kind.DIFFUSE, "brick", 1.2, 0.0, 0.0, 0.36, 0.3),
    Material("roof", Kind.DIFFUSE, "tiles", 1.5, 0.02, 0.2, 0.30, 0.3),
    Material("concrete", Kind.DIFFUSE, "concrete", 3.0, 0.0, 0.0, 0.38, 0.2),
    Material("wood", Kind.DIFFUSE, "wood", 1.5, 0.01, 0.2, 0.40, 0.2),
    Material("bark", Kind.DIFFUSE, "bark", 1.0, 0.0, 0.0, 0.33, 0.1),
    Material("leaves", Kind.FOLIAGE, "leaf", 1.0, 0.0, 0.0, 0.36, 0.0),
    Material("paint", Kind.PAINT, "plain", 1.0, 0.05, 0.97, 0.40, 0.9),
    Material("glass", Kind.GLASS, "plain", 1.0, 0.06, 1.0, 0.06, 0.0),
    Material("rubber", Kind.DIFFUSE, "plain", 1.0, 0.01, 0.2, 0.05, 0.3),
    Material("plastic", Kind.DIFFUSE, "plain", 1.0, 0.03, 0.4, 0.12, 0.5),
    Material("rim", Kind.METAL, "plain", 1.0, 0.45, 0.7, 0.35, 0.2),
    Material("chrome", Kind.METAL, "plain", 1.0, 0.7, 0.95, 0.25, 0.0),
    Material("galvanised", Kind.METAL, "concrete", 1.0, 0.25, 0.4, 0.35, 0.0),
    Material("headlamp", Kind.LAMP, "plain", 1.0, 0.10, 0.95, 0.45, 0.0, 0.6),
    Material("tail_lamp", Kind.LAMP, "plain", 1.0, 0.06, 0.9, 0.55, 0.0, 1.0),
    Material("plate", Kind.DIFFUSE, "plate", 1.0, 0.02, 0.5, 0.80, 0.0, 1.0),
    Material("sign", Kind.DIFFUSE, "plain", 1.0, 0.02, 0.5, 0.85, 0.0, 1.0),
    Material("skin", Kind.DIFFUSE, "plain", 1.0, 0.01, 0.2, 0.38, 0.1),
    Material("hair", Kind.DIFFUSE, "hair", 0.3, 0.01, 0.3, 0.18, 0.3),
    Material("cloth", Kind.DIFFUSE, "cloth", 0.4, 0.0, 0.0, 0.38, 0.5),
    Material("denim", Kind.DIFFUSE, "denim", 0.3, 0.0, 0.0, 0.30, 0.4),
    Material("checks", Kind.DIFFUSE, "checks", 0.5, 0.0, 0.0, 0.38, 0.4),
    Material("stripes", Kind.DIFFUSE, "stripes", 0.35, 0.0, 0.0, 0.38, 0.4),
    Material("leather", Kind.DIFFUSE, "plain", 1.0, 0.03, 0.4, 0.20, 0.5),
    Material("tarpaulin", Kind.DIFFUSE, "tarpaulin", 2.4, 0.03, 0.4, 0.42, 0.4),
    Material("container", Kind.DIFFUSE, "ribs", 1.0, 0.04, 0.5, 0.40, 0.5),
)

MATERIAL_ID: Final[dict[str, int]] = {material.name: index for index, material in enumerate(MATERIALS)}


def camera_table(texture_ids: dict[str, int]) -> NDArray[np.float32]:
    """(M, 5) kind, texture index, tile in metres, specular, gloss of every material."""
    rows = [(float(m.kind), float(texture_ids[m.texture]), m.tile_m, m.specular, m.gloss) for m in MATERIALS]
    return np.array(rows, dtype=np.float32)


def lidar_table() -> NDArray[np.float64]:
    """(M, 5) reflectance, influence of colour, retro-reflection, 1 for glass, and kind, of every material."""
    rows = [(m.reflectance, m.colour_matters, m.retro, float(m.kind == Kind.GLASS), float(m.kind)) for m in MATERIALS]
    return np.array(rows, dtype=np.float64)

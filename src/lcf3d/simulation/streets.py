"""Kinds of street: their cross-section, what stands beside them and how busy they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class StreetType:
    """Numbers that make a street; lengths in metres, ``per_100m`` counts for both sides together.

    Attributes:
        name: unique name.
        share: how often it is drawn.
        half_width: of the carriageway, parking strips included.
        parking: share of the parking places along each side that are taken, None without parking strips.
        lanes: a direction.
        centre_line: 0 none, 1 dashed, 2 solid.
        edge_lines: whether the carriageway has them.
        pavement: width of the pavement, 0 without.
        verge: width of the grass beside the pavement or road.
        setback: distance from verge to buildings.
        buildings: ``houses``, ``blocks``, ``few``, ``woods``.
        trees_per_100m: street trees.
        speed: of moving traffic in m/s.
        moving_per_100m: moving vehicles a direction.
        pedestrians_per_100m: on the pavements.
        cyclists_per_100m: on the road's edge.
        crossings: chance of a side street.
        paving: material of the carriageway.
    """

    name: str
    share: float
    half_width: float
    parking: float | None
    lanes: int
    centre_line: int
    edge_lines: bool
    pavement: float
    verge: float
    setback: float
    buildings: str
    trees_per_100m: float
    speed: float
    moving_per_100m: float
    pedestrians_per_100m: float
    cyclists_per_100m: float
    crossings: float
    paving: str = "asphalt"


STREETS: Final[tuple[StreetType, ...]] = (
    StreetType("residential", 0.34, 4.6, 0.32, 1, 0, False, 1.8, 0.0, 4.0, "houses", 5.0, 8.0, 0.65, 0.5, 0.45, 0.7),
    StreetType("city", 0.20, 5.4, 0.36, 1, 1, False, 3.2, 0.0, 0.3, "blocks", 4.0, 9.0, 1.1, 1.9, 0.9, 0.8),
    StreetType("avenue", 0.16, 7.0, None, 2, 2, True, 2.2, 3.0, 5.0, "few", 7.0, 13.0, 1.9, 0.3, 0.3, 0.6),
    StreetType("country", 0.24, 3.6, None, 1, 1, True, 0.0, 2.5, 1.0, "woods", 0.0, 19.0, 0.7, 0.02, 0.06, 0.15),
    StreetType(
        "square", 0.06, 4.0, None, 1, 0, False, 5.0, 0.0, 0.3, "blocks", 5.0, 3.0, 0.3, 5.5, 2.2, 0.4, "cobbles"
    ),
)
"""The streets of the KITTI-like and nuScenes-like presets, with the mix that reproduces KITTI's label counts."""

STREET_NAMES: Final[tuple[str, ...]] = tuple(street.name for street in STREETS)

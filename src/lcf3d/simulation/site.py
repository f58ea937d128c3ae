"""Where a street lies, and where along it things stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.meshes.primitives import Mesh
from lcf3d.simulation.roads import Path, Terrain
from lcf3d.simulation.streets import StreetType
from lcf3d.simulation.worlds import PLAIN, World

KERB: Final = 0.12
"""Height of the pavement above the road in metres."""


@dataclass(frozen=True)
class Site:
    """Where a street lies and what cuts through it.

    Attributes:
        street: its type.
        path: centre line.
        terrain: height of the land.
        first: arc length at which the built stretch begins.
        last: arc length at which it ends.
        travel: metres that the sensors travel from arc length 0.
        crossings: (arc length, half width of the side street) of every side street.
        side_paths: centre lines of the side streets, one a crossing and side.
        world: what the street holds beyond the ordinary.
    """

    street: StreetType
    path: Path
    terrain: Terrain
    first: float
    last: float
    travel: float
    crossings: tuple[tuple[float, float], ...]
    side_paths: tuple[Path, ...]
    world: World = PLAIN

    @property
    def lamps(self) -> list[tuple[float, float, float]]:
        """World positions of the street lamps' lights."""
        if self.street.buildings == "woods":
            return []
        result = []
        for side in (1.0, -1.0) if self.street.lanes > 1 else (1.0,):
            for s in self.lamp_places(side):
                x, y, _ = self.path.at(s, side * (self.street.half_width + 0.45 - 1.45))
                result.append((float(x), float(y), float(self.terrain.height(x, y)) + 7.0))
        return result

    def lamp_places(self, side: float) -> list[float]:
        """Arc lengths of the lamp posts on one side."""
        places = np.arange(self.first + 11.0 + 7.0 * side, self.last, 32.0)
        return [float(s) for s in places if not self.near_crossing(float(s), 1.0)]

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Stretches of the pavement that side streets take."""
        return [(s - w - 0.5, s + w + 0.5) for s, w in self.crossings]

    def is_near(self, s: float) -> bool:
        """Whether the sensors come so close to arc length ``s`` that single leaves can be told apart."""
        return -8.0 < s < 26.0 + self.travel

    def near_crossing(self, s: float, margin: float) -> bool:
        """Whether arc length ``s`` lies in a side street or within ``margin`` metres of it."""
        return any(abs(s - c) < w + margin for c, w in self.crossings)

    @property
    def building_line(self) -> float:
        """Distance from the centre line to the fronts of buildings."""
        street = self.street
        return street.half_width + street.pavement + street.verge + street.setback

    def zebra(self) -> float:
        """Arc length of the zebra crossing, 1e6 without."""
        if not self.crossings or self.street.pavement == 0:
            return 1e6
        s, w = self.crossings[0]
        return s - w - 4.0

    def markings(self) -> NDArray[np.float32]:
        """(12,) numbers of the road surface that the shaders read.

        Half width, kind of centre line, edge lines, offset of lane lines (0 none), zebra, width of parking strips,
        then arc length and half width of up to three crossings.
        """
        street = self.street
        lane = (street.half_width - 0.3) / 2 if street.lanes == 2 else 0.0
        parking = 2.1 if street.parking is not None and street.name == "city" else 0.0
        cross = [v for pair in self.crossings[:3] for v in pair]
        cross += [1e6, 0.0] * (3 - len(cross) // 2)
        values = [street.half_width, street.centre_line, street.edge_lines, lane, self.zebra(), parking, *cross]
        return np.array(values, dtype=np.float32)


def place(
    site: Site, mesh: Mesh, s: float, offset: float, side: float, lift: float = 0.0, path: Path | None = None
) -> Mesh:
    """A mesh whose front looks towards -y put beside the road so that it faces it."""
    x, y, heading = (path or site.path).at(s, offset * side)
    yaw = float(heading) + (0.0 if side > 0 else np.pi)
    return mesh.placed(float(x), float(y), float(site.terrain.height(x, y)) + lift, yaw)

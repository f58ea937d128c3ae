"""The still part of a street: ground, road, buildings, trees and everything else that nobody labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.clutter import thing
from lcf3d.simulation.meshes import street as build
from lcf3d.simulation.meshes.primitives import Mesh
from lcf3d.simulation.roads import Path, Terrain, open_ground, skyline, strip
from lcf3d.simulation.roadside import BRICKS, ROOFS, WALLS, any_of, template
from lcf3d.simulation.streets import StreetType
from lcf3d.simulation.worlds import PLAIN, World

Colour = tuple[float, float, float]

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


def build_scenery(site: Site, rng: np.random.Generator) -> Mesh:
    """All still meshes of a site, in the world."""
    parts = [*_ground(site, rng), *_surfaces(site)]
    for side in (1.0, -1.0):
        parts += _beside(site, side, rng)
    for number, path in enumerate(site.side_paths):
        parts += _side_street(site, path, site.crossings[number // 2][1], rng)
    if site.world.clutter:
        parts += _clutter(site, rng)
    return Mesh.join(parts)


def _clutter(site: Site, rng: np.random.Generator) -> list[Mesh]:
    """What detectors take for road users, put around the sensors: most on the pavement or verge, some far aside."""
    parts = []
    width = max(site.street.pavement + site.street.verge, 1.5)
    for _ in range(int(rng.poisson(site.world.clutter))):
        s = float(np.exp(rng.uniform(np.log(5), np.log(60)))) * float(rng.choice([1.0, 1.0, 1.0, -1.0]))
        s += site.travel * float(rng.random())
        if site.near_crossing(s, 1.0):
            continue
        aside = float(rng.uniform(0.35, width)) if rng.random() < 0.7 else width + float(rng.exponential(4.0))
        lift = KERB if aside < site.street.pavement else -0.06  # grass and earth lie lower than the pavement
        side = float(rng.choice([-1.0, 1.0]))
        parts.append(_place(site, thing(rng), s, site.street.half_width + aside, side, lift))
    return parts


def _place(
    site: Site, mesh: Mesh, s: float, offset: float, side: float, lift: float = 0.0, path: Path | None = None
) -> Mesh:
    """A mesh whose front looks towards -y put beside the road so that it faces it."""
    x, y, heading = (path or site.path).at(s, offset * side)
    yaw = float(heading) + (0.0 if side > 0 else np.pi)
    return mesh.placed(float(x), float(y), float(site.terrain.height(x, y)) + lift, yaw)


def _ground(site: Site, rng: np.random.Generator) -> list[Mesh]:
    x, y, _ = site.path.at((site.first + site.last) / 2)
    centre = (float(x), float(y))
    green = np.array([0.080, 0.100, 0.038]) * rng.uniform(0.85, 1.2)
    return [
        open_ground(
            site.terrain,
            centre,
            460.0,
            "grass",
            (green[0], green[1], green[2]),
            0.06,
            101 if site.world.is_uneven else 41,
        ),
        skyline(centre, rng),
    ]


def _surfaces(site: Site) -> list[Mesh]:
    """Carriageway, kerbs, pavements and verges of the main street."""
    street, w = site.street, site.street.half_width
    grey = (0.115, 0.115, 0.118) if street.paving == "asphalt" else (0.22, 0.205, 0.19)
    lanes = (-w, -w / 2, 0.0, w / 2, w)
    whole = (site.first, site.last)
    middle = site.world.crown * w  # the edges keep the height of the terrain, where kerbs and side streets meet them
    camber = (0.0, middle / 2, middle, middle / 2, 0.0)
    parts = [strip(site.path, site.terrain, whole, lanes, camber, street.paving, grey)]
    slab = (0.25, 0.245, 0.235)
    lowest = -0.02 if street.pavement == 0 else KERB
    outer = w + street.pavement
    for side in (1.0, -1.0):
        for a, b in site.path.pieces(*whole, site.gaps):

            def along(
                across: tuple[float, ...],
                lift: tuple[float, ...],
                material: str,
                colour: Colour,
                a: float = a,
                b: float = b,
                side: float = side,
            ) -> Mesh:
                return strip(site.path, site.terrain, (a, b), tuple(t * side for t in across), lift, material, colour)

            if street.pavement:
                parts.append(along((w, w, w + 0.15), (-0.03, KERB, KERB), "kerb", (0.33, 0.32, 0.31)))
                parts.append(
                    along(
                        (w + 0.15, outer), (KERB, KERB), "cobbles" if street.paving == "cobbles" else "pavement", slab
                    )
                )
            far = site.building_line if street.buildings != "woods" else w + street.verge
            if far > outer + 0.05 or street.verge:
                garden = (0.072, 0.092, 0.034)
                last = max(far + (14.0 if street.buildings in ("houses", "few") else 0.0), outer + 0.3)
                parts.append(along((outer, outer + 0.05, last), (lowest, lowest, lowest * 0.7), "grass", garden))
            if street.buildings == "blocks":
                parts.append(along((outer, outer + 16), (KERB, KERB), "pavement", slab))
            for s in (a, b):
                parts.append(_kerb_end(site, s, w * side, (outer + 0.2) * side, lowest))
    return parts


def _kerb_end(site: Site, s: float, inner: float, outer: float, lift: float) -> Mesh:
    """The short wall where a pavement ends at a side street."""
    from lcf3d.simulation.meshes.primitives import make_mesh, quad

    xa, ya, _ = site.path.at(s, inner)
    xb, yb, _ = site.path.at(s, outer)
    za, zb = site.terrain.height(xa, ya), site.terrain.height(xb, yb)
    soup = quad((xa, ya, za - 0.05), (xb, yb, zb - 0.05), (xb, yb, zb + max(lift, 0)), (xa, ya, za + max(lift, 0)))
    return make_mesh(soup, "kerb", (0.33, 0.32, 0.31))


def _side_street(site: Site, path: Path, half: float, rng: np.random.Generator) -> list[Mesh]:
    """A side street from the edge of the main one, with pavements and a row of buildings."""
    start, stop = site.street.half_width - 1.0, path.last
    parts = [
        strip(path, site.terrain, (start, stop), (-half, 0.0, half), (-0.005,) * 3, "side_asphalt", (0.12, 0.12, 0.122))
    ]
    pavement = 1.8 if site.street.pavement else 0.0
    begin = site.street.half_width + 0.15
    for side in (1.0, -1.0):
        if pavement:
            parts.append(
                strip(
                    path,
                    site.terrain,
                    (begin, stop),
                    tuple(side * t for t in (half, half, half + pavement)),
                    (-0.03, KERB, KERB),
                    "pavement",
                    (0.25, 0.245, 0.235),
                )
            )
        if site.street.buildings in ("houses", "blocks"):
            s = site.building_line + 18.0
            while s < stop - 10:
                width = float(rng.uniform(10, 16))
                parts.append(
                    _place(
                        site,
                        _building(site, width, rng),
                        s + width / 2,
                        half + pavement + (3.0 if site.street.buildings == "houses" else 0.3),
                        side,
                        path=path,
                    )
                )
                s += width + (float(rng.uniform(3, 8)) if site.street.buildings == "houses" else 0.0)
    return parts


def _building(site: Site, width: float, rng: np.random.Generator) -> Mesh:
    brick = bool(rng.random() < 0.25)
    colour = (BRICKS if brick else WALLS)[rng.integers(len(BRICKS) if brick else len(WALLS))]
    tone = float(rng.uniform(0.85, 1.1))
    colour = (colour[0] * tone, colour[1] * tone, colour[2] * tone)
    roof = ROOFS[rng.integers(len(ROOFS))]
    blocks = site.street.buildings == "blocks"
    floors = int(rng.integers(3, 6)) if blocks else int(rng.integers(1, 4))
    gable = bool(rng.random() < (0.5 if blocks else 0.9))
    return build.house(width, float(rng.uniform(9, 12)), floors, gable, brick, colour, roof, rng)


def _beside(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """Everything that stands along one side of the main street."""
    if site.street.buildings == "woods":
        return _woods(site, side, rng)
    return [
        *_buildings(site, side, rng),
        *_background(site, side, rng),
        *_street_trees(site, side, rng),
        *_furniture(site, side, rng),
    ]


def _buildings(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    parts: list[Mesh] = []
    street = site.street
    s = site.first + float(rng.uniform(0, 8))
    while s < site.last - 6:
        blocks = street.buildings == "blocks"
        width = float(rng.uniform(11, 20) if blocks else rng.uniform(9, 15))
        gap = 0.0 if blocks and rng.random() < 0.85 else float(rng.uniform(2.5, 9))
        if street.buildings == "few":
            gap = float(rng.uniform(8, 45))
        middle = s + width / 2
        if not site.near_crossing(middle, width / 2 + 2.0):
            parts.append(
                _place(
                    site,
                    _building(site, width, rng),
                    middle,
                    site.building_line + (float(rng.uniform(0, 3)) if not blocks else 0.0),
                    side,
                )
            )
            if street.buildings == "houses":
                parts += _front_garden(site, side, s - gap / 2, s + width + gap / 2, rng)
        elif street.buildings == "few" and not site.near_crossing(middle, 8):
            parts += _front_garden(site, side, s, s + width, rng)
        s += width + gap
    return parts


def _background(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """Houses and trees behind the first row, seen through the gaps."""
    parts = []
    s = site.first
    while s < site.last:
        s += float(rng.uniform(7, 16))
        if site.near_crossing(s, 12.0):
            continue
        offset = site.building_line + float(rng.uniform(22, 60))
        if rng.random() < 0.35:
            parts.append(_place(site, _building(site, float(rng.uniform(9, 15)), rng), s, offset, side))
        else:
            mesh = any_of("tree", rng).scaled(float(rng.uniform(0.9, 1.5)) * np.ones(3))
            parts.append(_place(site, mesh, s, offset, side))
    return parts


def _front_garden(site: Site, side: float, first: float, last: float, rng: np.random.Generator) -> list[Mesh]:
    """The boundary of a garden along the pavement, with bushes behind it and a gate left open."""
    street = site.street
    edge = street.half_width + street.pavement + street.verge + 0.45
    gate = first + float(rng.uniform(0.2, 0.8)) * (last - first)
    kind = rng.choice(["hedge", "fence", "wall", "open"], p=[0.34, 0.22, 0.26, 0.18])
    parts = []
    for a, b in ((first + 0.2, gate - 0.8), (gate + 0.8, last - 0.2)):
        if b - a < 1.0 or site.near_crossing((a + b) / 2, (b - a) / 2 + 1):
            continue
        if kind == "hedge":
            piece = any_of("hedge", rng).scaled(((b - a) / 5, 1, float(rng.uniform(0.7, 1.35))))
        elif kind == "fence":
            piece = any_of("fence", rng).scaled(((b - a) / 5, 1, float(rng.uniform(0.85, 1.2))))
        elif kind == "wall":
            piece = build.garden_wall(b - a, float(rng.uniform(0.5, 1.3)), bool(rng.random() < 0.4))
        else:
            piece = None
        if piece is not None:
            parts.append(_place(site, piece, (a + b) / 2, edge, side, KERB * 0.8))
        for _ in range(int(rng.integers(1, 4))):
            size = rng.uniform(0.7, 1.8)
            bush = any_of("bush", rng).scaled(np.array([1.0, 1.0, rng.uniform(0.7, 1.2)]) * size / 1.2)
            parts.append(
                _place(site, bush, float(rng.uniform(a, b)), edge + float(rng.uniform(0.9, 2.6)), side, KERB * 0.7)
            )
    if rng.random() < 0.75:
        parts.append(_tree(site, float(rng.uniform(first, last)), edge + float(rng.uniform(1.5, 2.5)), side, rng, 0.7))
    return parts


def _tree(site: Site, s: float, offset: float, side: float, rng: np.random.Generator, scale: float = 1.0) -> Mesh:
    size = float(rng.uniform(0.7, 1.3)) * scale
    fine = site.is_near(s) and offset < site.building_line + 6.0
    kind = "conifer" if rng.random() < 0.15 else "fine_tree" if fine else "tree"
    mesh = any_of(kind, rng).scaled(np.array([1, 1, rng.uniform(0.85, 1.15)]) * size)
    mesh = mesh.placed(0, 0, 0, float(rng.uniform(0, 6.28)))
    return _place(site, mesh, s, offset, side, KERB * 0.7)


def _street_trees(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    street = site.street
    if not street.trees_per_100m or rng.random() < 0.25:
        return []
    parts = []
    spacing = 200.0 / street.trees_per_100m * float(rng.uniform(0.6, 1.3))
    offset = street.half_width + (street.pavement + street.verge / 2 if street.verge else min(0.9, street.pavement / 2))
    if not street.verge and street.pavement < 2.5:
        offset = street.half_width + street.pavement + 1.3
    s = site.first + float(rng.uniform(0, spacing))
    while s < site.last:
        if not site.near_crossing(s, 4.0):
            parts.append(_tree(site, s, offset, side, rng))
        s += spacing * float(rng.uniform(0.8, 1.2))
    return parts


def _furniture(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """Lamps, signs, bins, benches, bollards, shelters, hoardings and traffic lights."""
    street = site.street
    edge = street.half_width + 0.45
    parts = []
    lamp = any_of("lamp", rng)
    if side > 0 or street.lanes > 1:
        parts += [_place(site, lamp, s, edge, side, KERB) for s in site.lamp_places(side)]
    for s in rng.uniform(site.first, site.last, int(rng.poisson((site.last - site.first) * 0.05))):
        if site.near_crossing(s, 1.0):
            continue
        pick = rng.choice(
            ["sign", "bin", "bollard", "bench", "shelter", "billboard", "bush"],
            p=[0.38, 0.14, 0.16, 0.10, 0.04, 0.06, 0.12],
        )
        if pick in ("shelter", "bench", "billboard", "bush") and street.pavement + street.verge < 3:
            pick = "sign"
        parts += _furniture_piece(site, str(pick), float(s), side, edge, rng)
    for s, w in site.crossings:
        along = s - w - 1.5 if side < 0 else s + w + 1.5
        mesh = template("light", 0) if street.lanes > 1 or rng.random() < 0.25 else template("sign", 1)
        parts.append(_facing_traffic(site, mesh, along, edge, side))
    return parts


def _facing_traffic(site: Site, mesh: Mesh, s: float, offset: float, side: float) -> Mesh:
    """A mesh that looks towards -x put so that the drivers on its side of the road see it."""
    x, y, heading = site.path.at(s, offset * side)
    return mesh.placed(
        float(x), float(y), float(site.terrain.height(x, y)) + KERB, float(heading) + (0.0 if side < 0 else np.pi)
    )


def _furniture_piece(site: Site, pick: str, s: float, side: float, edge: float, rng: np.random.Generator) -> list[Mesh]:
    if pick == "sign":
        return [_facing_traffic(site, any_of("sign", rng), s, edge, side)]
    if pick == "billboard":
        colour = (float(rng.uniform(0.02, 0.5)), float(rng.uniform(0.02, 0.3)), float(rng.uniform(0.02, 0.4)))
        return [_facing_traffic(site, build.billboard(colour), s, edge + 2.0, side)]
    outer = site.street.half_width + site.street.pavement
    if pick == "bollard":
        return [
            _place(site, template("bollard", 0), s + k * 1.4, edge - 0.05, side, KERB)
            for k in range(int(rng.integers(2, 6)))
        ]
    if pick == "bench":
        return [_place(site, template("bench", 0).placed(0, 0, 0, -np.pi / 2), s, outer - 0.5, side, KERB)]
    if pick == "shelter":
        return [_place(site, template("shelter", 0), s, outer - 1.6, side, KERB)]
    if pick == "bush":
        return [_place(site, any_of("bush", rng), s, outer + 0.3, side, KERB)]
    return [_place(site, template("bin", 0), s, edge + 0.1, side, KERB)]


def _woods(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """A country road: fields with single trees, or the edge of a wood; delineators and now and then a guard rail."""
    street = site.street
    parts = _background(site, side, rng) if rng.random() < 0.5 else []
    edge = street.half_width + 0.9
    for s in np.arange(site.first, site.last, 25.0):
        if not site.near_crossing(s, 2.0):
            parts.append(_place(site, template("delineator", 0), float(s), edge, side))
    dense = rng.random() < 0.6
    if rng.random() < 0.2:
        a = float(rng.uniform(site.first, site.last - 40))
        for k in range(8):
            if not site.near_crossing(a + 4 * k, 4):
                parts.append(_place(site, template("rail", 0), a + 4 * k, edge + 0.5, side))
    wall = street.half_width + street.verge
    for s in np.arange(site.first, site.last, 4.0):
        if site.near_crossing(s, 5.0):
            continue
        if dense:
            plants = any_of("fine_undergrowth" if site.is_near(s) else "undergrowth", rng)
            parts.append(_place(site, plants, float(s), wall + 0.5 + float(rng.uniform(0, 1)), side))
        if rng.random() < (0.75 if dense else 0.06):
            offset = wall + float(rng.uniform(2.0, 7.0)) + (0 if dense else float(rng.uniform(2, 20)))
            parts.append(_tree(site, float(s), offset, side, rng, 1.15))
        if dense and rng.random() < 0.5:
            parts.append(_tree(site, float(s) + 2, wall + float(rng.uniform(7.0, 13.0)), side, rng, 1.3))
    return parts

"""The still part of a street: ground, road, buildings, trees and everything else that nobody labels."""

from __future__ import annotations

import numpy as np

from lcf3d.simulation.clutter import thing
from lcf3d.simulation.furniture import furniture, street_trees, tree
from lcf3d.simulation.meshes import buildings
from lcf3d.simulation.meshes.primitives import Mesh
from lcf3d.simulation.roads import Path, strip
from lcf3d.simulation.roadside import BRICKS, ROOFS, WALLS, any_of, template
from lcf3d.simulation.site import KERB, Site, place
from lcf3d.simulation.surfaces import ground, surfaces


def build_scenery(site: Site, rng: np.random.Generator) -> Mesh:
    """All still meshes of a site, in the world."""
    parts = [*ground(site, rng), *surfaces(site)]
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
        parts.append(place(site, thing(rng), s, site.street.half_width + aside, side, lift))
    return parts


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
                    place(
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
    return buildings.house(width, float(rng.uniform(9, 12)), floors, gable, brick, colour, roof, rng)


def _beside(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """Everything that stands along one side of the main street."""
    if site.street.buildings == "woods":
        return _woods(site, side, rng)
    return [
        *_buildings(site, side, rng),
        *_background(site, side, rng),
        *street_trees(site, side, rng),
        *furniture(site, side, rng),
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
                place(
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
            parts.append(place(site, _building(site, float(rng.uniform(9, 15)), rng), s, offset, side))
        else:
            mesh = any_of("tree", rng).scaled(float(rng.uniform(0.9, 1.5)) * np.ones(3))
            parts.append(place(site, mesh, s, offset, side))
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
            piece = buildings.garden_wall(b - a, float(rng.uniform(0.5, 1.3)), bool(rng.random() < 0.4))
        else:
            piece = None
        if piece is not None:
            parts.append(place(site, piece, (a + b) / 2, edge, side, KERB * 0.8))
        for _ in range(int(rng.integers(1, 4))):
            size = rng.uniform(0.7, 1.8)
            bush = any_of("bush", rng).scaled(np.array([1.0, 1.0, rng.uniform(0.7, 1.2)]) * size / 1.2)
            parts.append(
                place(site, bush, float(rng.uniform(a, b)), edge + float(rng.uniform(0.9, 2.6)), side, KERB * 0.7)
            )
    if rng.random() < 0.75:
        parts.append(tree(site, float(rng.uniform(first, last)), edge + float(rng.uniform(1.5, 2.5)), side, rng, 0.7))
    return parts


def _woods(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """A country road: fields with single trees, or the edge of a wood; delineators and now and then a guard rail."""
    street = site.street
    parts = _background(site, side, rng) if rng.random() < 0.5 else []
    edge = street.half_width + 0.9
    for s in np.arange(site.first, site.last, 25.0):
        if not site.near_crossing(s, 2.0):
            parts.append(place(site, template("delineator", 0), float(s), edge, side))
    dense = rng.random() < 0.6
    if rng.random() < 0.2:
        a = float(rng.uniform(site.first, site.last - 40))
        for k in range(8):
            if not site.near_crossing(a + 4 * k, 4):
                parts.append(place(site, template("rail", 0), a + 4 * k, edge + 0.5, side))
    wall = street.half_width + street.verge
    for s in np.arange(site.first, site.last, 4.0):
        if site.near_crossing(s, 5.0):
            continue
        if dense:
            plants = any_of("fine_undergrowth" if site.is_near(s) else "undergrowth", rng)
            parts.append(place(site, plants, float(s), wall + 0.5 + float(rng.uniform(0, 1)), side))
        if rng.random() < (0.75 if dense else 0.06):
            offset = wall + float(rng.uniform(2.0, 7.0)) + (0 if dense else float(rng.uniform(2, 20)))
            parts.append(tree(site, float(s), offset, side, rng, 1.15))
        if dense and rng.random() < 0.5:
            parts.append(tree(site, float(s) + 2, wall + float(rng.uniform(7.0, 13.0)), side, rng, 1.3))
    return parts

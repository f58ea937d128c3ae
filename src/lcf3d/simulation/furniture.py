"""Lamps, signs and street furniture along a street, and its trees."""

from __future__ import annotations

import numpy as np

from lcf3d.simulation.meshes import street as build
from lcf3d.simulation.meshes.primitives import Mesh
from lcf3d.simulation.roadside import any_of, template
from lcf3d.simulation.site import KERB, Site, place


def furniture(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """Lamps, signs, bins, benches, bollards, shelters, hoardings and traffic lights."""
    street = site.street
    edge = street.half_width + 0.45
    parts = []
    lamp = any_of("lamp", rng)
    if side > 0 or street.lanes > 1:
        parts += [place(site, lamp, s, edge, side, KERB) for s in site.lamp_places(side)]
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
            place(site, template("bollard", 0), s + k * 1.4, edge - 0.05, side, KERB)
            for k in range(int(rng.integers(2, 6)))
        ]
    if pick == "bench":
        return [place(site, template("bench", 0).placed(0, 0, 0, -np.pi / 2), s, outer - 0.5, side, KERB)]
    if pick == "shelter":
        return [place(site, template("shelter", 0), s, outer - 1.6, side, KERB)]
    if pick == "bush":
        return [place(site, any_of("bush", rng), s, outer + 0.3, side, KERB)]
    return [place(site, template("bin", 0), s, edge + 0.1, side, KERB)]


def street_trees(site: Site, side: float, rng: np.random.Generator) -> list[Mesh]:
    """Trees in a row along one side of the street; none along some."""
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
            parts.append(tree(site, s, offset, side, rng))
        s += spacing * float(rng.uniform(0.8, 1.2))
    return parts


def tree(site: Site, s: float, offset: float, side: float, rng: np.random.Generator, scale: float = 1.0) -> Mesh:
    """A tree beside the street, with single leaves where the sensors come near."""
    size = float(rng.uniform(0.7, 1.3)) * scale
    fine = site.is_near(s) and offset < site.building_line + 6.0
    kind = "conifer" if rng.random() < 0.15 else "fine_tree" if fine else "tree"
    mesh = any_of(kind, rng).scaled(np.array([1, 1, rng.uniform(0.85, 1.15)]) * size)
    mesh = mesh.placed(0, 0, 0, float(rng.uniform(0, 6.28)))
    return place(site, mesh, s, offset, side, KERB * 0.7)

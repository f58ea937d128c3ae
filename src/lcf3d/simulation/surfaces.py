"""Ground, carriageway, kerbs, pavements and verges of a street."""

from __future__ import annotations

import numpy as np

from lcf3d.simulation.meshes.primitives import Mesh, make_mesh, quad
from lcf3d.simulation.roads import open_ground, skyline, strip
from lcf3d.simulation.site import KERB, Site

Colour = tuple[float, float, float]


def ground(site: Site, rng: np.random.Generator) -> list[Mesh]:
    """The open land around the street, up to the horizon."""
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


def surfaces(site: Site) -> list[Mesh]:
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
    xa, ya, _ = site.path.at(s, inner)
    xb, yb, _ = site.path.at(s, outer)
    za, zb = site.terrain.height(xa, ya), site.terrain.height(xb, yb)
    soup = quad((xa, ya, za - 0.05), (xb, yb, zb - 0.05), (xb, yb, zb + max(lift, 0)), (xa, ya, za + max(lift, 0)))
    return make_mesh(soup, "kerb", (0.33, 0.32, 0.31))

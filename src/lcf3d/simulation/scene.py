"""A whole scene: a site with its scenery and road users, frozen at any moment of a drive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.geometry.boxes import bev_corners
from lcf3d.simulation.actors import Actor, Motion
from lcf3d.simulation.crowds import add_people, add_vehicles
from lcf3d.simulation.materials import MATERIAL_ID
from lcf3d.simulation.meshes.primitives import Mesh
from lcf3d.simulation.obstacles import ObstacleMap
from lcf3d.simulation.rays import RayTracer
from lcf3d.simulation.roads import Path, make_terrain
from lcf3d.simulation.scenery import build_scenery
from lcf3d.simulation.site import Site
from lcf3d.simulation.streets import STREET_NAMES, STREETS
from lcf3d.simulation.traffic import Crowd, populate
from lcf3d.simulation.worlds import PLAIN, World

STEEPEST: Final = 0.10
"""Largest slope that a vehicle takes on."""
TILTING: Final = frozenset(
    ("car", "van", "truck", "bus", "tram", "trailer", "construction_vehicle", "cart", "cyclist", "motorcyclist")
)
"""Kinds that tilt with uneven ground; the others stand upright."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The triangles of a scene at one moment.

    Attributes:
        mesh: all triangles, in the world.
        owner: (T,) int32 id of the actor that a triangle belongs to, 0 for scenery.
    """

    mesh: Mesh
    owner: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Scene:
    """A street with everything on it.

    Attributes:
        site: the street.
        static: triangles that never move.
        actors: road users.
        ego: how the sensors travel.
        sun: (3,) unit vector towards the sun.
        cloudiness: 0 clear to 1 overcast.
        haze_m: distance at which the air has taken about two thirds of the contrast.
        look: seed of what depends on the light only (clouds).
    """

    site: Site
    static: Mesh
    actors: tuple[Actor, ...]
    ego: Motion
    sun: NDArray[np.float64]
    cloudiness: float
    haze_m: float
    look: int

    def at(self, time: float) -> Snapshot:
        """The scene ``time`` seconds into the drive."""
        footing = self._footing(time)
        meshes = [a.mesh(time, z, up) for a, (z, up) in zip(self.actors, footing, strict=True)]
        owner = [np.zeros(len(self.static), dtype=np.int32)]
        owner += [np.full(len(m), a.id, dtype=np.int32) for a, m in zip(self.actors, meshes, strict=True)]
        return Snapshot(Mesh.join([self.static, *meshes]), np.concatenate(owner))

    def boxes(self, time: float) -> NDArray[np.float64]:
        """(A, 7) world boxes of the actors; upright, also around vehicles that tilt with the ground."""
        footing = self._footing(time)
        boxes = [a.box(time, z, up) for a, (z, up) in zip(self.actors, footing, strict=True)]
        return np.array(boxes, dtype=np.float64).reshape(-1, 7)

    def _footing(self, time: float) -> list[tuple[float, NDArray[np.float64] | None]]:
        """World height on which each actor stands, and the direction of its up where that is not the vertical."""
        if not self.site.world.is_uneven:
            return [(z, None) for z in self.ground_below(time).tolist()]
        flat = np.array([a.box(time, 0.0) for a in self.actors], dtype=np.float64).reshape(-1, 7)
        forward = np.stack([np.cos(flat[:, 6]), np.sin(flat[:, 6])], axis=1)
        left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
        length, width = 0.36 * flat[:, 3:4], 0.42 * flat[:, 4:5]
        wheels = [flat[:, :2] + a * length * forward + b * width * left for a in (1, -1) for b in (1, -1)]
        z = self._heights(np.stack(wheels, axis=1).reshape(-1, 2)).reshape(-1, 4)
        ahead = (z[:, 0] + z[:, 1] - z[:, 2] - z[:, 3]) / (4 * length[:, 0])
        aside = (z[:, 0] + z[:, 2] - z[:, 1] - z[:, 3]) / (4 * width[:, 0])
        slope = ahead[:, None] * forward + aside[:, None] * left
        up = np.concatenate([-slope.clip(-STEEPEST, STEEPEST), np.ones((len(flat), 1))], axis=1)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        tilts = [a.kind in TILTING for a in self.actors]
        return [(float(h), u if tilt else None) for h, u, tilt in zip(z.mean(axis=1), up, tilts, strict=True)]

    def ground_below(self, time: float) -> NDArray[np.float64]:
        """(A,) world height on which each actor stands: the highest ground below its centre and corners."""
        flat = np.array([a.box(time, 0.0) for a in self.actors], dtype=np.float64).reshape(-1, 7)
        corners = bev_corners(flat)
        points = np.concatenate([corners, flat[:, None, :2]], axis=1).reshape(-1, 2)
        if not len(points):
            return np.zeros(0)
        result: NDArray[np.float64] = self._heights(points).reshape(-1, 5).max(axis=1)
        return result

    def _heights(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) world height of the roads, pavements and grass at (N, 2) places."""
        if not len(points):
            return np.zeros(0)
        origins = np.concatenate([points, np.full((len(points), 1), 20.0)], axis=1)
        hits = self._ground.first_hits(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
        heights: NDArray[np.float64] = np.where(
            hits.triangle >= 0, 20.0 - hits.distance, self.site.terrain.height(*points.T)
        )
        return heights

    @cached_property
    def _ground(self) -> RayTracer:
        """Rays onto roads, pavements and grass alone."""
        kinds = [MATERIAL_ID[name] for name in ("asphalt", "side_asphalt", "pavement", "cobbles", "grass", "earth")]
        return RayTracer(self.static.corners[np.isin(self.static.material, kinds)])


def build_scene(
    rng: np.random.Generator,
    dataset: str = "kitti",
    duration: float = 0.0,
    street: str | None = None,
    density: float = 1.0,
    world: World = PLAIN,
) -> Scene:
    """A random scene in which the sensors start at the world's origin, on the right-hand lane.

    Args:
        rng: random numbers; equal state gives an equal scene.
        dataset: ``kitti`` or ``nuscenes``, whose size statistics and mix of road users to follow.
        duration: length of the drive in seconds.
        street: a name of ``STREET_NAMES``; None draws one.
        density: factor on the number of road users.
        world: what the street holds beyond the ordinary.

    Raises:
        ConfigError: unknown street, a density that is not positive, or more road users than the street can hold.
    """
    if street is not None and street not in STREET_NAMES:
        raise ConfigError(f"unknown street {street!r}; use one of {', '.join(STREET_NAMES)}")
    if not 0 < density <= 100:
        raise ConfigError(f"density must lie above 0 and at most 100, got {density:g}")
    shares = np.array([s.share for s in STREETS])
    drawn = int(rng.choice(len(STREETS), p=shares / shares.sum()))
    kind = STREETS[drawn if street is None else STREET_NAMES.index(street)]
    speed = 0.0 if rng.random() < 0.18 else kind.speed * float(rng.uniform(0.5, 1.15))
    first, last = -75.0, 125.0 + speed * duration
    terrain = make_terrain(rng, world.relief_m)
    bend = 0.0 if rng.random() < 0.55 else float(rng.normal(0, 1 / 260))
    heading = 0.0
    drive = kind.half_width - (2.1 if kind.parking is not None else 0.0)
    lane = drive * (0.5 if kind.lanes == 1 else 0.74)
    path = Path((first, lane), heading, first - 5, last + 5, bend)
    crossings, sides = _crossings(path, kind.crossings, kind.half_width, last, rng)
    site = Site(kind, path, terrain, first, last, speed * duration, crossings, sides, world)
    ego = Motion(path, 0.0, -lane, speed)
    static = build_scenery(site, rng)
    x, y, _ = path.at(np.array([first, 0.0, last / 2, last]))
    reach = 60.0
    obstacles = ObstacleMap(static, terrain, (x.min() - reach, y.min() - reach), (x.max() + reach, y.max() + reach))
    crowd = Crowd(site, obstacles, dataset, duration, rng, ego, world.large, world.varied_people)
    if world != PLAIN:
        add_vehicles(crowd, world)
    populate(crowd, density * world.density)
    if world != PLAIN:
        add_people(crowd, world)
    cloudiness = float(np.clip(rng.beta(1.1, 1.6), 0, 1))
    azimuth, elevation = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(24, 58))
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return Scene(
        site, static, tuple(crowd.actors), ego, sun, cloudiness, float(rng.uniform(350, 1400)), int(rng.integers(2**31))
    )


def _crossings(
    path: Path, chance: float, half_width: float, last: float, rng: np.random.Generator
) -> tuple[tuple[tuple[float, float], ...], tuple[Path, ...]]:
    """Side streets: where, how wide, and their centre lines to both sides."""
    places: list[tuple[float, float]] = []
    sides: list[Path] = []
    s = float(rng.uniform(14, 60))
    while s < last - 15 and len(places) < 3:
        if rng.random() < chance:
            half = float(rng.uniform(2.8, 3.8))
            places.append((s, half))
            x, y, heading = path.at(s)
            for way in (1.0, -1.0):
                sides.append(Path((float(x), float(y)), float(heading) + way * np.pi / 2, 0.0, half_width + 75.0))
        s += float(rng.uniform(45, 90))
    return tuple(places), tuple(sides)

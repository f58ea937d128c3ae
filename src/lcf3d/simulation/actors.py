"""Road users: what they look like, how large they are and how they move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.meshes import outfits, people, two_wheelers, vehicles
from lcf3d.simulation.meshes.car_shapes import SHAPES
from lcf3d.simulation.meshes.cars import build_car
from lcf3d.simulation.meshes.primitives import Mesh, rotation_z
from lcf3d.simulation.roads import Path
from lcf3d.simulation.sizes import draw_size
from lcf3d.simulation.worlds import level_from_tilted

Colour = tuple[float, float, float]

CAR_COLOURS: Final[tuple[tuple[float, Colour], ...]] = (
    (0.17, (0.72, 0.72, 0.70)),
    (0.22, (0.36, 0.37, 0.38)),
    (0.13, (0.13, 0.135, 0.14)),
    (0.19, (0.012, 0.012, 0.014)),
    (0.10, (0.02, 0.045, 0.16)),
    (0.07, (0.36, 0.015, 0.015)),
    (0.03, (0.03, 0.12, 0.06)),
    (0.03, (0.45, 0.33, 0.20)),
    (0.02, (0.60, 0.38, 0.02)),
    (0.04, (0.10, 0.20, 0.34)),
)
"""Share and linear RGB of car colours."""

KINDS: Final[tuple[str, ...]] = (
    "car",
    "van",
    "truck",
    "bus",
    "tram",
    "trailer",
    "construction_vehicle",
    "pedestrian",
    "sitting",
    "cyclist",
    "bicycle",
    "motorcyclist",
    "motorcycle",
    "cone",
    "barrier",
    "cart",
)
"""What can be put on a street."""

KITTI_CLASS: Final[dict[str, str | None]] = {
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Truck",
    "tram": "Tram",
    "trailer": "Misc",
    "construction_vehicle": "Misc",
    "pedestrian": "Pedestrian",
    "sitting": "Person_sitting",
    "cyclist": "Cyclist",
    "bicycle": None,
    "motorcyclist": "Cyclist",
    "motorcycle": None,
    "cone": None,
    "barrier": None,
    "cart": "Misc",
}
"""KITTI class of every kind; None is not annotated."""

NUSCENES_CLASS: Final[dict[str, str]] = {
    "car": "car",
    "van": "car",
    "truck": "truck",
    "bus": "bus",
    "tram": "bus",
    "trailer": "trailer",
    "construction_vehicle": "construction_vehicle",
    "pedestrian": "pedestrian",
    "sitting": "pedestrian",
    "cyclist": "bicycle",
    "bicycle": "bicycle",
    "motorcyclist": "motorcycle",
    "motorcycle": "motorcycle",
    "cone": "traffic_cone",
    "barrier": "barrier",
    "cart": "trailer",
}
"""nuScenes detection class of every kind."""


@dataclass(frozen=True)
class Motion:
    """Travel along a path at constant speed.

    Attributes:
        path: where.
        start: arc length at time 0.
        offset: metres left of the path.
        speed: m/s; negative goes against the path's direction.
        turn: heading of the object relative to its direction of travel (or to the path when it stands still).
    """

    path: Path
    start: float
    offset: float
    speed: float = 0.0
    turn: float = 0.0

    def pose(self, time: float) -> tuple[float, float, float]:
        """World x, y and yaw at ``time`` seconds."""
        x, y, heading = self.path.at(self.start + self.speed * time, self.offset)
        yaw = float(heading) + (np.pi if self.speed < 0 else 0.0) + self.turn
        return float(x), float(y), float(np.arctan2(np.sin(yaw), np.cos(yaw)))

    def velocity(self, time: float) -> tuple[float, float]:
        """World velocity in m/s."""
        before, after = self.pose(time - 0.05), self.pose(time + 0.05)
        return (after[0] - before[0]) / 0.1, (after[1] - before[1]) / 0.1


@dataclass(frozen=True)
class Actor:
    """One labelled thing in the scene.

    Attributes:
        id: number of the track, from 1, unique in the scene.
        kind: one of ``KINDS``.
        size: (length, width, height) in metres.
        motion: how it moves.
        mesh_at: mesh in its own frame (x forward, standing on z = 0) at a time in seconds; it fills the size.
        stopped: a vehicle that stands in traffic instead of being parked.
    """

    id: int
    kind: str
    size: tuple[float, float, float]
    motion: Motion
    mesh_at: Callable[[float], Mesh]
    stopped: bool = False

    def box(
        self, time: float, ground: float, up: NDArray[np.float64] | None = None
    ) -> tuple[float, float, float, float, float, float, float]:
        """World box (x, y, z of the geometric centre, length, width, height, yaw), standing at height ``ground``.

        ``up`` (3,) is where the object's own vertical points, None for straight up; the box is upright all the same.
        """
        x, y, yaw = self.motion.pose(time)
        length, width, height = self.size
        if up is None:
            return x, y, ground + height / 2, length, width, height, yaw
        centre = np.array([x, y, ground]) + up * height / 2
        return float(centre[0]), float(centre[1]), float(centre[2]), length, width, height, yaw

    def mesh(self, time: float, ground: float, up: NDArray[np.float64] | None = None) -> Mesh:
        """Mesh in the world, standing at height ``ground``, its vertical along ``up`` (3,) or straight up."""
        x, y, yaw = self.motion.pose(time)
        if up is None:
            return self.mesh_at(time).placed(x, y, ground, yaw)
        return self.mesh_at(time).turned(level_from_tilted(up).T @ rotation_z(yaw)).moved((x, y, ground))


def _colour(rng: np.random.Generator) -> Colour:
    shares = np.array([share for share, _ in CAR_COLOURS])
    base = np.array(CAR_COLOURS[rng.choice(len(shares), p=shares / shares.sum())][1])
    varied = np.clip(base * rng.uniform(0.8, 1.2) + rng.uniform(-0.004, 0.004, 3), 0.008, 0.8)
    return float(varied[0]), float(varied[1]), float(varied[2])


@lru_cache(maxsize=16)
def _car_template(shape: str, fine: bool) -> Mesh:
    return build_car(SHAPES[shape], fine)


@lru_cache(maxsize=8)
def _large_template(kind: str, variant: int) -> Mesh:
    if kind == "truck":
        load, colour = (
            ("container", (0.62, 0.62, 0.60)),
            ("tarpaulin", (0.05, 0.14, 0.34)),
            ("tarpaulin", (0.5, 0.06, 0.04)),
        )[variant]
        return vehicles.truck(8.6, 2.5, 3.4, load, colour)
    if kind == "bus":
        return vehicles.bus(10.6, 2.6, 3.2)
    if kind == "tram":
        return vehicles.tram(15.5 if variant else 22.0, 2.4, 3.5)
    if kind == "trailer":
        return vehicles.trailer(11.5, 2.6, 3.8, ((0.5, 0.5, 0.48), (0.06, 0.2, 0.1), (0.4, 0.25, 0.05))[variant])
    return vehicles.excavator(6.4, 2.8, 3.2)


def _vehicle_mesh(kind: str, size: tuple[float, float, float], fine: bool, rng: np.random.Generator) -> Mesh:
    """A vehicle of the size: the template nearest in proportions, stretched to fit and painted."""
    if kind in ("truck", "bus", "tram", "trailer", "construction_vehicle"):
        template = _large_template(
            kind, int(rng.integers(2 if kind == "tram" else 3 if kind in ("truck", "trailer") else 1))
        )
    else:
        names = ("van", "bus_van") if kind == "van" else ("hatchback", "small", "saloon", "estate", "suv", "minivan")
        ratios = np.array([size[2] / size[0] - SHAPES[n].size[2] / SHAPES[n].size[0] for n in names])
        weights = np.exp(-((ratios / 0.035) ** 2)) + 0.04
        template = _car_template(names[rng.choice(len(names), p=weights / weights.sum())], fine)
    return template.painted([_colour(rng)]).fitted(*size)


_PHASES: Final = 8
_STYLES: Final = 20


@lru_cache(maxsize=256)
def _person_template(kind: str, style: int, phase: int, stride: float) -> Mesh:
    """A body in one of ``_STYLES`` kinds of clothing at one of ``_PHASES`` moments of a step, colours left open."""
    rng = np.random.default_rng(1000 + style)
    clothes = people.random_style(rng, open_colours=True)
    angle = 2 * np.pi * phase / _PHASES
    if kind == "pedestrian":
        return people.pedestrian(clothes, angle, stride)
    return two_wheelers.cyclist(clothes, two_wheelers.BIKE_SLOT, angle, float(rng.uniform(0.2, 0.7)))


@lru_cache(maxsize=256)
def _person_bounds(kind: str, style: int, stride: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lowest and highest corner over a whole step."""
    bounds = [_person_template(kind, style, p, stride).bounds() for p in range(_PHASES)]
    low, high = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
    return tuple(low.tolist()), tuple(high.tolist())


def _person_mesh(
    kind: str, size: tuple[float, float, float], speed: float, rng: np.random.Generator
) -> Callable[[float], Mesh]:
    """Mesh over time of a person (on foot or riding), with the same stretch at every step."""
    style, phase = int(rng.integers(_STYLES)), int(rng.integers(_PHASES))
    palette = [*people.random_palette(rng), _colour(rng)]
    stride = 0.0 if speed == 0 or kind != "pedestrian" else 0.36 if abs(speed) < 1.3 else 0.5
    rate = _PHASES * (0.9 if kind == "pedestrian" else 1.1) * (1 if speed else 0)
    low, high = (np.array(v) for v in _person_bounds(kind, style, stride))
    factor = np.array(size) / (high - low)
    if kind == "pedestrian":  # a wide box is empty space around somebody who keeps the proportions of a body
        factor[:2] = np.minimum(factor[:2], factor[2] * 1.2)
    centre = (low + high) / 2
    offset = np.array([-centre[0], -centre[1], -low[2]])
    limit = np.array([size[0] / 2, size[1] / 2, size[2]])

    def mesh_at(time: float) -> Mesh:
        template = _person_template(kind, style, int(phase + rate * time) % _PHASES, stride)
        mesh = template.painted(palette).moved(offset).scaled(factor)
        corners = np.clip(mesh.corners, (-limit * [1, 1, 0]).astype(np.float32), limit.astype(np.float32))
        return replace(mesh, corners=corners)

    return mesh_at


def _varied_person_mesh(
    kind: str, size: tuple[float, float, float], speed: float, rng: np.random.Generator
) -> Callable[[float], Mesh]:
    """As `_person_mesh`, of somebody who is like nobody else; slower, because nothing is kept for others."""
    outfit, frame, phase = outfits.random_outfit(rng), _colour(rng), float(rng.uniform(0, 2 * np.pi))
    stride = float(rng.uniform(0.26, 0.62)) if speed else float(rng.choice([0.0, 0.08, 0.16]))
    rate = 2 * np.pi * (0.9 if kind == "pedestrian" else 1.1) * float(rng.uniform(0.85, 1.15)) * (1 if speed else 0)

    def built(angle: float) -> Mesh:
        if kind == "pedestrian":
            return outfits.varied_pedestrian(outfit, angle, stride)
        return outfits.varied_cyclist(outfit, frame, angle)

    low, high = built(np.pi / 2 if kind == "pedestrian" else 0.0).bounds()  # the widest moment of a step
    factor = np.array(size) / (high - low)
    if kind == "pedestrian":
        factor[:2] = np.minimum(factor[:2], factor[2] * 1.2)
    centre = (low + high) / 2
    limit = np.array([size[0] / 2, size[1] / 2, size[2]], dtype=np.float32)

    def mesh_at(time: float) -> Mesh:
        mesh = built(phase + rate * time)
        mesh = mesh.moved((-centre[0], -centre[1], -low[2])).scaled(
            factor * [1, 1, (high - low)[2] / mesh.bounds()[1][2]]
        )
        return replace(mesh, corners=np.clip(mesh.corners, -limit * [1, 1, 0], limit).astype(np.float32))

    return mesh_at


def make_actor(
    id: int,
    kind: str,
    motion: Motion,
    rng: np.random.Generator,
    dataset: str = "kitti",
    size: tuple[float, float, float] | None = None,
    stopped: bool = False,
    fine: bool = True,
    varied: bool = False,
) -> Actor:
    """A road user of a kind, with size, shape and colours drawn at random.

    ``dataset`` (``kitti`` or ``nuscenes``) names the statistics its size is drawn from; ``fine`` False makes
    cars coarser, for those that stay far away; ``varied`` gives every person clothes, arms and a gait of their own.
    """
    if size is None:
        size = actor_size(kind, dataset, rng)
    if kind in ("pedestrian", "cyclist"):
        person = _varied_person_mesh if varied else _person_mesh
        return Actor(id, kind, size, motion, person(kind, size, motion.speed, rng), stopped)
    mesh = _still_mesh(kind, size, fine, rng)
    return Actor(id, kind, size, motion, lambda _time: mesh, stopped)


def _still_mesh(kind: str, size: tuple[float, float, float], fine: bool, rng: np.random.Generator) -> Mesh:
    """Mesh of what does not change its shape."""
    if kind == "sitting":
        return people.sitting_person(people.random_style(rng)).fitted(*size)
    if kind == "bicycle":
        return two_wheelers.bicycle(_colour(rng)).fitted(*size)
    if kind == "motorcycle":
        return two_wheelers.motorcycle(_colour(rng)).fitted(*size)
    if kind == "motorcyclist":
        return two_wheelers.motorcyclist(people.random_style(rng), _colour(rng)).fitted(*size)
    if kind == "cone":
        return vehicles.traffic_cone().fitted(*size)
    if kind == "barrier":
        return vehicles.barrier(int(rng.integers(2))).fitted(*size)
    if kind == "cart":
        return vehicles.pushcart(_colour(rng)).fitted(*size)
    return _vehicle_mesh(kind, size, fine, rng)


def actor_size(kind: str, dataset: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """Size by kind, from the class of the dataset it is labelled as where that has a size of its own."""
    special = {
        "cyclist": "Cyclist",
        "van": "Van",
        "tram": "Tram",
        "sitting": "Person_sitting",
        "bus": "bus",
        "motorcycle": "motorcycle",
        "bicycle": "bicycle",
        "trailer": "trailer",
        "construction_vehicle": "construction_vehicle",
        "cone": "traffic_cone",
        "barrier": "barrier",
    }
    if kind == "motorcyclist":
        length, width, _ = draw_size("motorcycle", rng)
        return length, width, round(float(rng.uniform(1.55, 1.8)), 2)
    if kind == "cart":
        factor = rng.uniform(0.85, 1.2)
        return round(2.0 * factor, 2), round(1.3 * factor, 2), round(1.3 * factor, 2)
    name = special.get(kind) or (NUSCENES_CLASS[kind] if dataset == "nuscenes" else KITTI_CLASS[kind])
    return draw_size(str(name), rng)

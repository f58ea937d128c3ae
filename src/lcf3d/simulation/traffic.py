"""Who is on the street: parked and moving vehicles, people on pavements and crossings, two-wheelers, road works."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.simulation.actors import Actor, Motion, actor_size, make_actor
from lcf3d.simulation.obstacles import ObstacleMap
from lcf3d.simulation.roads import Path
from lcf3d.simulation.site import Site

_TRIES = 12
ALWAYS_PLACED: Final = 5.0
"""Up to this density a street takes whom it can hold; beyond, one that cannot hold half of them is refused."""


@dataclass
class Crowd:
    """Actors placed so far, with a check that they touch neither one another nor the scenery.

    Attributes:
        site: the street.
        obstacles: where the scenery stands.
        dataset: ``kitti`` or ``nuscenes``, names the size statistics.
        duration: seconds over which actors must keep clear.
        rng: random numbers.
        ego: how the sensors' car moves.
        large: factor on the share of vehicles that are no cars.
        varied: people with clothes and a gait of their own.
        actors: what has been placed.
        refused: how many could not be placed.
    """

    site: Site
    obstacles: ObstacleMap
    dataset: str
    duration: float
    rng: np.random.Generator
    ego: Motion
    large: float = 1.0
    varied: bool = False
    actors: list[Actor] = field(default_factory=list)
    refused: int = 0

    def __post_init__(self) -> None:
        self._discs = self._track(self.ego, (4.6, 1.9, 1.6), 3)
        self._ego_track = self._discs

    def _track(self, motion: Motion, size: tuple[float, float, float], moments: int) -> NDArray[np.float64]:
        """(T, K, 3) discs (x, y, radius) that cover the footprint at evenly spaced moments of the drive."""
        length, width, _ = size
        count = max(1, int(np.ceil(length / max(width, 0.7))))
        along = (np.arange(count) + 0.5) / count * length - length / 2
        radius = np.hypot(length / count, width) / 2
        result = []
        for time in np.linspace(0.0, self.duration, moments):
            x, y, yaw = motion.pose(float(time))
            result.append(np.stack([x + np.cos(yaw) * along, y + np.sin(yaw) * along, np.full(count, radius)], axis=1))
        return np.array(result)

    def _is_clear(
        self, motion: Motion, size: tuple[float, float, float], track: NDArray[np.float64], margin: float
    ) -> bool:
        gap = np.linalg.norm(track[:, :, None, :2] - self._discs[:, None, :, :2], axis=3)
        if np.any(gap < track[:, :, None, 2] + self._discs[:, None, :, 2] + margin):
            return False
        steps = 1 if motion.speed == 0 else 2 + int(abs(motion.speed) * self.duration / 0.5)
        return all(self.obstacles.is_free(motion.pose(float(t)), size) for t in np.linspace(0, self.duration, steps))

    def add(self, kind: str, motion: Callable[..., Motion], margin: float = 0.15, stopped: bool = False) -> bool:
        """Place an actor on the first of several drawn motions that is clear; False when none is."""
        size = actor_size(kind, self.dataset, self.rng)
        for _ in range(_TRIES):
            m = motion()
            track = self._track(m, size, 3)
            if self._is_clear(m, size, track, margin):
                fine = bool(np.linalg.norm(track[:, 0, :2] - self._ego_track[:, 0, :2], axis=1).min() < 40.0)
                id = len(self.actors) + 1
                self.actors.append(make_actor(id, kind, m, self.rng, self.dataset, size, stopped, fine, self.varied))
                self._discs = np.concatenate([self._discs, track], axis=1)
                return True
        self.refused += 1
        return False


def populate(crowd: Crowd, density: float) -> None:
    """Add the ordinary road users of a street; ``density`` multiplies their number.

    Raises:
        ConfigError: many times more than usual are asked for, and over half of them find no free place.
    """
    _moving_traffic(crowd, density)
    _parked(crowd, density)
    _side_traffic(crowd, density)
    _people(crowd, density)
    _two_wheelers(crowd, density)
    if crowd.rng.random() < (0.30 if crowd.dataset == "nuscenes" else 0.10):
        _road_works(crowd)
    # at ordinary densities a street that turns out narrow is just an emptier street
    if density > ALWAYS_PLACED and crowd.refused > max(6, len(crowd.actors)):
        raise ConfigError(
            f"only {len(crowd.actors)} of {len(crowd.actors) + crowd.refused} road users found a free place on a "
            f"street of type {crowd.site.street.name!r}; use a density below {density:g}"
        )


def _count(rng: np.random.Generator, mean: float) -> int:
    """An over-dispersed count: streets are empty or busy more often than a Poisson law says."""
    return int(rng.poisson(mean * rng.gamma(1.6, 1 / 1.6)))


def vehicle_kind(crowd: Crowd, parked: bool) -> str:
    """A kind of vehicle, drawn by its frequency among those that are parked or move."""
    kinds = ["car", "van", "truck", "bus", "tram", "trailer", "construction_vehicle", "cart"]
    if crowd.dataset == "nuscenes":
        shares = [0.80, 0.05, 0.08, 0.025, 0.0, 0.02, 0.015, 0.01]
    else:
        shares = (
            [0.90, 0.045, 0.010, 0.002, 0.0, 0.003, 0.003, 0.02]
            if parked
            else [0.80, 0.065, 0.035, 0.012, 0.012, 0.006, 0.0, 0.01]
        )
    if crowd.large != 1:
        shares = [shares[0], *(crowd.large * share for share in shares[1:])]
    return str(crowd.rng.choice(kinds, p=np.array(shares) / sum(shares)))


def _moving_traffic(crowd: Crowd, density: float) -> None:
    site, street, rng = crowd.site, crowd.site.street, crowd.rng
    length = (site.last - site.first) / 100
    drive = street.half_width - (2.1 if street.parking is not None else 0.0)
    lanes = [(k + 0.5) * drive / street.lanes for k in range(street.lanes)]
    for direction in (1.0, -1.0):
        for lane in lanes:
            speed = abs(crowd.ego.speed) if direction > 0 else street.speed * float(rng.uniform(0.6, 1.2))
            standing = speed < 0.5
            for _ in range(_count(rng, street.moving_per_100m * length * density / street.lanes)):
                kind = vehicle_kind(crowd, False)

                def motion(direction: float = direction, lane: float = lane, speed: float = speed) -> Motion:
                    s = float(rng.uniform(site.first + 8, site.last - 8))
                    if rng.random() < 0.45:  # denser around the sensors, which real recordings seek out
                        s = float(np.clip(rng.normal(20 + site.travel / 2, 18), site.first + 8, site.last - 8))
                    return Motion(
                        site.path,
                        s,
                        -direction * (lane + float(rng.normal(0, 0.15))),
                        direction * speed,
                        0.0 if speed or direction > 0 else np.pi,
                    )

                crowd.add(kind, motion, 1.5 + 0.3 * speed, standing)


def _parked(crowd: Crowd, density: float) -> None:
    site, street, rng = crowd.site, crowd.site.street, crowd.rng
    if street.parking is not None:
        for side in (1.0, -1.0):
            fill = float(np.clip(street.parking * density * rng.uniform(0.1, 2.0), 0, 0.95))
            s = site.first + 3.0
            while s < site.last - 3:
                s += float(rng.uniform(5.2, 6.4))
                if rng.random() > fill or site.near_crossing(s, 5.0) or abs(s - site.zebra()) < 5:
                    continue
                _park(crowd, s, side * (street.half_width - 1.05), side)
        return
    for _ in range(_count(rng, (1.6 if street.buildings == "few" else 0.35) * density)):
        side = float(rng.choice([-1.0, 1.0]))
        s = float(rng.uniform(site.first, site.last))
        if street.pavement >= 5 and not site.near_crossing(s, 6):
            _park(crowd, s, side * (street.half_width + 1.3), side)
        elif street.buildings == "few" and not site.near_crossing(s, 12):
            turn = float(rng.choice([0.0, np.pi / 2, -np.pi / 2])) + float(rng.normal(0, 0.06))
            place = side * (street.half_width + street.pavement + street.verge + float(rng.uniform(2.5, 8)))
            for k in range(int(rng.integers(1, 5))):
                crowd.add(
                    vehicle_kind(crowd, True),
                    lambda k=k, s=s, p=place, t=turn: Motion(site.path, s + 2.9 * k, p, 0.0, t),
                )


def _park(crowd: Crowd, s: float, offset: float, side: float) -> None:
    rng = crowd.rng
    facing = 0.0 if (side < 0) == (rng.random() < 0.85) else np.pi
    kind = vehicle_kind(crowd, True)

    def motion() -> Motion:
        return Motion(
            crowd.site.path,
            s + float(rng.normal(0, 0.2)),
            offset + float(rng.normal(0, 0.1)),
            0.0,
            facing + float(rng.normal(0, 0.03)),
        )

    if kind in ("trailer", "truck", "bus", "construction_vehicle") and rng.random() < 0.5:
        kind = "car"
    crowd.add(kind, motion, 0.1)


def _side_traffic(crowd: Crowd, density: float) -> None:
    """Vehicles that wait in, come out of or are parked along the side streets, across the main direction."""
    site, rng = crowd.site, crowd.rng
    for number, path in enumerate(site.side_paths):
        half = site.crossings[number // 2][1]
        if rng.random() < 0.45 * density:
            crowd.add(
                vehicle_kind(crowd, False),
                lambda p=path, h=half: Motion(
                    p, site.street.half_width + float(rng.uniform(4.5, 14)), h * 0.5, 0.0, np.pi
                ),
                0.3,
                True,
            )
        for _ in range(_count(rng, 2.0 * density)):
            side = float(rng.choice([-1.0, 1.0]))
            crowd.add(
                vehicle_kind(crowd, True),
                lambda p=path, h=half, q=side: Motion(
                    p,
                    float(rng.uniform(site.building_line + 4, p.last - 6)),
                    q * (h - 1.0),
                    0.0,
                    float(rng.choice([0.0, np.pi])),
                ),
            )


def _people(crowd: Crowd, density: float) -> None:
    site, street, rng = crowd.site, crowd.site.street, crowd.rng
    length = (site.last - site.first) / 100
    width = street.pavement if street.pavement else 1.2
    for _ in range(_count(rng, street.pedestrians_per_100m * length * density / 1.7)):
        side, way = float(rng.choice([-1.0, 1.0])), float(rng.choice([-1.0, 1.0]))
        s0 = float(rng.uniform(site.first + 5, site.last - 5))
        if rng.random() < 0.45:  # as for vehicles: recordings were picked for what is near
            s0 = float(rng.normal(16 + site.travel / 2, 10))
        speed = way * float(rng.uniform(0.9, 1.7)) if rng.random() < 0.78 else 0.0
        turn = 0.0 if speed else float(rng.uniform(-np.pi, np.pi))
        first = street.half_width + float(rng.uniform(0.45, max(0.6, width - 0.4)))
        for member in range(int(rng.choice([1, 2, 3, 4], p=[0.62, 0.25, 0.09, 0.04]))):
            crowd.add(
                "pedestrian",
                lambda m=member, s=s0, a=first, v=speed, t=turn, q=side: Motion(
                    site.path,
                    s + 0.35 * (m // 2) * 2 + float(rng.normal(0, 0.3)),
                    q * (a + 0.7 * (m % 2) + float(rng.normal(0, 0.1))),
                    v,
                    t + float(rng.normal(0, 0.1)),
                ),
                0.05,
            )
    _crossing_people(crowd, density)
    if street.pavement >= 3 and rng.random() < 0.07 * density:
        side, s = float(rng.choice([-1.0, 1.0])), float(rng.uniform(8, 35))
        for k in range(int(rng.integers(1, 5))):
            crowd.add(
                "sitting",
                lambda k=k, q=side, s=s: Motion(
                    site.path, s + 0.8 * k, q * (street.half_width + street.pavement - 0.6), 0.0, -q * np.pi / 2
                ),
                0.0,
            )


def _crossing_people(crowd: Crowd, density: float) -> None:
    """People on the zebra crossing, or crossing anywhere."""
    site, street, rng = crowd.site, crowd.site.street, crowd.rng
    if street.pavement == 0:
        return
    for _ in range(_count(rng, 0.5 * density * min(2.0, street.pedestrians_per_100m / 3))):
        s = site.zebra() if site.zebra() < site.last and rng.random() < 0.6 else float(rng.uniform(6, 45))
        x, y, heading = (float(v) for v in site.path.at(s + float(rng.normal(0, 0.7))))
        direction = heading + float(rng.choice([-1.0, 1.0])) * np.pi / 2
        line = Path((x - 40 * np.cos(direction), y - 40 * np.sin(direction)), direction, 0.0, 80.0)
        speed = float(rng.uniform(1.0, 1.7))
        crowd.add(
            "pedestrian", lambda p=line, v=speed: Motion(p, 40 + float(rng.uniform(-1, 1)) * street.half_width, 0.0, v)
        )


def _two_wheelers(crowd: Crowd, density: float) -> None:
    site, street, rng = crowd.site, crowd.site.street, crowd.rng
    length = (site.last - site.first) / 100
    parked_strip = 2.1 if street.parking is not None else 0.0
    for _ in range(_count(rng, street.cyclists_per_100m * length * density)):
        kind = "motorcyclist" if rng.random() < (0.35 if crowd.dataset == "nuscenes" else 0.06) else "cyclist"
        way = float(rng.choice([-1.0, 1.0]))
        speed = way * (float(rng.uniform(3.0, 6.0)) if kind == "cyclist" else street.speed * 0.9)
        offset = -way * (street.half_width - parked_strip - float(rng.uniform(0.45, 0.9)))
        if street.pavement >= 3 and kind == "cyclist" and rng.random() < 0.35:
            offset = -way * (street.half_width + float(rng.uniform(0.6, street.pavement - 0.6)))
        crowd.add(
            kind,
            lambda o=offset, v=speed: Motion(
                site.path, float(rng.uniform(site.first + 5, site.last - 5)), o, v, float(rng.normal(0, 0.04))
            ),
            0.2,
        )
    if street.pavement:
        for _ in range(_count(rng, 1.1 * density)):
            side, s = float(rng.choice([-1.0, 1.0])), float(rng.uniform(site.first, site.last))
            kind = "motorcycle" if rng.random() < 0.25 else "bicycle"
            for k in range(int(rng.integers(1, 4))):
                crowd.add(
                    kind,
                    lambda k=k, q=side, s=s: Motion(
                        site.path,
                        s + 0.75 * k,
                        q * (street.half_width + street.pavement - 1.1),
                        0.0,
                        np.pi / 2 + float(rng.normal(0, 0.12)),
                    ),
                    0.02,
                )


def _road_works(crowd: Crowd) -> None:
    """Cones and barriers around a closed patch of the road, now and then with an excavator."""
    site, street, rng = crowd.site, crowd.site.street, crowd.rng
    s0, side = float(rng.uniform(14, 50)), float(rng.choice([-1.0, 1.0]))
    offset = side * (street.half_width + 0.7)
    for k in range(int(rng.integers(3, 7))):
        crowd.add("cone", lambda k=k: Motion(site.path, s0 - 8 + 2.6 * k, offset - side * 0.25 * k, 0.0), 0.02)
    for k in range(int(rng.integers(1, 4))):
        crowd.add("barrier", lambda k=k: Motion(site.path, s0 + 10.5 + 2.8 * k, offset, 0.0, np.pi / 2), 0.02)
    if rng.random() < 0.5:
        crowd.add(
            "construction_vehicle",
            lambda: Motion(site.path, s0 + 22, offset + side * 2.5, 0.0, float(rng.uniform(-0.6, 0.6))),
            0.1,
        )

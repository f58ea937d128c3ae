"""Road users that training needs and streets are short of: people and riders near the sensors, queues, parked rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.actors import Motion
from lcf3d.simulation.roads import Path
from lcf3d.simulation.traffic import Crowd, vehicle_kind
from lcf3d.simulation.worlds import World

PEOPLE_RANGE_M: Final = (4.5, 52.0)
"""Nearest and farthest distance of additional people; the logarithm of the distance is spread evenly between them.

That gives KITTI's mix of heights: 43 % of people over 100 pixels, 30 % from 50 to 100, 27 % from 25 to 50.
"""
RIDERS_RANGE_M: Final = (6.0, 62.0)
_BEHIND: Final = 0.22
_PLACES: Final = ("walking", "group", "crossing", "parked", "door", "sitting", "yard", "hidden")
_PLACE_SHARES: Final = (0.25, 0.18, 0.13, 0.14, 0.04, 0.04, 0.07, 0.15)
_RIDES: Final = ("edge", "pavement", "crossing", "waiting", "abreast", "hidden")
_RIDE_SHARES: Final = (0.34, 0.16, 0.13, 0.08, 0.14, 0.15)


def add_vehicles(crowd: Crowd, world: World) -> None:
    """Add the queues and rows of ``world`` to a street, before its ordinary road users."""
    _queues(crowd, world)
    _rows(crowd, world)


def add_people(crowd: Crowd, world: World) -> None:
    """Add the riders, people and parked two-wheelers of ``world`` to a street, after all vehicles."""
    rng = crowd.rng
    for _ in range(int(rng.poisson(world.riders))):
        _ride(crowd)
    for _ in range(int(rng.poisson(world.people / 1.5))):  # groups make one and a half of each
        _person(crowd)
    for _ in range(int(rng.poisson(world.two_wheelers))):
        _parked_two_wheelers(crowd)


def _distance(crowd: Crowd, limits: tuple[float, float]) -> float:
    """Arc length of a place around the sensors, seen from the middle of their travel."""
    rng = crowd.rng
    low, high = np.log(limits)
    distance = float(np.exp(rng.uniform(low, high)))
    middle = crowd.site.travel * float(rng.random())
    return middle + (-distance if rng.random() < _BEHIND else distance)


def _across(crowd: Crowd, s: float, start: float, speed: float) -> Motion:
    """Motion straight across the street at arc length ``s``, ``start`` metres left of its middle at time 0."""
    x, y, heading = (float(v) for v in crowd.site.path.at(s))
    direction = heading + np.pi / 2
    line = Path((x - 60 * np.cos(direction), y - 60 * np.sin(direction)), direction, 0.0, 120.0)
    return Motion(line, 60.0 + start, 0.0, speed)


def _behind(crowd: Crowd, speed: float, turn: float) -> Motion:
    """Motion of somebody who is half hidden from the sensors by one of the road users already there."""
    rng = crowd.rng
    x, y, _ = crowd.ego.pose(crowd.duration / 2)
    others = np.array([a.motion.pose(crowd.duration / 2) for a in crowd.actors]).reshape(-1, 3)
    along, left, _ = _road_coordinates(crowd, others)
    near = np.flatnonzero((along > 4) & (along < 38) & (np.abs(left) < 16))
    if not len(near):
        return Motion(crowd.site.path, crowd.site.travel / 2 + float(rng.uniform(8, 40)), 3.0, speed, turn)
    chosen = int(rng.choice(near))
    kind, (length, width, _) = crowd.actors[chosen].kind, crowd.actors[chosen].size
    sight = others[chosen, :2] - [x, y]
    sight /= np.linalg.norm(sight)
    beyond = (
        width if kind in ("pedestrian", "cyclist") else float(rng.uniform(min(width, length), max(width, length)))
    ) / 2
    aside = float(rng.normal(0, 0.25 + 0.3 * width))
    place = (
        others[chosen, :2] + sight * (beyond + float(rng.uniform(0.4, 3.0))) + aside * np.array([-sight[1], sight[0]])
    )
    s, offset = (float(v[0]) for v in _road_coordinates(crowd, np.array([[*place, 0.0]]))[:2])
    return Motion(crowd.site.path, crowd.site.travel / 2 + s - speed * crowd.duration / 2, offset, speed, turn)


def _road_coordinates(crowd: Crowd, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Arc length from the middle of the sensors' travel, metres left of it, heading, of (N, 3) poses."""
    s = np.arange(crowd.site.first, crowd.site.last, 0.25)
    x, y, heading = crowd.site.path.at(s)
    nearest = np.argmin((places[:, 0, None] - x) ** 2 + (places[:, 1, None] - y) ** 2, axis=1)
    dx, dy = places[:, 0] - x[nearest], places[:, 1] - y[nearest]
    left = dy * np.cos(heading[nearest]) - dx * np.sin(heading[nearest])
    return s[nearest] - crowd.site.travel / 2, left, places[:, 2] - heading[nearest]


def _person(crowd: Crowd) -> None:
    """Somebody, or some people together, at one of the places where people are found."""
    rng, street = crowd.rng, crowd.site.street
    place = str(rng.choice(_PLACES, p=_PLACE_SHARES))
    s, side = _distance(crowd, PEOPLE_RANGE_M), float(rng.choice([-1.0, 1.0]))
    edge, width = street.half_width, max(street.pavement, 1.4)
    speed = float(rng.choice([-1.0, 1.0])) * float(rng.uniform(0.8, 1.8))
    if place == "group":
        _group(crowd, s, side * (edge + float(rng.uniform(0.5, width + 0.6))), 0.0 if rng.random() < 0.5 else speed)
        return
    if place == "sitting":
        offset = side * (edge + max(0.6, width - 0.5))
        for k in range(int(rng.integers(1, 4))):
            turn = float(rng.uniform(-np.pi, np.pi))
            crowd.add("sitting", lambda k=k, t=turn: Motion(crowd.site.path, s + 0.9 * k, offset, 0.0, t), 0.0)
        return
    if place == "crossing":
        speed *= 0.9
        crowd.add("pedestrian", lambda: _across(crowd, s, float(rng.uniform(-1, 1)) * (edge + 1), speed), 0.05)
        return
    if place == "hidden":
        facing = float(rng.uniform(-np.pi, np.pi))
        crowd.add(
            "pedestrian", lambda: _behind(crowd, 0.0 if facing > 0 else speed, facing if facing > 0 else 0.0), 0.02
        )
        return
    spans = {
        "walking": (0.3, width),
        "parked": (-2.4, 0.5),  # between parked cars, or right behind them
        "door": (-3.1, -2.0),  # on the road beside them
        "yard": (width, width + max(street.setback + street.verge, 1.5)),
    }
    low, high = spans[place]
    standing = place != "walking" or rng.random() < 0.2
    facing = float(rng.uniform(-np.pi, np.pi)) if standing else 0.0

    def motion() -> Motion:
        return Motion(
            crowd.site.path,
            s + float(rng.normal(0, 1.0)),
            side * (edge + float(rng.uniform(low, high))),
            0.0 if standing else speed,
            facing + float(rng.normal(0, 0.1)),
        )

    crowd.add("pedestrian", motion, 0.03)


def _group(crowd: Crowd, s: float, offset: float, speed: float) -> None:
    """Two to six people close together: standing face to face, or walking the same way."""
    rng = crowd.rng
    for _ in range(int(rng.choice([2, 3, 4, 5, 6], p=[0.42, 0.27, 0.15, 0.1, 0.06]))):

        def motion() -> Motion:
            along, across = rng.normal(0, 0.75), rng.normal(0, 0.55)
            facing = float(np.arctan2(-across, -along)) if speed == 0 else 0.0
            turn = facing + float(rng.normal(0, 0.4 if speed == 0 else 0.12))
            return Motion(crowd.site.path, s + float(along), offset + float(across), speed, turn)

        crowd.add("pedestrian", motion, 0.0)


def _ride(crowd: Crowd) -> None:
    """A rider, or two side by side: along the road or pavement, across it, or waiting with a foot on the ground."""
    rng, site, street = crowd.rng, crowd.site, crowd.site.street
    ride = str(rng.choice(_RIDES, p=_RIDE_SHARES))
    kind = "motorcyclist" if ride != "pavement" and rng.random() < 0.1 else "cyclist"
    way, s = float(rng.choice([-1.0, 1.0])), _distance(crowd, RIDERS_RANGE_M)
    strip = 2.1 if street.parking is not None else 0.0
    speed = way * float(rng.uniform(2.5, 6.5))
    if ride == "crossing":
        crowd.add(kind, lambda: _across(crowd, s, float(rng.uniform(-1, 1)) * (street.half_width + 2), speed), 0.1)
        return

    if ride == "hidden":
        turn = float(rng.choice([0.0, 0.0, np.pi / 2, -np.pi / 2]))
        crowd.add(kind, lambda: _behind(crowd, 0.0 if turn else speed, turn), 0.05)
        return

    def motion(shift: float = 0.0) -> Motion:
        offset = street.half_width - strip - float(rng.uniform(0.3, 1.6)) - shift
        if ride == "pavement":
            offset = street.half_width + float(rng.uniform(0.5, max(0.9, street.pavement)))
        turn = float(rng.normal(0, 0.5 if ride == "waiting" else 0.06))
        if ride == "waiting":
            return Motion(site.path, s + float(rng.normal(0, 2)), -way * offset, 0.0, turn + (np.pi if way < 0 else 0))
        return Motion(site.path, s + float(rng.normal(0, 2)), -way * offset, speed, turn)

    crowd.add(kind, motion, 0.1)
    if ride == "abreast":
        crowd.add("cyclist", lambda: motion(float(rng.uniform(0.8, 1.2))), 0.02)


def _parked_two_wheelers(crowd: Crowd) -> None:
    """Bicycles at a rack or single ones, now and then a motorcycle, along the pavement or between parked cars."""
    rng, street = crowd.rng, crowd.site.street
    s, side = _distance(crowd, RIDERS_RANGE_M), float(rng.choice([-1.0, 1.0]))
    offset = side * (street.half_width + float(rng.uniform(-1.6, max(street.pavement, 1.0))))
    turn = float(rng.choice([0.0, np.pi / 2, -np.pi / 2])) + float(rng.normal(0, 0.2))
    kind = "motorcycle" if rng.random() < 0.25 else "bicycle"
    for k in range(int(rng.choice([1, 2, 3, 5], p=[0.5, 0.2, 0.15, 0.15]))):
        crowd.add(kind, lambda k=k: Motion(crowd.site.path, s + 0.7 * k, offset, 0.0, turn), 0.0)


def _queues(crowd: Crowd, world: World) -> None:
    """Vehicles one behind the other in a lane, standing or crawling, as before traffic lights."""
    rng, site, street = crowd.rng, crowd.site, crowd.site.street
    drive = street.half_width - (2.1 if street.parking is not None else 0.0)
    for direction in (1.0, -1.0):
        for lane in [(k + 0.5) * drive / street.lanes for k in range(street.lanes)]:
            if rng.random() >= world.queues:
                continue
            s = float(rng.uniform(7.0, 25.0)) * float(rng.choice([1.0, 1.0, -1.0])) + site.travel
            for _ in range(int(rng.integers(2, 7))):
                kind, gap = vehicle_kind(crowd, False), float(rng.uniform(1.2, 3.5))
                room = {"car": 4.2, "van": 5.4}.get(kind, 10.5)
                s += room / 2 + gap
                lateral = -direction * (lane + float(rng.normal(0, 0.2)))
                speed = 0.0 if site.travel == 0 else direction * abs(crowd.ego.speed)
                heading = 0.0 if speed or direction > 0 else np.pi
                crowd.add(
                    kind,
                    lambda a=s, b=lateral, v=speed, h=heading: Motion(site.path, a, b, v, h),
                    0.2,
                    True,
                )
                s += room / 2


def _rows(crowd: Crowd, world: World) -> None:
    """Rows of vehicles parked side by side or at a slant beyond the kerb, which hide one another."""
    rng, site, street = crowd.rng, crowd.site, crowd.site.street
    for _ in range(int(rng.poisson(world.rows))):
        side, s = float(rng.choice([-1.0, 1.0])), float(rng.uniform(-15.0, 45.0)) + site.travel / 2
        slant = float(rng.choice([np.pi / 2, np.pi / 3, 0.0], p=[0.5, 0.3, 0.2]))
        step = 2.7 / max(np.sin(slant), 0.5) if slant else 5.6
        depth = 2.6 if slant else 1.2
        room = street.pavement + street.verge + street.setback
        offset = side * (street.half_width + (depth if room > 2 * depth else -depth if slant == 0 else depth))
        for k in range(int(rng.integers(3, 10))):
            if site.near_crossing(s + step * k, 4.0):
                continue
            flip = np.pi if rng.random() < 0.25 else 0.0
            place = _slot(site.path, s + step * k, offset, side * slant + flip, rng)
            crowd.add(vehicle_kind(crowd, True), place, 0.05)


def _slot(path: Path, s: float, offset: float, turn: float, rng: np.random.Generator) -> Callable[[], Motion]:
    """A parking place, used a little differently every time."""

    def motion() -> Motion:
        shift, aside, skew = rng.normal(0, (0.1, 0.25, 0.03))
        return Motion(path, s + float(shift), offset + float(aside), 0.0, turn + float(skew))

    return motion

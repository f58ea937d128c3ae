"""Pedestrians, riders and two-wheelers, built from tapered limbs in a pose."""

# ruff: noqa: RUF005 - the vectors that lists are added to are numpy arrays
from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.meshes.primitives import Mesh, box, ellipsoid, grid, slot, tube

Colour = tuple[float, float, float]
Vector = NDArray[np.float64]

SKIN_TONES: Final[tuple[Colour, ...]] = ((0.55, 0.34, 0.25), (0.45, 0.26, 0.18), (0.30, 0.16, 0.10), (0.13, 0.07, 0.05))
HAIR_COLOURS: Final[tuple[Colour, ...]] = (
    (0.02, 0.015, 0.012),
    (0.06, 0.035, 0.02),
    (0.16, 0.09, 0.04),
    (0.32, 0.22, 0.11),
    (0.35, 0.34, 0.33),
)
TOP_COLOURS: Final[tuple[Colour, ...]] = (
    (0.03, 0.03, 0.035),
    (0.30, 0.30, 0.31),
    (0.62, 0.61, 0.58),
    (0.05, 0.08, 0.20),
    (0.40, 0.04, 0.04),
    (0.05, 0.18, 0.08),
    (0.45, 0.33, 0.18),
    (0.14, 0.10, 0.07),
    (0.08, 0.22, 0.42),
    (0.50, 0.12, 0.28),
    (0.55, 0.42, 0.06),
    (0.10, 0.10, 0.11),
)
LEG_COLOURS: Final[tuple[Colour, ...]] = (
    (0.03, 0.05, 0.12),
    (0.06, 0.09, 0.18),
    (0.02, 0.02, 0.022),
    (0.22, 0.18, 0.12),
    (0.12, 0.12, 0.13),
    (0.09, 0.06, 0.04),
)


@dataclass(frozen=True)
class PersonStyle:
    """What somebody looks like: colours, clothing and build."""

    skin: Colour
    hair: Colour
    top: Colour
    legs: Colour
    shoes: Colour
    top_material: str
    leg_material: str
    clothing: str
    bag: str
    stout: float
    long_hair: bool
    helmet: bool


def random_palette(rng: np.random.Generator) -> list[Colour]:
    """Colours of skin, hair, top, legs and shoes."""

    def varied(colour: Colour) -> Colour:
        k = float(rng.uniform(0.75, 1.25))
        return colour[0] * k, colour[1] * k, colour[2] * k

    return [
        SKIN_TONES[rng.choice(4, p=[0.5, 0.25, 0.15, 0.1])],
        HAIR_COLOURS[rng.integers(len(HAIR_COLOURS))],
        varied(TOP_COLOURS[rng.integers(len(TOP_COLOURS))]),
        varied(LEG_COLOURS[rng.integers(len(LEG_COLOURS))]),
        ((0.02, 0.02, 0.02), (0.10, 0.06, 0.03), (0.55, 0.55, 0.55))[rng.integers(3)],
    ]


def random_style(rng: np.random.Generator, open_colours: bool = False) -> PersonStyle:
    """A style drawn at random; with ``open_colours`` its colours are marks for `Mesh.painted`."""
    skin, hair, top, legs, shoes = [slot(k) for k in range(5)] if open_colours else random_palette(rng)
    return PersonStyle(
        skin,
        hair,
        top,
        legs,
        shoes,
        ("cloth", "cloth", "checks", "stripes", "leather")[rng.integers(5)],
        ("denim", "cloth")[rng.integers(2)],
        ("trousers", "trousers", "trousers", "coat", "skirt", "shorts")[rng.integers(6)],
        ("none", "none", "backpack", "shoulder", "none", "carrier")[rng.integers(6)],
        float(rng.uniform(0.92, 1.18)),
        bool(rng.random() < 0.4),
        bool(rng.random() < 0.5),
    )


@dataclass(frozen=True)
class Pose:
    """Joint positions in metres for a body 1.75 m tall, x forward, z up.

    ``hips``, ``knees``, ``ankles``, ``shoulders``, ``elbows``, ``hands`` hold left then right.
    """

    pelvis: Vector
    chest: Vector
    head: Vector
    hips: tuple[Vector, Vector]
    knees: tuple[Vector, Vector]
    ankles: tuple[Vector, Vector]
    shoulders: tuple[Vector, Vector]
    elbows: tuple[Vector, Vector]
    hands: tuple[Vector, Vector]


def _limb(start: Vector, angle: float, length: float, spread: float = 0.0) -> Vector:
    """The end of a limb that hangs down from ``start``, swung forward by ``angle``."""
    end: Vector = start + np.array([np.sin(angle) * length, spread, -np.cos(angle) * length])
    return end


def _swap(pair: list[Vector]) -> tuple[Vector, Vector]:
    return pair[0], pair[1]


def walking_pose(phase: float, stride: float) -> Pose:
    """A step at ``phase`` (radians); ``stride`` is the swing of the legs in radians, 0 for standing."""
    joints: list[list[Vector]] = [[] for _ in range(6)]
    hips, knees, ankles, shoulders, elbows, hands = joints
    bob = -0.035 * stride * abs(np.sin(phase))
    for side in (1.0, -1.0):
        swing = stride * np.sin(phase + (0 if side > 0 else np.pi))
        lift = max(0.0, np.cos(phase + (0 if side > 0 else np.pi))) * stride * 1.1
        hip = np.array([0, 0.09 * side, 0.92 + bob])
        knee = _limb(hip, swing + 0.35 * lift, 0.44)
        ankle = _limb(knee, swing - 0.65 * lift - 0.06, 0.42)
        shoulder = np.array([0.0, 0.185 * side, 1.43 + bob])
        elbow = _limb(shoulder, -0.75 * swing - 0.03, 0.28, 0.035 * side)
        hand = _limb(elbow, -0.75 * swing + 0.22 + 0.25 * stride, 0.26, 0.01 * side)
        for values, value in zip(
            (hips, knees, ankles, shoulders, elbows, hands), (hip, knee, ankle, shoulder, elbow, hand), strict=True
        ):
            values.append(value)
    lean = 0.03 * stride
    return Pose(
        np.array([0, 0, 0.95 + bob]),
        np.array([lean, 0, 1.36 + bob]),
        np.array([lean * 1.6, 0, 1.62 + bob]),
        _swap(hips),
        _swap(knees),
        _swap(ankles),
        _swap(shoulders),
        _swap(elbows),
        _swap(hands),
    )


def sitting_pose() -> Pose:
    """On a bench 0.45 m high."""
    sides = (1.0, -1.0)
    return Pose(
        np.array([0, 0, 0.52]),
        np.array([-0.03, 0, 0.93]),
        np.array([0.02, 0, 1.19]),
        _swap([np.array([0, 0.1 * s, 0.50]) for s in sides]),
        _swap([np.array([0.44, 0.13 * s, 0.50]) for s in sides]),
        _swap([np.array([0.42, 0.13 * s, 0.08]) for s in sides]),
        _swap([np.array([-0.03, 0.185 * s, 1.0]) for s in sides]),
        _swap([np.array([0.06, 0.23 * s, 0.74]) for s in sides]),
        _swap([np.array([0.30, 0.13 * s, 0.62]) for s in sides]),
    )


def riding_pose(phase: float, lean: float) -> Pose:
    """On a saddle 0.92 m high with the hands on the bars; ``phase`` turns the pedals, ``lean`` bends the back."""
    sides = (1.0, -1.0)
    pelvis = np.array([-0.18, 0, 0.97])
    chest = pelvis + 0.42 * np.array([np.sin(lean), 0, np.cos(lean)])
    shoulders = [chest + np.array([0.02, 0.18 * s, 0.06]) for s in sides]
    hands = [np.array([0.42, 0.24 * s, 1.02]) for s in sides]
    elbows = [(a + b) / 2 + np.array([-0.04, 0.07 * s, -0.08]) for a, b, s in zip(shoulders, hands, sides, strict=True)]
    ankles = [
        np.array([-0.02 + 0.16 * np.cos(phase + a), 0.11 * s, 0.34 + 0.16 * np.sin(phase + a)])
        for s, a in zip(sides, (0, np.pi), strict=True)
    ]
    hips = [pelvis + np.array([0.02, 0.09 * s, -0.03]) for s in sides]
    knees = []
    for hip, ankle in zip(hips, ankles, strict=True):
        middle, gap = (hip + ankle) / 2, float(np.linalg.norm(hip - ankle))
        bend = np.sqrt(max(0.44**2 - (gap / 2) ** 2, 0.0))
        knees.append(middle + np.array([bend, 0, 0.25 * bend]))
    return Pose(
        pelvis,
        chest,
        chest + np.array([0.10, 0, 0.26]),
        _swap(hips),
        _swap(knees),
        _swap(ankles),
        _swap(shoulders),
        _swap(elbows),
        _swap(hands),
    )


def dress(pose: Pose, style: PersonStyle) -> Mesh:
    """The body in a pose with its clothes."""
    k = style.stout
    parts: list[Mesh] = []
    skirted = style.clothing == "skirt"
    bare = style.clothing in ("skirt", "shorts")
    for hip, knee, ankle in zip(pose.hips, pose.knees, pose.ankles, strict=True):
        thigh, shin = (style.leg_material, style.legs), (style.leg_material, style.legs)
        if bare:
            shin = ("skin", style.skin)
        parts.append(tube([hip, (hip + knee) / 2, knee], [0.092 * k, 0.082 * k, 0.062], *thigh, sides=8))
        parts.append(tube([knee, knee * 0.6 + ankle * 0.4, ankle], [0.061, 0.060, 0.045], *shin, sides=8))
        toe = ankle + np.array([0.15, 0, -0.045])
        parts.append(
            tube(
                [ankle + [-0.05, 0, -0.035], ankle + [0.02, 0, -0.03], toe],
                [0.04, 0.045, 0.03],
                "leather",
                style.shoes,
                6,
            )
        )
    spine = pose.chest - pose.pelvis
    levels = [
        (-0.12, 0.155, 0.105),
        (0.0, 0.165, 0.115),
        (0.35, 0.148, 0.10),
        (0.75, 0.175, 0.115),
        (1.05, 0.185, 0.105),
        (1.22, 0.13, 0.08),
        (1.32, 0.055, 0.055),
    ]
    if style.clothing == "coat":
        levels = [(-1.05, 0.20, 0.16), (-0.6, 0.185, 0.145), *levels[1:]]
    parts.append(_torso(pose.pelvis, spine, levels, k, style.top_material, style.top))
    if skirted:
        parts.append(
            _torso(
                pose.pelvis,
                np.array([0, 0, 0.42]),
                [(-1.15, 0.24, 0.21), (-0.6, 0.21, 0.17), (0.05, 0.165, 0.12)],
                k,
                style.leg_material,
                style.legs,
            )
        )
    for shoulder, elbow, hand in zip(pose.shoulders, pose.elbows, pose.hands, strict=True):
        parts.append(
            tube(
                [shoulder, (shoulder + elbow) / 2, elbow],
                [0.062 * k, 0.054 * k, 0.045],
                style.top_material,
                style.top,
                7,
            )
        )
        sleeve = ("skin", style.skin) if style.clothing in ("shorts", "skirt") else (style.top_material, style.top)
        parts.append(tube([elbow, hand], [0.043, 0.034], *sleeve, sides=7))
        parts.append(ellipsoid(hand + (hand - elbow) * 0.2, (0.045, 0.03, 0.055), "skin", style.skin, 5))
    parts += _head(pose, style)
    parts += _bag(pose, style)
    return Mesh.join(parts)


def _torso(
    base: Vector, spine: Vector, levels: list[tuple[float, float, float]], k: float, material: str, colour: Colour
) -> Mesh:
    """Elliptic rings (share along the spine, half width, half depth) around a spine, closed at both ends."""
    angle = np.arange(12) * 2 * np.pi / 12
    rings = []
    for share, across, deep in levels:
        centre = base + spine * share
        rings.append(centre + np.stack([-np.sin(angle) * deep * k, np.cos(angle) * across * k, np.zeros(12)], axis=1))
    first, last = (
        rings[0].mean(axis=0, keepdims=True).repeat(12, 0),
        rings[-1].mean(axis=0, keepdims=True).repeat(12, 0),
    )
    return grid(np.stack([first, *rings, last]), material, colour, closed=True, crease=0.3)


def _head(pose: Pose, style: PersonStyle) -> list[Mesh]:
    """Neck, head, hair or helmet."""
    parts = [
        tube([pose.head - [0.03, 0, 0.18], pose.head - [0.01, 0, 0.06]], [0.055, 0.052], "skin", style.skin, 8),
        ellipsoid(pose.head, (0.095, 0.075, 0.12), "skin", style.skin, 9),
        tube([pose.head + [0.085, 0, -0.005], pose.head + [0.108, 0, -0.025]], [0.014, 0.02], "skin", style.skin, 5),
    ]
    if style.helmet:
        parts.append(ellipsoid(pose.head + [-0.005, 0, 0.055], (0.135, 0.10, 0.085), "plastic", style.top, 8))
    else:
        parts.append(ellipsoid(pose.head + [-0.022, 0, 0.028], (0.095, 0.083, 0.112), "hair", style.hair, 8))
    if style.long_hair:
        parts.append(ellipsoid(pose.head + [-0.06, 0, -0.07], (0.055, 0.085, 0.14), "hair", style.hair, 7))
    return parts


def _bag(pose: Pose, style: PersonStyle) -> list[Mesh]:
    dark = (0.05, 0.05, 0.06)
    if style.bag == "backpack":
        return [
            ellipsoid(
                (pose.pelvis + 2 * pose.chest) / 3 + [-0.19, 0, 0.02], (0.10, 0.14, 0.21), "cloth", style.shoes, 8
            )
        ]
    if style.bag == "shoulder":
        return [box(pose.hips[0] + [-0.02, 0.13, 0.0], (0.26, 0.09, 0.22), "leather", dark)]
    if style.bag == "carrier":
        return [box(pose.hands[1] + [0.0, -0.02, -0.22], (0.22, 0.08, 0.26), "cloth", (0.5, 0.5, 0.48))]
    return []


def pedestrian(style: PersonStyle, phase: float, stride: float) -> Mesh:
    """Somebody on foot with soles on z = 0, about 1.75 m tall."""
    plain = PersonStyle(**{**style.__dict__, "helmet": False})
    mesh = dress(walking_pose(phase, stride), plain)
    return mesh.moved((0, 0, -mesh.bounds()[0][2]))


def sitting_person(style: PersonStyle) -> Mesh:
    """Somebody seated on a stool."""
    body = dress(sitting_pose(), PersonStyle(**{**style.__dict__, "helmet": False, "bag": "none"}))
    dark = (0.1, 0.1, 0.1)
    feet = [(x, y, 0.2) for x in (-0.12, 0.2) for y in (-0.14, 0.14)]
    legs = [box(foot, (0.03, 0.03, 0.4), "galvanised", dark) for foot in feet]
    return Mesh.join([body, box((0.04, 0, 0.405), (0.38, 0.36, 0.03), "wood", (0.28, 0.17, 0.09)), *legs])

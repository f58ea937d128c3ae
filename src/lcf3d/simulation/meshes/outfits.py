"""People as different from one another as on real streets: hats, jackets, vests, what their arms do, their gait."""

# ruff: noqa: RUF005 - the vectors that lists are added to are numpy arrays
from __future__ import annotations

from colorsys import hsv_to_rgb
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lcf3d.simulation.meshes.people import (
    Colour,
    PersonStyle,
    Pose,
    Vector,
    dress,
    random_style,
    riding_pose,
    walking_pose,
)
from lcf3d.simulation.meshes.primitives import Mesh, box, ellipsoid, tube
from lcf3d.simulation.meshes.two_wheelers import bicycle

HATS: Final = ("none", "cap", "beanie", "brim", "hood")
ARMS: Final = ("swing", "pockets", "phone", "front", "carry", "back", "raised")
_HAT_SHARES: Final = (0.62, 0.13, 0.11, 0.05, 0.09)
_ARM_SHARES: Final = (0.46, 0.14, 0.12, 0.10, 0.07, 0.06, 0.05)


@dataclass(frozen=True)
class Outfit:
    """Clothes and habits of one person.

    Attributes:
        style: clothing and build.
        hat: one of ``HATS``.
        hat_colour: linear RGB.
        arms: one of ``ARMS``.
        vest: whether a reflecting vest is worn.
        open_jacket: colour of what shows between the halves of an open jacket, None when it is closed.
        lean: forward bend of the upper body in radians.
    """

    style: PersonStyle
    hat: str
    hat_colour: Colour
    arms: str
    vest: bool
    open_jacket: Colour | None
    lean: float


def cloth_colour(rng: np.random.Generator) -> Colour:
    """A colour of clothes: most are dark, grey or dull, a few bright or white."""
    kind = rng.random()
    if kind < 0.42:
        grey = float(rng.choice([0.012, 0.03, 0.07, 0.15])) * float(rng.uniform(0.7, 1.4))
        tint = rng.normal(1, 0.08, 3)
        return float(grey * tint[0]), float(grey * tint[1]), float(grey * tint[2])
    if kind < 0.56:
        white = float(rng.uniform(0.4, 0.8))
        return white, white, white * float(rng.uniform(0.85, 1.0))
    bright = float(rng.uniform(0.05, 0.6))
    return hsv_to_rgb(float(rng.random()), float(rng.uniform(0.3, 0.95)), bright)


def random_outfit(rng: np.random.Generator) -> Outfit:
    """Somebody at random."""
    style = replace(random_style(rng), top=cloth_colour(rng), stout=float(np.clip(rng.normal(1.06, 0.13), 0.86, 1.45)))
    if rng.random() < 0.6:
        style = replace(style, legs=cloth_colour(rng))
    return Outfit(
        style,
        str(rng.choice(HATS, p=_HAT_SHARES)),
        cloth_colour(rng),
        str(rng.choice(ARMS, p=_ARM_SHARES)),
        bool(rng.random() < 0.04),
        cloth_colour(rng) if rng.random() < 0.25 else None,
        float(np.clip(rng.normal(0.03, 0.06), -0.05, 0.3)),
    )


def _with_arms(pose: Pose, arms: str, side: int) -> Pose:
    """The pose with one or both arms (``side`` 0 left, 1 right) doing something else than swinging."""
    if arms == "swing":
        return pose
    elbows, hands = list(pose.elbows), list(pose.hands)
    for k, way in enumerate((1.0, -1.0)):
        shoulder = pose.shoulders[k]
        if arms == "pockets":
            elbows[k] = shoulder + [-0.13, 0.09 * way, -0.24]
            hands[k] = pose.hips[k] + [0.05, 0.09 * way, 0.06]
        elif arms == "front":
            elbows[k] = shoulder + [-0.02, 0.06 * way, -0.27]
            hands[k] = shoulder + [0.22, -0.10 * way, -0.26 + 0.04 * way]
        elif arms == "carry":
            elbows[k] = shoulder + [0.02, 0.05 * way, -0.28]
            hands[k] = shoulder + [0.27, -0.02 * way, -0.30]
        elif arms == "back":
            elbows[k] = shoulder + [-0.13, 0.08 * way, -0.24]
            hands[k] = shoulder + [-0.16, -0.10 * way, -0.42]
        elif k == side:
            elbows[k] = shoulder + ([0.14, 0.05 * way, -0.23] if arms == "phone" else [0.18, 0.12 * way, 0.05])
            hands[k] = shoulder + ([0.24, -0.04 * way, 0.02] if arms == "phone" else [0.30, 0.14 * way, 0.28])
    return replace(pose, elbows=(elbows[0], elbows[1]), hands=(hands[0], hands[1]))


def _leaning(pose: Pose, lean: float) -> Pose:
    """The pose with everything above the pelvis bent forward."""
    c, s = np.cos(lean), np.sin(lean)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])

    def bent(point: Vector) -> Vector:
        result: Vector = pose.pelvis + turn @ (point - pose.pelvis)
        return result

    def both(pair: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
        return bent(pair[0]), bent(pair[1])

    return replace(
        pose,
        chest=bent(pose.chest),
        head=bent(pose.head),
        shoulders=both(pose.shoulders),
        elbows=both(pose.elbows),
        hands=both(pose.hands),
    )


def _hat(pose: Pose, outfit: Outfit) -> list[Mesh]:
    head, colour = pose.head, outfit.hat_colour
    if outfit.hat == "cap":
        crown = ellipsoid(head + [-0.01, 0, 0.06], (0.11, 0.09, 0.075), "cloth", colour, 7)
        return [crown, box(head + [0.125, 0, 0.055], (0.10, 0.12, 0.012), "cloth", colour)]
    if outfit.hat == "beanie":
        return [ellipsoid(head + [-0.02, 0, 0.05], (0.112, 0.096, 0.105), "cloth", colour, 7)]
    if outfit.hat == "brim":
        brim = tube([head + [0, 0, 0.06], head + [0, 0, 0.075]], [0.19, 0.18], "cloth", colour, 12)
        return [brim, ellipsoid(head + [0, 0, 0.09], (0.11, 0.095, 0.09), "cloth", colour, 7)]
    if outfit.hat == "hood":
        return [
            ellipsoid(head + [-0.035, 0, 0.01], (0.115, 0.11, 0.15), outfit.style.top_material, outfit.style.top, 8)
        ]
    return []


def _over(pose: Pose, outfit: Outfit) -> list[Mesh]:
    """What is worn over the rest, or carried in both hands."""
    parts = []
    spine, k = pose.chest - pose.pelvis, outfit.style.stout
    if outfit.open_jacket is not None and not outfit.vest:
        front = [pose.pelvis + spine * t + [0.055 * k + 0.02, 0, 0] for t in (0.02, 0.5, 1.1)]
        parts.append(tube(front, [0.075 * k, 0.07 * k, 0.05], "cloth", outfit.open_jacket, 7))
    if outfit.vest:
        ring = [(0.0, 0.185, 0.14), (0.55, 0.19, 0.145), (1.0, 0.19, 0.135)]
        flat = [(pose.pelvis + spine * t, across * k) for t, across, _ in ring]
        yellow = (0.55, 0.75, 0.02) if outfit.lean > 0 else (0.85, 0.28, 0.01)
        parts.append(tube([p for p, _ in flat], [r for _, r in flat], "cloth", yellow, 10, 0.75))
        for t in (0.25, 0.6):
            band = [pose.pelvis + spine * (t + d) for d in (-0.06, 0.06)]
            parts.append(tube(band, [0.195 * k] * 2, "sign", (0.7, 0.7, 0.7), 10, 0.75))
    if outfit.arms == "carry":
        between = (pose.hands[0] + pose.hands[1]) / 2
        parts.append(box(between + [0.06, 0, 0.08], (0.26, 0.36, 0.24), "wood", (0.34, 0.24, 0.13)))
    if outfit.arms == "phone":
        raised = max(pose.hands, key=lambda hand: float(hand[2]))
        parts.append(box(raised + [0.06, 0, 0.05], (0.015, 0.075, 0.14), "plastic", (0.02, 0.02, 0.02)))
    return parts


def varied_pedestrian(outfit: Outfit, phase: float, stride: float) -> Mesh:
    """Somebody on foot with soles on z = 0, about 1.75 m tall.

    Args:
        outfit: who it is.
        phase: moment of the step in radians.
        stride: swing of the legs in radians, 0 for standing.
    """
    pose = _leaning(walking_pose(phase, stride), outfit.lean)
    pose = _with_arms(pose, outfit.arms, 0 if outfit.lean > 0.03 else 1)
    plain = replace(outfit.style, helmet=False)
    mesh = Mesh.join([dress(pose, plain), *_hat(pose, outfit), *_over(pose, outfit)])
    return mesh.moved((0, 0, -mesh.bounds()[0][2]))


def varied_cyclist(outfit: Outfit, colour: Colour, phase: float) -> Mesh:
    """Somebody on a bicycle whose frame has ``colour``; the more the outfit leans, the sportier the back is bent."""
    pose = riding_pose(phase, float(np.clip(0.35 + 3 * outfit.lean, 0.1, 0.95)))
    style = outfit.style
    if style.clothing in ("coat", "skirt"):
        style = replace(style, clothing="trousers")
    rider = replace(style, bag=style.bag if style.bag == "backpack" else "none")
    hat = [] if style.helmet else _hat(pose, outfit)
    over = _over(pose, replace(outfit, arms="swing"))
    return Mesh.join([bicycle(colour), dress(pose, rider), *hat, *over])

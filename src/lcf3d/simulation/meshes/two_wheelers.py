"""Bicycles and motorcycles, alone and with their riders."""

# ruff: noqa: RUF005 - the vectors that lists are added to are numpy arrays
from __future__ import annotations

from typing import Final

import numpy as np

from lcf3d.simulation.meshes.people import Colour, PersonStyle, dress, riding_pose
from lcf3d.simulation.meshes.primitives import Mesh, box, ellipsoid, grid, slot, tube

BIKE_SLOT: Final = slot(5)
"""Mark of the frame of a bicycle in a template; slots 0 to 4 are skin, hair, top, legs and shoes."""


def bicycle(colour: Colour) -> Mesh:
    """A bicycle about 1.75 m long, without rider."""
    parts = []
    tyre, metal = (0.015, 0.015, 0.015), (0.35, 0.35, 0.36)
    for x in (0.53, -0.53):
        parts += _bicycle_wheel(x, 0.34, tyre, metal)
    crank, seat, head, bar = (
        np.array([-0.05, 0, 0.29]),
        np.array([-0.20, 0, 0.80]),
        np.array([0.36, 0, 0.86]),
        np.array([0.40, 0, 0.72]),
    )
    rear, front = np.array([-0.53, 0, 0.34]), np.array([0.53, 0, 0.34])
    for a, b, r in (
        (crank, seat, 0.02),
        (seat, head - [0, 0, 0.06], 0.02),
        (crank, bar, 0.022),
        (rear, crank, 0.013),
        (rear, seat, 0.012),
        (front, bar, 0.017),
        (bar, head + [-0.02, 0, 0.08], 0.02),
    ):
        parts.append(tube([a, b], [r, r], "paint", colour, 6))
    parts.append(tube([(0.33, -0.28, 0.99), (0.37, 0, 0.97), (0.33, 0.28, 0.99)], [0.016] * 3, "plastic", tyre, 6))
    parts.append(tube([seat, seat + [-0.02, 0, 0.10]], [0.014, 0.014], "rim", metal, 6))
    parts.append(ellipsoid((-0.24, 0, 0.92), (0.14, 0.075, 0.04), "leather", tyre, 6))
    parts.append(tube([crank + [-0.15, 0.09, -0.02], crank + [0.15, -0.09, 0.02]], [0.012] * 2, "rim", metal, 5))
    parts.append(box((0.47, 0, 0.86), (0.05, 0.06, 0.06), "headlamp", (0.7, 0.7, 0.7)))
    parts.append(box((-0.72, 0, 0.74), (0.02, 0.06, 0.05), "tail_lamp", (0.4, 0.01, 0.01)))
    parts.append(box((-0.52, 0, 0.74), (0.36, 0.13, 0.02), "plastic", tyre))
    return Mesh.join(parts)


def _bicycle_wheel(x: float, radius: float, tyre: Colour, metal: Colour) -> list[Mesh]:
    angle = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack(
        [np.cos(angle) * (radius - 0.018) + x, np.zeros(25), np.sin(angle) * (radius - 0.018) + radius], axis=1
    )
    around = np.arange(5) * 2 * np.pi / 5
    outward = (circle - [x, 0, radius]) / (radius - 0.018)
    ring = circle[:, None] + 0.018 * (
        np.cos(around)[None, :, None] * outward[:, None] + np.sin(around)[None, :, None] * np.array([0, 1.0, 0])
    )
    parts = [grid(ring, "rubber", tyre, closed=True, crease=-1.0)]
    for k in range(8):
        a = k * np.pi / 8
        arm = np.array([np.cos(a), 0, np.sin(a)]) * radius * 0.93
        centre = np.array([x, 0.01 * (-1) ** k, radius])
        parts.append(tube([centre - arm, centre + arm], [0.004, 0.004], "rim", metal, 3))
    return parts


def cyclist(style: PersonStyle, colour: Colour, phase: float, lean: float) -> Mesh:
    """A bicycle with its rider."""
    rider = PersonStyle(
        **{
            **style.__dict__,
            "bag": style.bag if style.bag == "backpack" else "none",
            "clothing": "trousers" if style.clothing in ("coat", "skirt") else style.clothing,
        }
    )
    return Mesh.join([bicycle(colour), dress(riding_pose(phase, lean), rider)])


def motorcycle(colour: Colour) -> Mesh:
    """A motorcycle about 2.1 m long, without rider."""
    black, metal = (0.02, 0.02, 0.02), (0.3, 0.3, 0.31)
    parts = []
    for x, width in ((0.72, 0.055), (-0.68, 0.075)):
        angle = np.linspace(0, 2 * np.pi, 19)
        circle = np.stack([np.cos(angle), np.zeros(19), np.sin(angle)], axis=1)
        rows = [
            circle * 0.20 + [0, width, 0],
            circle * 0.27 + [0, width, 0],
            circle * 0.32,
            circle * 0.27 - [0, width, 0],
            circle * 0.20 - [0, width, 0],
        ]
        parts.append(grid(np.stack(rows) + [x, 0, 0.32], "rubber", black, crease=0.2))
        parts.append(
            grid(np.stack([circle * 0.21 + [0, 0.02, 0], circle * 0.01 + [0, 0.03, 0]]) + [x, 0, 0.32], "rim", metal)
        )
        parts.append(
            grid(np.stack([circle * 0.21 - [0, 0.02, 0], circle * 0.01 - [0, 0.03, 0]]) + [x, 0, 0.32], "rim", metal)
        )
    parts.append(tube([(0.72, 0.07, 0.32), (0.45, 0.07, 1.0)], [0.03, 0.03], "chrome", (0.6, 0.6, 0.6), 6))
    parts.append(tube([(0.72, -0.07, 0.32), (0.45, -0.07, 1.0)], [0.03, 0.03], "chrome", (0.6, 0.6, 0.6), 6))
    parts.append(ellipsoid((0.18, 0, 0.84), (0.32, 0.15, 0.16), "paint", colour, 8))
    parts.append(ellipsoid((0.02, 0, 0.46), (0.30, 0.17, 0.22), "rim", metal, 7))
    parts.append(
        tube([(-0.02, 0, 0.80), (-0.35, 0, 0.80), (-0.75, 0, 0.90)], [0.12, 0.15, 0.07], "leather", black, 7, 1.1)
    )
    parts.append(tube([(0.40, -0.38, 1.05), (0.46, 0, 1.02), (0.40, 0.38, 1.05)], [0.02] * 3, "plastic", black, 6))
    parts.append(
        tube(
            [(0.1, -0.18, 0.30), (-0.5, -0.2, 0.36), (-0.85, -0.2, 0.42)],
            [0.04, 0.05, 0.06],
            "chrome",
            (0.6, 0.6, 0.6),
            7,
        )
    )
    parts.append(ellipsoid((0.58, 0, 0.92), (0.08, 0.10, 0.10), "headlamp", (0.75, 0.75, 0.75), 6))
    parts.append(box((-0.92, 0, 0.82), (0.04, 0.16, 0.06), "tail_lamp", (0.4, 0.01, 0.01)))
    parts.append(box((-0.96, 0, 0.68), (0.02, 0.2, 0.16), "plate", (0.6, 0.6, 0.6)))
    return Mesh.join(parts)


def motorcyclist(style: PersonStyle, colour: Colour) -> Mesh:
    """A motorcycle with its rider in a helmet."""
    rider = PersonStyle(
        **{**style.__dict__, "helmet": True, "bag": "none", "clothing": "trousers", "top_material": "leather"}
    )
    return Mesh.join([motorcycle(colour), dress(riding_pose(0.6, 0.3), rider)])

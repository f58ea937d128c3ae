"""Trucks, buses, trams, trailers, construction vehicles and other large things on wheels."""

from __future__ import annotations

import itertools

import numpy as np

from lcf3d.simulation.meshes.cars import PAINT_MARK
from lcf3d.simulation.meshes.primitives import Mesh, box, grid, panel, tube, wheel

_BLACK = (0.02, 0.02, 0.022)
_GLASS = (0.03, 0.035, 0.04)
_STEEL = (0.35, 0.36, 0.37)


def _wheels(positions: tuple[float, ...], width: float, radius: float) -> list[Mesh]:
    return [
        wheel(x, s * (width / 2 - 0.17), radius, 0.3, s, (0.4, 0.4, 0.42), 16) for x in positions for s in (1.0, -1.0)
    ]


def _rounded_body(
    x0: float,
    x1: float,
    width: float,
    z0: float,
    z1: float,
    material: str,
    colour: tuple[float, float, float],
    nose: float = 0.15,
) -> Mesh:
    """A long box with rounded roof edges and softly rounded ends."""
    half = width / 2
    section = np.array(
        [
            (0, z0),
            (half * 0.97, z0),
            (half, z0 + 0.15),
            (half, z1 - 0.25),
            (half * 0.97, z1 - 0.10),
            (half * 0.86, z1 - 0.02),
            (0, z1),
        ]
    )
    ring = np.concatenate([section, section[::-1] * [-1, 1]])
    middle = np.array([0, (z0 + z1) / 2])
    rows = []
    for x, shrink in (
        (x0, 0.90),
        (x0 + nose * 0.4, 0.965),
        (x0 + nose, 1),
        (x1 - nose, 1),
        (x1 - nose * 0.4, 0.965),
        (x1, 0.90),
    ):
        yz = middle + (ring - middle) * [shrink, 0.5 + 0.5 * shrink]
        rows.append(np.concatenate([np.full((len(yz), 1), x), yz], axis=1))
    ends = [np.array([[x, *middle]]).repeat(len(ring), 0) for x in (x0, x1)]
    return grid(np.stack([ends[0], *rows, ends[1]]), material, colour, closed=True, crease=0.8)


def _band(x0: float, x1: float, y: float, z0: float, z1: float, panes: int) -> list[Mesh]:
    """A row of side windows on both sides with narrow pillars between."""
    parts = []
    edges = np.linspace(x0, x1, panes + 1)
    for side in (1.0, -1.0):
        for a, b in itertools.pairwise(edges):
            a, b = a + 0.05, b - 0.05
            parts.append(
                panel((a, y * side, z0), (b, y * side, z0), (b, y * side, z1), (a, y * side, z1), "glass", _GLASS)
            )
    return parts


def _front(x: float, width: float, glass: tuple[float, float], lamp_z: float) -> list[Mesh]:
    """Windscreen, lamps, bumper and plate on a flat front at ``x``."""
    w = width / 2
    e = x + 0.015
    parts = [
        panel(
            (e, -0.86 * w, glass[0]),
            (e, 0.86 * w, glass[0]),
            (e, 0.82 * w, glass[1]),
            (e, -0.82 * w, glass[1]),
            "glass",
            _GLASS,
        ),
        panel(
            (e, -0.5 * w, lamp_z + 0.15),
            (e, 0.5 * w, lamp_z + 0.15),
            (e, 0.5 * w, lamp_z + 0.45),
            (e, -0.5 * w, lamp_z + 0.45),
            "plastic",
            _BLACK,
        ),
        panel(
            (e + 0.01, -0.26, lamp_z - 0.2),
            (e + 0.01, 0.26, lamp_z - 0.2),
            (e + 0.01, 0.26, lamp_z - 0.08),
            (e + 0.01, -0.26, lamp_z - 0.08),
            "plate",
            (0.6, 0.6, 0.6),
        ),
    ]
    for s in (1.0, -1.0):
        parts.append(
            panel(
                (e, 0.55 * w * s, lamp_z - 0.1),
                (e, 0.85 * w * s, lamp_z - 0.1),
                (e, 0.85 * w * s, lamp_z + 0.12),
                (e, 0.55 * w * s, lamp_z + 0.12),
                "headlamp",
                (0.75, 0.77, 0.8),
            )
        )
    return parts


def _rear(x: float, width: float, lamp_z: float) -> list[Mesh]:
    w, e = width / 2, x - 0.015
    parts = [
        panel(
            (e, 0.26, lamp_z - 0.1),
            (e, -0.26, lamp_z - 0.1),
            (e, -0.26, lamp_z + 0.02),
            (e, 0.26, lamp_z + 0.02),
            "plate",
            (0.6, 0.6, 0.6),
        )
    ]
    for s in (1.0, -1.0):
        parts.append(
            panel(
                (e, 0.68 * w * s, lamp_z - 0.12),
                (e, 0.92 * w * s, lamp_z - 0.12),
                (e, 0.92 * w * s, lamp_z + 0.18),
                (e, 0.68 * w * s, lamp_z + 0.18),
                "tail_lamp",
                (0.4, 0.012, 0.012),
            )
        )
    return parts


def truck(length: float, width: float, height: float, load: str, load_colour: tuple[float, float, float]) -> Mesh:
    """A rigid truck; ``load`` is the material of its box (``tarpaulin``, ``container``); its cab is ``PAINT_MARK``."""
    half = length / 2
    cab_length = min(2.1, 0.35 * length)
    cab = _rounded_body(
        half - cab_length, half - 0.02, width * 0.96, 0.45, min(height * 0.9, 2.9), "paint", PAINT_MARK, 0.3
    )
    top = min(height * 0.9, 2.9)
    parts = [cab, *_front(half - 0.03, width * 0.9, (0.56 * top, 0.9 * top), 0.75)]
    for s in (1.0, -1.0):
        x0, x1, y = half - cab_length + 0.5, half - 0.45, s * (width * 0.48 + 0.01)
        parts.append(
            panel(
                (x0, y, 0.58 * top),
                (x1, y, 0.55 * top),
                (x1 - 0.12, y, 0.88 * top),
                (x0, y, 0.88 * top),
                "glass",
                _GLASS,
            )
        )
        parts.append(box((half - 0.25, s * (width * 0.48 + 0.12), 0.72 * top), (0.1, 0.2, 0.45), "plastic", _BLACK))
    box_length = length - cab_length - 0.15
    centre = -half + box_length / 2
    parts.append(box((centre, 0, (1.05 + height) / 2), (box_length, width, height - 1.05), load, load_colour))
    parts.append(box((-0.2, 0, 0.85), (length - 1.2, 0.9, 0.35), "plastic", _BLACK))
    for s in (1.0, -1.0):
        parts.append(box((centre + 0.3, s * (width / 2 - 0.05), 0.75), (box_length * 0.45, 0.05, 0.4), "rim", _STEEL))
    axles = (half - 1.25, -half + 1.9) if length < 9 else (half - 1.25, -half + 1.6, -half + 2.9)
    parts += _wheels(axles, width, 0.5)
    return Mesh.join([*parts, *_rear(-half, width, 0.85)])


def bus(length: float, width: float, height: float) -> Mesh:
    """A city bus; the lower body has ``PAINT_MARK``."""
    half = length / 2
    parts = [_rounded_body(-half, half, width, 0.33, height, "paint", PAINT_MARK, 0.25)]
    parts += _band(-half + 0.5, half - 0.9, width / 2 + 0.006, 0.42 * height, 0.82 * height, max(3, int(length / 1.6)))
    parts += _front(half - 0.01, width * 0.98, (0.33 * height, 0.80 * height), 0.72)
    e = half + 0.008
    parts.append(
        panel(
            (e, -0.8, 0.86 * height),
            (e, 0.8, 0.86 * height),
            (e, 0.8, 0.95 * height),
            (e, -0.8, 0.95 * height),
            "plastic",
            _BLACK,
        )
    )
    back = -half - 0.008
    parts.append(
        panel(
            (back, 1.0, 0.5 * height),
            (back, -1.0, 0.5 * height),
            (back, -1.0, 0.8 * height),
            (back, 1.0, 0.8 * height),
            "glass",
            _GLASS,
        )
    )
    for x in (half - 1.35, 0.0):
        y = -width / 2 - 0.01
        parts.append(
            panel(
                (x - 0.6, y, 0.4),
                (x + 0.6, y, 0.4),
                (x + 0.6, y, 0.8 * height),
                (x - 0.6, y, 0.8 * height),
                "glass",
                _GLASS,
            )
        )
    parts += _wheels((half - 2.6, -half + 3.0), width + 0.06, 0.48)
    return Mesh.join([*parts, *_rear(-half, width, 0.9)])


def tram(length: float, width: float, height: float) -> Mesh:
    """One or more tram cars in a row."""
    cars = max(1, round(length / 10))
    part_length = length / cars
    parts = []
    for k in range(cars):
        x = -length / 2 + (k + 0.5) * part_length
        h = part_length / 2
        parts.append(
            _rounded_body(
                x - h + 0.15, x + h - 0.15, width, 0.25, height, "paint", PAINT_MARK, 0.35 if cars == 1 else 0.2
            )
        )
        parts += [
            m.moved((x, 0, 0))
            for m in _band(
                -h + 0.6, h - 0.6, width / 2 + 0.006, 0.42 * height, 0.8 * height, max(2, int(part_length / 1.9))
            )
        ]
        parts.append(box((x, 0, 0.25), (part_length - 1.0, width * 0.7, 0.5), "plastic", _BLACK))
    for x, s in ((length / 2 - 0.15, 1), (-length / 2 + 0.15, -1)):
        parts += [
            m.scaled((1, 1, 1)).turned(np.diag([s, s, 1.0])).moved((x, 0, 0))
            for m in _front(0, width * 0.9, (0.4 * height, 0.82 * height), 0.75)
        ]
    parts.append(tube([(-length / 2, 0, 0.6), (length / 2, 0, 0.6)], [0.15, 0.15], "plastic", _BLACK, 6))
    return Mesh.join(parts)


def trailer(length: float, width: float, height: float, load_colour: tuple[float, float, float]) -> Mesh:
    """A goods trailer without its truck."""
    half = length / 2
    floor = 1.1 if height > 2.2 else 0.5
    radius = 0.48 if height > 2.2 else 0.28
    parts = [
        box((0, 0, (floor + height) / 2), (length - 0.3, width, height - floor), "tarpaulin", load_colour),
        box((0, 0, floor - 0.15), (length - 0.4, 0.8, 0.3), "plastic", _BLACK),
        tube([(half - 0.5, 0, floor - 0.2), (half, 0, floor - 0.25)], [0.08, 0.06], "plastic", _BLACK, 6),
    ]
    axles = (-half + 1.2, -half + 2.4, -half + 3.6) if length > 6 else (-0.1,)
    parts += _wheels(axles, width, radius)
    return Mesh.join([*parts, *_rear(-half + 0.15, width, floor - 0.05)])


def excavator(length: float, width: float, height: float) -> Mesh:
    """A tracked excavator with its arm forward."""
    yellow = (0.62, 0.38, 0.03)
    parts = []
    for s in (1.0, -1.0):
        parts.append(
            _rounded_body(
                -0.30 * length, 0.25 * length, 0.22 * width, 0.0, 0.30 * height, "rubber", _BLACK, 0.35
            ).moved((0, s * 0.39 * width, 0))
        )
    parts.append(box((-0.12 * length, 0, 0.45 * height), (0.5 * length, 0.92 * width, 0.26 * height), "paint", yellow))
    parts.append(
        box((0.04 * length, 0.22 * width, 0.72 * height), (0.2 * length, 0.4 * width, 0.5 * height), "glass", _GLASS)
    )
    parts.append(
        box(
            (0.04 * length, 0.22 * width, 0.985 * height), (0.22 * length, 0.42 * width, 0.03 * height), "paint", yellow
        )
    )
    parts.append(box((-0.33 * length, 0, 0.45 * height), (0.14 * length, 0.9 * width, 0.3 * height), "plastic", _BLACK))
    joints = [
        (0.05 * length, -0.15 * width, 0.5 * height),
        (0.22 * length, -0.15 * width, 0.92 * height),
        (0.42 * length, -0.15 * width, 0.72 * height),
        (0.45 * length, -0.15 * width, 0.2 * height),
    ]
    for a, b in itertools.pairwise(joints):
        parts.append(tube([a, b], [0.09 * height, 0.07 * height], "paint", yellow, 4))
    parts.append(
        box((0.42 * length, -0.15 * width, 0.12 * height), (0.14 * length, 0.4 * width, 0.2 * height), "rim", _STEEL)
    )
    return Mesh.join(parts)


def traffic_cone() -> Mesh:
    """A cone 0.75 m tall with two reflecting collars."""
    angle = np.arange(12) * 2 * np.pi / 12
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(12)], axis=1)
    orange, white = (0.75, 0.13, 0.02), (0.75, 0.75, 0.75)
    parts = [box((0, 0, 0.02), (0.4, 0.4, 0.04), "plastic", (0.05, 0.05, 0.05))]
    levels = [(0.04, 0.15), (0.22, 0.117), (0.36, 0.092), (0.46, 0.074), (0.58, 0.053), (0.75, 0.022)]
    for k, ((z0, r0), (z1, r1)) in enumerate(itertools.pairwise(levels)):
        rows = np.stack([circle * r0 + [0, 0, z0], circle * r1 + [0, 0, z1]])
        parts.append(grid(rows, "sign" if k % 2 else "plain", white if k % 2 else orange, closed=True, crease=0.3))
    parts.append(box((0, 0, 0.745), (0.04, 0.04, 0.01), "plain", orange))
    return Mesh.join(parts)


def barrier(kind: int) -> Mesh:
    """A road-works barrier 2.5 m wide across y: red-white boards (0) or a concrete element (1)."""
    if kind == 1:
        section = np.array(
            [
                (0.28, 0),
                (0.28, 0.08),
                (0.12, 0.32),
                (0.09, 0.85),
                (-0.09, 0.85),
                (-0.12, 0.32),
                (-0.28, 0.08),
                (-0.28, 0),
            ]
        )
        rows = [np.stack([section[:, 0], np.full(8, y), section[:, 1]], axis=1) for y in (-1.25, 1.25)]
        ends = [np.array([[0, y, 0.3]]).repeat(8, 0) for y in (-1.25, 1.25)]
        return grid(np.stack([ends[0], *rows, ends[1]]), "concrete", (0.42, 0.41, 0.39), closed=True, crease=0.9)
    parts = []
    for z in (0.45, 0.85):
        for k in range(8):
            colour = (0.60, 0.03, 0.02) if k % 2 else (0.72, 0.72, 0.72)
            parts.append(box((0, -1.25 + (k + 0.5) * 2.5 / 8, z), (0.04, 2.5 / 8, 0.25), "sign", colour))
    for y in (-1.1, 1.1):
        parts.append(box((0, y, 0.5), (0.05, 0.06, 1.0), "galvanised", _STEEL))
        parts.append(box((0, y, 0.05), (0.55, 0.2, 0.1), "rubber", _BLACK))
    return Mesh.join(parts)


def pushcart(colour: tuple[float, float, float]) -> Mesh:
    """A small box trailer or stroller-sized cart, for the class Misc."""
    parts = [
        box((0, 0, 0.8), (1.5, 1.1, 0.9), "container", colour),
        box((0, 0, 0.32), (1.4, 0.9, 0.08), "plastic", _BLACK),
        tube([(0.7, 0, 0.34), (1.25, 0, 0.42)], [0.04, 0.04], "galvanised", _STEEL, 6),
    ]
    parts += [wheel(-0.05, s * 0.62, 0.28, 0.14, s, (0.4, 0.4, 0.42), 14) for s in (1.0, -1.0)]
    return Mesh.join(parts)

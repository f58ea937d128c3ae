"""Cars and vans: a body lofted along its side profile, with glass, lamps, plates and wheels in real arches."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.materials import MATERIAL_ID
from lcf3d.simulation.meshes.car_shapes import CarShape
from lcf3d.simulation.meshes.primitives import Mesh, grid, panel, slot, tube, wheel

PAINT_MARK: Final = slot(0)
"""Colour of the bodywork in the templates, exchanged for the car's own colour."""
_BLACK: Final = (0.02, 0.02, 0.022)
_GLASS: Final = (0.025, 0.03, 0.032)

STANDS_OUT_M = 0.012
"""What is put on the front stands out of it by so much."""


def _stations(shape: CarShape, fine: bool) -> NDArray[np.float64]:
    """Positions along the body at which it gets a cross-section, front to rear."""
    arch = shape.wheel_radius * 1.13 / shape.size[0]
    round_arch = [-1.0, -0.97, -0.85, -0.6, -0.3, 0, 0.3, 0.6, 0.85, 0.97, 1.0]
    around = np.array(round_arch if fine else [-1.0, -0.85, 0, 0.85, 1.0]) * arch
    pillars = [(shape.side_glass[0] + shape.side_glass[1]) / 2 + d for d in (-0.012, 0.012)]
    edges = [e + d for e in (*shape.screen, *shape.rear) for d in (0.0, 0.008)]
    positions = [0.0, 0.03, 0.075, 0.105, 0.93, 0.97, 0.992, 1.0, *pillars, *edges, *shape.side_glass]
    positions += [a + d for a in shape.axles for d in around]
    positions += [p for p, _ in shape.profile]
    values = np.unique(np.round(np.clip(positions, 0, 1), 4))
    apart: NDArray[np.float64] = values[np.concatenate([[True], np.diff(values) > (0.0025 if fine else 0.0065)])]
    return apart


def _sections(shape: CarShape, s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(S, 9, 2) half cross-sections (y, z) from the underside to the roof, and (S,) height of glass above the belt."""
    length, width, height = shape.size
    top = np.interp(s, *np.array(shape.profile).T) * height
    belt = np.interp(s, [0, 0.25, 1], [shape.belt[0] - 0.03, *shape.belt]) * height
    nose = np.minimum(s, 1 - s) * length
    half = width / 2 * np.interp(nose, [0, 0.03, 0.12, 0.4, 0.9], [0.80, 0.86, 0.93, 0.985, 1.0])
    clearance = np.interp(nose, [0, 0.15, 0.6], [0.16, 0.13, 0.12]) * height
    bottom = clearance.copy()
    for axle in shape.axles:
        offset = (s - axle) * length
        radius = shape.wheel_radius * 1.13
        inside = np.abs(offset) < radius
        arch = shape.wheel_radius + np.sqrt(np.maximum(radius**2 - offset**2, 0))
        bottom = np.where(inside, np.maximum(bottom, arch), bottom)
    glass = np.maximum(top - belt, 0)
    share = np.clip(glass / (height - belt), 0, 1)
    cabin = np.clip(glass / (0.10 * height), 0, 1)
    shoulder = np.minimum(belt, top - 0.012 * height)
    middle = np.maximum(bottom + 0.02, np.minimum(0.42 * height, shoulder - 0.03 * height))
    roof_half = half * (0.93 - 0.21 * share)
    z6 = np.where(cabin > 0.5, top - 0.035 * height * share, top - 0.02 * height)
    zero = np.zeros_like(s)
    rows = [
        (zero, np.maximum(bottom, clearance) - 0.02),
        (half * 0.86, bottom - 0.015),
        (half * 0.975, bottom + 0.02),
        (half * 1.0, middle),
        (half * 0.985, np.maximum(shoulder - 0.05 * height, middle + 0.01)),
        (half * 0.945, shoulder),
        (roof_half, np.maximum(z6, shoulder)),
        (roof_half * 0.72, np.maximum(top - 0.008 * height, shoulder)),
        (zero, top),
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1), glass / height


def build_car(shape: CarShape, fine: bool = True) -> Mesh:
    """The template of a shape in metres, x forward, wheels standing on z = 0; bodywork has colour ``PAINT_MARK``.

    ``fine`` False leaves out what cannot be seen from more than 40 m away.
    """
    length, width, _ = shape.size
    s = _stations(shape, fine)
    half, glass = _sections(shape, s)
    x = (0.5 - s) * length
    full = np.concatenate([half, half[:, -2::-1] * [-1, 1]], axis=1)
    points = np.concatenate([np.repeat(x[:, None, None], full.shape[1], axis=1), full], axis=2)
    body = grid(points, "paint", PAINT_MARK, crease=0.82)
    body = _colour_body(body, shape, s, glass)
    caps = [grid(np.stack([points[i] * [1, 0, 1], points[i]]), "paint", PAINT_MARK) for i in (0, -1)]
    parts = [body, *caps, *_details(shape, fine), _interior(shape)]
    for axle in shape.axles:
        for side in (1.0, -1.0):
            y = side * (width / 2 - 0.115)
            parts.append(
                wheel((0.5 - axle) * length, y, shape.wheel_radius, 0.2, side, (0.45, 0.46, 0.48), 18 if fine else 9)
            )
    return Mesh.join(parts)


def _colour_body(body: Mesh, shape: CarShape, s: NDArray[np.float64], glass: NDArray[np.float64]) -> Mesh:
    """Windows, pillars and sills of the lofted body get their own materials."""
    columns = 16
    front, back = s[:-1], s[1:]
    middle = (front + back) / 2
    material = np.full((len(s) - 1, columns), MATERIAL_ID["paint"], dtype=np.int16)
    colour = np.tile(np.array(PAINT_MARK, dtype=np.float32), (len(s) - 1, columns, 1))
    pillar = np.abs(middle - (shape.side_glass[0] + shape.side_glass[1]) / 2) < 0.012
    tall = np.minimum(glass[:-1], glass[1:]) > 0.10
    side = tall & (middle > shape.side_glass[0]) & (middle < shape.side_glass[1])
    screen = (front >= shape.screen[0] + 0.004) & (back <= shape.screen[1] + 0.0005)
    rear = (front >= shape.rear[0] - 0.0005) & (back <= shape.rear[1] + 0.004)
    for column in (5, 10):
        material[side & ~pillar, column] = MATERIAL_ID["glass"]
        colour[side & ~pillar, column] = _GLASS
        material[side & pillar, column] = MATERIAL_ID["plastic"]
        colour[side & pillar, column] = _BLACK
    for column in (6, 7, 8, 9):
        material[screen | rear, column] = MATERIAL_ID["glass"]
        colour[screen | rear, column] = _GLASS
    for column in (0, 1, 14, 15):
        material[:, column] = MATERIAL_ID["plastic"]
        colour[:, column] = _BLACK
    return Mesh(
        body.corners,
        body.normals,
        body.uv,
        material.reshape(-1).repeat(2),
        colour.reshape(-1, 3).repeat(2, axis=0),
        body.seed,
    )


def _details(shape: CarShape, fine: bool) -> list[Mesh]:
    """Lamps, grille, plates, bumpers, mirrors and door lines."""
    parts: list[Mesh] = []
    for side in (1.0, -1.0):
        parts += [*_headlamp(shape, side), *_tail_lamp(shape, side), *_mirror(shape, side)]
    return [*parts, *_grille(shape), *_plates(shape), *(_door_lines(shape) if fine else [])]


def _is_tall(shape: CarShape) -> bool:
    return shape.size[2] > 1.9


def _lamp_height(shape: CarShape) -> float:
    """Metres over the ground at which the headlamps are."""
    return (0.34 if _is_tall(shape) else 0.45) * shape.size[2]


def _headlamp(shape: CarShape, side: float) -> list[Mesh]:
    """The headlamp of a side: its front, and where it goes round the corner."""
    half_l, half_w, height = shape.size[0] / 2, shape.size[1] / 2, shape.size[2]
    lamp_z, e = _lamp_height(shape), STANDS_OUT_M
    inner, outer = 0.42 * half_w * side, 0.845 * half_w * side
    high = 0.055 * height
    return [
        panel(
            (half_l + e - 0.012, inner, lamp_z - high),
            (half_l - 0.035, outer, lamp_z - high * 0.8),
            (half_l - 0.075, outer, lamp_z + high * 1.25),
            (half_l - 0.022, inner, lamp_z + high * 0.8),
            "headlamp",
            (0.30, 0.32, 0.34),
        ),
        panel(
            (half_l - 0.035, outer, lamp_z - high * 0.8),
            (half_l - 0.24, 0.963 * half_w * side, lamp_z),
            (half_l - 0.30, 0.965 * half_w * side, lamp_z + high * 1.4),
            (half_l - 0.075, outer, lamp_z + high * 1.25),
            "headlamp",
            (0.30, 0.32, 0.34),
        ),
    ]


def _tail_lamp(shape: CarShape, side: float) -> list[Mesh]:
    """The tail lamp of a side, likewise."""
    half_l, half_w, height = shape.size[0] / 2, shape.size[1] / 2, shape.size[2]
    tall = _is_tall(shape)
    rear_z, rear_h = (0.42 if tall else 0.53) * height, (0.12 if tall else 0.075) * height
    rin = (0.74 if tall else 0.52) * half_w * side
    return [
        panel(
            (-half_l - 0.004, rin, rear_z - rear_h),
            (-half_l + 0.025, 0.86 * half_w * side, rear_z - rear_h),
            (-half_l + 0.06, 0.86 * half_w * side, rear_z + rear_h),
            (-half_l + 0.022, rin, rear_z + rear_h),
            "tail_lamp",
            (0.40, 0.012, 0.012),
        ),
        panel(
            (-half_l + 0.02, 0.868 * half_w * side, rear_z - rear_h),
            (-half_l + 0.17, 0.962 * half_w * side, rear_z - rear_h * 0.5),
            (-half_l + 0.19, 0.962 * half_w * side, rear_z + rear_h),
            (-half_l + 0.055, 0.868 * half_w * side, rear_z + rear_h),
            "tail_lamp",
            (0.40, 0.012, 0.012),
        ),
    ]


def _mirror(shape: CarShape, side: float) -> list[Mesh]:
    """The mirror of a side."""
    length, half_w, height = shape.size[0], shape.size[1] / 2, shape.size[2]
    mirror_x = (0.5 - shape.side_glass[0] - 0.01) * length
    mirror_z = (shape.belt[0] + 0.035) * height
    at = 0.87 * half_w * side
    return [
        tube(
            [
                (mirror_x + 0.05, at, mirror_z),
                (mirror_x, at + 0.06 * side, mirror_z),
                (mirror_x - 0.02, at + 0.10 * side, mirror_z),
            ],
            [0.02, 0.07, 0.05],
            "paint",
            PAINT_MARK,
            6,
        ),
    ]


def _grille(shape: CarShape) -> list[Mesh]:
    """Grille and lower bumper of the front."""
    half_l, half_w, height = shape.size[0] / 2, shape.size[1] / 2, shape.size[2]
    lamp_z, e = _lamp_height(shape), STANDS_OUT_M
    low, mid = 0.22 * height, 0.36 * height
    return [
        panel(
            (half_l + e, -0.36 * half_w, mid - 0.02),
            (half_l + e, 0.36 * half_w, mid - 0.02),
            (half_l + e - 0.012, 0.42 * half_w, lamp_z + 0.03),
            (half_l + e - 0.012, -0.42 * half_w, lamp_z + 0.03),
            "plastic",
            _BLACK,
        ),
        panel(
            (half_l + e, -0.60 * half_w, low - 0.04),
            (half_l + e, 0.60 * half_w, low - 0.04),
            (half_l + e, 0.55 * half_w, low + 0.06),
            (half_l + e, -0.55 * half_w, low + 0.06),
            "plastic",
            _BLACK,
        ),
    ]


def _plates(shape: CarShape) -> list[Mesh]:
    """Both plates, and the bumper behind."""
    half_l, half_w, height = shape.size[0] / 2, shape.size[1] / 2, shape.size[2]
    mid, e = 0.36 * height, STANDS_OUT_M
    white = (0.62, 0.62, 0.60)
    return [
        panel(
            (half_l + e + 0.006, -0.26, mid - 0.09),
            (half_l + e + 0.006, 0.26, mid - 0.09),
            (half_l + e + 0.006, 0.26, mid + 0.02),
            (half_l + e + 0.006, -0.26, mid + 0.02),
            "plate",
            white,
        ),
        panel(
            (-half_l - 0.02, 0.26, mid),
            (-half_l - 0.02, -0.26, mid),
            (-half_l - 0.02, -0.26, mid + 0.11),
            (-half_l - 0.02, 0.26, mid + 0.11),
            "plate",
            white,
        ),
        panel(
            (-half_l - 0.01, -0.78 * half_w, 0.15 * height),
            (-half_l - 0.01, 0.78 * half_w, 0.15 * height),
            (-half_l - 0.01, 0.76 * half_w, 0.24 * height),
            (-half_l - 0.01, -0.76 * half_w, 0.24 * height),
            "plastic",
            _BLACK,
        ),
    ]


def _door_lines(shape: CarShape) -> list[Mesh]:
    """Thin dark gaps around the doors, and the handles."""
    length, width, height = shape.size
    parts = []
    first, last = shape.side_glass
    middle = (first + last) / 2
    for side in (1.0, -1.0):
        y = side * (width / 2 + 0.002)
        for position in (first - 0.02, middle, min(last - 0.02, shape.axles[1] - 0.09)):
            x = (0.5 - position) * length
            parts.append(
                panel(
                    (x - 0.006, y * 0.985, 0.2 * height),
                    (x + 0.006, y * 0.985, 0.2 * height),
                    (x + 0.006, y, 0.42 * height),
                    (x - 0.006, y, 0.42 * height),
                    "plastic",
                    _BLACK,
                )
            )
            parts.append(
                panel(
                    (x - 0.006, y, 0.42 * height),
                    (x + 0.006, y, 0.42 * height),
                    (x + 0.006, y * 0.985, 0.56 * height),
                    (x - 0.006, y * 0.985, 0.56 * height),
                    "plastic",
                    _BLACK,
                )
            )
        for position in (middle - 0.035, last - 0.07):
            x = (0.5 - position) * length
            parts.append(
                panel(
                    (x - 0.09, y * 1.005, 0.51 * height),
                    (x + 0.09, y * 1.005, 0.51 * height),
                    (x + 0.09, y * 1.005, 0.53 * height),
                    (x - 0.09, y * 1.005, 0.53 * height),
                    "plastic",
                    _BLACK,
                )
            )
    return parts


def _interior(shape: CarShape) -> Mesh:
    """Floor and seats, which a beam meets when it comes through the glass."""
    length, width, height = shape.size
    x0, x1 = (0.5 - shape.side_glass[1]) * length, (0.5 - shape.screen[0]) * length
    dark = (0.03, 0.03, 0.032)
    z = 0.45 * height
    floor = panel(
        (x0, -0.42 * width, z), (x1, -0.42 * width, z), (x1, 0.42 * width, z), (x0, 0.42 * width, z), "cloth", dark
    )
    seats = [floor]
    front = (0.5 - (shape.side_glass[0] + shape.side_glass[1]) / 2) * length
    rows = (front, front - 0.9) if front - 0.9 > x0 + 0.2 else (front,)
    for x in rows:
        for y in (-0.2 * width, 0.2 * width):
            seats.append(
                tube(
                    [(x, y, z), (x - 0.12, y, z + 0.24 * height), (x - 0.15, y, z + 0.36 * height)],
                    [0.2, 0.19, 0.1],
                    "cloth",
                    dark,
                    6,
                    0.4,
                )
            )
    return Mesh.join(seats)

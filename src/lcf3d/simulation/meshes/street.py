"""What stands along a street: lamps, signs, signals and street furniture."""

from __future__ import annotations

import numpy as np

from lcf3d.simulation.meshes.primitives import Mesh, box, ellipsoid, grid, panel, tube

Colour = tuple[float, float, float]
_STEEL: Colour = (0.33, 0.34, 0.35)
_DARK: Colour = (0.05, 0.055, 0.06)


def street_lamp(height: float, arm: float) -> Mesh:
    """A lamp post whose arm reaches towards -y."""
    return Mesh.join(
        [
            tube([(0, 0, 0), (0, 0, height * 0.6), (0, 0, height)], [0.09, 0.07, 0.05], "galvanised", _STEEL, 8),
            tube(
                [(0, 0, height - 0.05), (0, -arm * 0.5, height + 0.25), (0, -arm, height + 0.3)],
                [0.045, 0.04, 0.035],
                "galvanised",
                _STEEL,
                6,
            ),
            box((0, -arm - 0.25, height + 0.28), (0.22, 0.6, 0.10), "plastic", (0.4, 0.4, 0.4)),
        ]
    )


def sign_post(kind: int) -> Mesh:
    """A traffic sign looking towards -x: no parking (0), priority (1), warning triangle (2), direction arrow (3)."""
    parts = [tube([(0, 0, 0), (0, 0, 2.6)], [0.03, 0.03], "galvanised", _STEEL, 7)]
    angle = np.arange(20) * 2 * np.pi / 20
    circle = np.stack([np.zeros(20), np.cos(angle), np.sin(angle)], axis=1)

    def disc(radius: float, x: float, colour: Colour, sides: int = 20, turn: float = 0.0) -> Mesh:
        a = np.arange(sides) * 2 * np.pi / sides + turn
        ring = circle[:1] * 0 + np.stack([np.zeros(sides), np.cos(a), np.sin(a)], axis=1) * radius
        return grid(np.stack([ring * 0, ring]) + np.array([x, 0, 2.3]), "sign", colour, closed=True)

    if kind == 0:
        parts += [disc(0.30, -0.035, (0.55, 0.02, 0.02)), disc(0.24, -0.038, (0.02, 0.08, 0.42))]
    elif kind == 1:
        parts += [disc(0.36, -0.035, (0.7, 0.7, 0.7), 4), disc(0.27, -0.038, (0.75, 0.48, 0.02), 4)]
    elif kind == 2:
        parts += [
            disc(0.42, -0.035, (0.55, 0.02, 0.02), 3, np.pi / 2),
            disc(0.27, -0.038, (0.72, 0.72, 0.72), 3, np.pi / 2),
        ]
    else:
        parts += [
            disc(0.30, -0.035, (0.02, 0.08, 0.42)),
            panel(
                (-0.04, -0.05, 2.1),
                (-0.04, 0.05, 2.1),
                (-0.04, 0.05, 2.5),
                (-0.04, -0.05, 2.5),
                "sign",
                (0.75, 0.75, 0.75),
            ),
        ]
    parts.append(disc(0.29, -0.028, (0.3, 0.3, 0.3)))
    return Mesh.join(parts)


def traffic_light() -> Mesh:
    """A signal on a post, looking towards -x."""
    parts = [
        tube([(0, 0, 0), (0, 0, 3.4)], [0.06, 0.05], "galvanised", _STEEL, 8),
        box((-0.1, 0, 2.95), (0.2, 0.30, 0.92), "plastic", (0.02, 0.025, 0.02)),
    ]
    for z, colour in ((3.24, (0.9, 0.06, 0.03)), (2.95, (0.10, 0.06, 0.01)), (2.66, (0.01, 0.06, 0.03))):
        parts.append(ellipsoid((-0.2, 0, z), (0.02, 0.1, 0.1), "tail_lamp" if z > 3.2 else "plastic", colour, 6))
    return Mesh.join(parts)


def bench() -> Mesh:
    """A bench 1.8 m long across y whose seat is 0.45 m high and looks towards +x."""
    parts = [
        box((0.1, 0, 0.43), (0.42, 1.8, 0.05), "wood", (0.28, 0.17, 0.09)),
        box((-0.14, 0, 0.70), (0.05, 1.8, 0.32), "wood", (0.28, 0.17, 0.09)),
    ]
    for y in (-0.75, 0.75):
        parts.append(box((0.08, y, 0.21), (0.4, 0.06, 0.42), "galvanised", _DARK))
    return Mesh.join(parts)


def litter_bin() -> Mesh:
    """A round bin."""
    return tube([(0, 0, 0.15), (0, 0, 0.9)], [0.20, 0.22], "plastic", (0.12, 0.20, 0.12), 10)


def bollard() -> Mesh:
    """A post against parking."""
    return Mesh.join(
        [
            tube([(0, 0, 0), (0, 0, 0.85)], [0.055, 0.05], "galvanised", _STEEL, 8),
            tube([(0, 0, 0.62), (0, 0, 0.74)], [0.057, 0.057], "sign", (0.7, 0.7, 0.7), 8),
        ]
    )


def delineator() -> Mesh:
    """A white roadside post with a dark band."""
    return Mesh.join(
        [
            box((0, 0, 0.5), (0.09, 0.12, 1.0), "plain", (0.7, 0.7, 0.7)),
            box((0, 0, 0.82), (0.095, 0.125, 0.2), "sign", (0.05, 0.05, 0.05)),
        ]
    )


def bus_shelter() -> Mesh:
    """A shelter along x, open towards -y."""
    glass = (0.05, 0.06, 0.06)
    parts = [
        box((0, 0.6, 2.4), (4.2, 1.5, 0.10), "plastic", (0.25, 0.26, 0.27)),
        panel((-2, 1.25, 0.3), (2, 1.25, 0.3), (2, 1.25, 2.2), (-2, 1.25, 2.2), "glass", glass),
        box((0, 1.0, 0.45), (2.6, 0.35, 0.05), "wood", (0.25, 0.16, 0.1)),
    ]
    for x in (-2.0, 0.0, 2.0):
        parts.append(box((x, 1.25, 1.2), (0.07, 0.07, 2.4), "galvanised", _STEEL))
    parts.append(panel((2, 0.0, 0.3), (2, 1.2, 0.3), (2, 1.2, 2.0), (2, 0.0, 2.0), "sign", (0.5, 0.42, 0.2)))
    return Mesh.join(parts)


def guard_rail(length: float) -> Mesh:
    """A steel crash barrier along x."""
    wave = np.array([(0.0, 0.45), (-0.06, 0.52), (0.0, 0.60), (-0.06, 0.68), (0.0, 0.75)])
    rows = [np.concatenate([np.full((5, 1), x), wave], axis=1) for x in np.linspace(-length / 2, length / 2, 3)]
    parts = [grid(np.stack(rows), "galvanised", (0.40, 0.41, 0.42))]
    parts += [
        box((x, 0.08, 0.35), (0.1, 0.06, 0.7), "galvanised", _STEEL)
        for x in np.arange(-length / 2 + 1, length / 2, 4.0)
    ]
    return Mesh.join(parts)


def billboard(colour: Colour) -> Mesh:
    """A hoarding that looks towards -x."""
    parts = [
        box((0.05, 0, 2.9), (0.12, 3.8, 2.7), "plastic", (0.2, 0.2, 0.2)),
        panel((-0.02, 1.75, 1.7), (-0.02, -1.75, 1.7), (-0.02, -1.75, 4.1), (-0.02, 1.75, 4.1), "plain", colour),
        panel(
            (-0.025, 1.3, 2.2), (-0.025, -0.2, 2.2), (-0.025, -0.2, 3.6), (-0.025, 1.3, 3.6), "checks", (0.7, 0.66, 0.5)
        ),
    ]
    parts += [tube([(0.1, y, 0), (0.1, y, 2.0)], [0.07, 0.07], "galvanised", _STEEL, 6) for y in (-1.2, 1.2)]
    return Mesh.join(parts)

"""Paths, terrain and the strips of road, kerb, pavement and verge along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcf3d.simulation.meshes.primitives import Mesh, grid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Terrain:
    """A rolling surface.

    Attributes:
        phases: of the three long waves.
        amplitude: of the long waves; up to 0.12 m the slope stays below one per cent.
        hollows: (amplitude, phase, phase) of shorter waves, 60 to 80 m long.
        slope: rise by metre along x and y.
    """

    phases: tuple[float, float, float]
    amplitude: float
    hollows: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slope: tuple[float, float] = (0.0, 0.0)

    def height(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Height in metres at world positions."""
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        a, b, c = self.phases
        value: Floats = self.amplitude * (
            np.sin(x / 41 + a) + 0.6 * np.sin(y / 33 + b) + 0.5 * np.sin((x + y) / 57 + c)
        )
        depth, d, e = self.hollows
        if depth:
            value = value + depth * np.sin(x / 13 + d) * np.sin(y / 11 + e)
            value = value + self.slope[0] * x + self.slope[1] * y
        return value

    def normal(self, x: float, y: float, reach_m: float = 1.4) -> Floats:
        """(3,) unit normal of the surface at a place, from heights ``reach_m`` around it."""
        ahead = self.height([x - reach_m, x + reach_m], y)
        left = self.height(x, [y - reach_m, y + reach_m])
        up = np.array([ahead[0] - ahead[1], left[0] - left[1], 2 * reach_m])
        result: Floats = up / np.linalg.norm(up)
        return result


def make_terrain(rng: np.random.Generator, relief_m: float = 0.0) -> Terrain:
    """Land that is almost flat, or rolls by up to about ``relief_m`` with a slope and hollows."""
    phases, amplitude = tuple(rng.uniform(0, 6.28, 3)), float(rng.uniform(0.02, 0.12))
    if not relief_m:
        return Terrain(phases, amplitude)  # type: ignore[arg-type]
    strength = float(rng.beta(1.2, 2.0))
    hollows = (0.09 * strength * float(rng.uniform(0.2, 1.0)), *rng.uniform(0, 6.28, 2))
    slope = tuple(0.03 * relief_m * rng.normal(size=2))
    return Terrain(phases, 0.05 + relief_m * strength, hollows, slope)  # type: ignore[arg-type]


class Path:
    """A smooth curve through the world, by arc length.

    Args:
        start: (x, y) at arc length ``first``.
        heading: direction there in radians.
        first: arc length at which the path begins.
        last: arc length at which it ends.
        curvature: 1 / m, constant between 0 and ``last``; straight before.
    """

    def __init__(
        self, start: tuple[float, float], heading: float, first: float, last: float, curvature: float = 0.0
    ) -> None:
        self.first, self.last = first, last
        self._s = np.arange(np.floor(first), np.ceil(last) + 1.0)
        bend = curvature * np.clip((self._s - 5) / 25, 0, 1)
        self._heading = heading + np.concatenate([[0], np.cumsum((bend[:-1] + bend[1:]) / 2)])
        self._x = start[0] + np.concatenate([[0], np.cumsum(np.cos((self._heading[:-1] + self._heading[1:]) / 2))])
        self._y = start[1] + np.concatenate([[0], np.cumsum(np.sin((self._heading[:-1] + self._heading[1:]) / 2))])

    def at(self, s: float | Floats, offset: float | Floats = 0.0) -> tuple[Floats, Floats, Floats]:
        """World x, y and heading at arc length ``s``, ``offset`` metres to the left."""
        s = np.asarray(s, dtype=np.float64)
        heading = np.interp(s, self._s, self._heading)
        x = np.interp(s, self._s, self._x) - np.sin(heading) * offset
        y = np.interp(s, self._s, self._y) + np.cos(heading) * offset
        return x, y, heading

    def pieces(self, first: float, last: float, gaps: list[tuple[float, float]]) -> list[tuple[float, float]]:
        """The stretches of [first, last] outside the ``gaps``."""
        result, cursor = [], first
        for a, b in sorted(gaps):
            if a > cursor:
                result.append((cursor, min(a, last)))
            cursor = max(cursor, b)
        if cursor < last:
            result.append((cursor, last))
        return [(a, b) for a, b in result if b - a > 0.05]


def strip(
    path: Path,
    terrain: Terrain,
    stretch: tuple[float, float],
    across: tuple[float, ...],
    lift: tuple[float, ...],
    material: str,
    colour: tuple[float, float, float],
    step: float = 4.0,
) -> Mesh:
    """A surface along a path: ``across`` are offsets to the left, ``lift`` the heights of those above the terrain.

    uv is (arc length, offset) in metres.
    """
    count = max(2, int(np.ceil((stretch[1] - stretch[0]) / step)) + 1)
    s = np.linspace(*stretch, count)
    columns, uv = [], []
    for offset, height in zip(across, lift, strict=True):
        x, y, _ = path.at(s, offset)
        columns.append(np.stack([x, y, terrain.height(x, y) + height], axis=1))
        uv.append(np.stack([s, np.full(count, offset)], axis=1))
    return grid(np.stack(columns, axis=1), material, colour, crease=0.6, uv=np.stack(uv, axis=1))


def open_ground(
    terrain: Terrain,
    centre: tuple[float, float],
    extent: float,
    material: str,
    colour: tuple[float, float, float],
    lower: float,
    lines: int = 41,
) -> Mesh:
    """The land below and around everything, fine near ``centre`` and coarse far away."""
    near = np.linspace(-1, 1, lines)
    axis = np.sign(near) * np.abs(near) ** 1.6 * extent
    x, y = np.meshgrid(axis + centre[0], axis + centre[1], indexing="ij")
    far = np.clip(np.hypot(x - centre[0], y - centre[1]) / 150 - 1, 0, 1)
    z = terrain.height(x, y) * (1 - far) - lower
    return grid(np.stack([x, y, z], axis=2), material, colour, uv=np.stack([x, y], axis=2), crease=-1.0)


def skyline(centre: tuple[float, float], rng: np.random.Generator) -> Mesh:
    """Distant wooded hills all around, 420 m away."""
    angle = np.linspace(0, 2 * np.pi, 241)
    waves = sum(np.sin(angle * k + rng.uniform(0, 6.28)) / k**0.8 for k in (2, 3, 5, 9, 17))
    height = 13 + 7 * np.clip(waves, -1.4, 2) + rng.uniform(0, 1.2, len(angle))
    height[-1] = height[0]
    x, y = centre[0] + 420 * np.cos(angle), centre[1] + 420 * np.sin(angle)
    rows = np.stack([np.stack([x, y, np.full_like(x, -6.0)], axis=1), np.stack([x * 1.02, y * 1.02, height], axis=1)])
    return grid(rows, "leaves", (0.07, 0.10, 0.05), crease=-1.0)

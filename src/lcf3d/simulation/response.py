"""Intensities as a 64-beam scanner really reports them: by material, unevenly calibrated beams, many zeros."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.materials import MATERIALS, Kind

_BY_KIND: Final[dict[Kind, tuple[float, float]]] = {
    Kind.DIFFUSE: (0.0, 1.15),
    Kind.PAINT: (0.46, 0.70),
    Kind.GLASS: (0.50, 0.60),
    Kind.ROAD: (0.02, 1.0),
    Kind.GROUND: (0.0, 1.02),
    Kind.FACADE: (0.10, 0.68),
    Kind.LAMP: (0.10, 0.90),
    Kind.FOLIAGE: (0.0, 0.70),
    Kind.METAL: (0.40, 0.75),
}
_BY_NAME: Final[dict[str, tuple[float, float]]] = {
    "rubber": (0.35, 1.3),
    "plastic": (0.35, 1.0),
    "wall": (0.10, 0.68),
    "brick": (0.10, 0.68),
    "roof": (0.15, 0.75),
    "concrete": (0.10, 0.75),
    "tarpaulin": (0.25, 0.75),
    "container": (0.35, 0.65),
}
"""Share of returns set to zero and factor on the others, fitted to KITTI's cars, roads, walls and people."""


@lru_cache(maxsize=1)
def _table() -> NDArray[np.float32]:
    rows = [_BY_NAME.get(m.name, _BY_KIND[m.kind]) for m in MATERIALS]
    return np.array(rows, dtype=np.float32)


def respond(
    intensity: NDArray[np.float32],
    material: NDArray[np.integer],
    ring: NDArray[np.integer],
    beams: int,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Intensities (N,) in [0, 1] that a scanner reports for ideal ones.

    Args:
        intensity: (N,) ideal intensities.
        material: (N,) indices into ``MATERIALS``.
        ring: (N,) beams.
        beams: number of beams; each has a gain of its own, drawn anew for every scan.
        rng: random numbers.
    """
    faint = rng.random(beams) < 0.25
    gains = np.where(faint, rng.uniform(0.15, 0.9, beams), rng.normal(1.03, 0.12, beams)) * rng.normal(1.0, 0.08)
    zero, factor = _table()[material].T
    value = intensity * factor * gains.clip(0.2, 1.3).astype(np.float32)[ring]
    dropped = rng.random(len(intensity), dtype=np.float32) < zero
    result: NDArray[np.float32] = np.where(dropped, np.float32(0), value).astype(np.float32)
    return result

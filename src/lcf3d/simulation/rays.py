"""Rays against triangles, through Embree (optional dependency ``embreex``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import MissingExtraError

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of N rays.

    Attributes:
        triangle: (N,) int32 index of the triangle, -1 for none.
        distance: (N,) float32 metres along the unit direction; undefined without a hit.
        u: (N,) float32 weight of the triangle's second corner.
        v: (N,) float32 weight of its third corner.
    """

    triangle: NDArray[np.int32]
    distance: Floats
    u: Floats
    v: Floats


class RayTracer:
    """A static scene of triangles to shoot rays at; calls release the interpreter lock.

    Args:
        corners: (T, 3, 3) triangle corners.

    Raises:
        MissingExtraError: embreex is not installed.
    """

    def __init__(self, corners: NDArray[np.floating]) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise MissingExtraError("embreex", "simulate", "ray casting") from None
        self._scene: Any = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(corners, dtype=np.float32))
        # the first query builds the search tree, which must not happen in two threads at once
        self.first_hits(np.zeros(3), np.array([[0, 0, 1.0]]))

    def first_hits(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """First hits from (N, 3) or one common (3,) origin along (N, 3) unit directions."""
        o, d = _rays(origins, directions)
        found = self._scene.run(o, d, query="INTERSECT", output=1)
        return Hits(found["primID"], found["tfar"], found["u"], found["v"])

    def is_blocked(
        self, origins: NDArray[np.floating], directions: NDArray[np.floating], reach_m: float = 1e4
    ) -> NDArray[np.bool_]:
        """(N,) whether anything lies within ``reach_m`` along the rays."""
        o, d = _rays(origins, directions)
        if not len(o):
            return np.zeros(0, dtype=bool)
        limits = np.full(len(o), reach_m, dtype=np.float32)
        blocked: NDArray[np.bool_] = self._scene.run(o, d, limits, query="OCCLUDED") == 0
        return blocked


def _rays(origins: NDArray[np.floating], directions: NDArray[np.floating]) -> tuple[Floats, Floats]:
    d = np.ascontiguousarray(directions, dtype=np.float32)
    o = np.ascontiguousarray(np.broadcast_to(np.asarray(origins, dtype=np.float32), d.shape))
    return o, d

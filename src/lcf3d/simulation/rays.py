"""Rays against triangles, through Embree (optional dependency ``embreex``)."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
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
        if find_spec("embreex") is None:
            raise MissingExtraError("embreex", "simulate", "ray casting")
        from lcf3d.simulation.embree import Tree, library

        tree = Tree if library() is not None else _EmbreexTree
        self._tree: Any = tree(np.ascontiguousarray(corners, dtype=np.float32))

    def first_hits(self, origins: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """First hits from (N, 3) or one common (3,) origin along (N, 3) unit directions."""
        return Hits(*self._tree.first_hits(*_rays(origins, directions)))

    def is_blocked(
        self, origins: NDArray[np.floating], directions: NDArray[np.floating], reach_m: float = 1e4
    ) -> NDArray[np.bool_]:
        """(N,) whether anything lies within ``reach_m`` along the rays."""
        o, d = _rays(origins, directions)
        if not len(d):
            return np.zeros(0, dtype=bool)
        blocked: NDArray[np.bool_] = self._tree.is_blocked(o, d, reach_m)
        return blocked


class _EmbreexTree:
    """`lcf3d.simulation.embree.Tree` by embreex, where its library is not found: slower to build, the same results."""

    def __init__(self, corners: Floats) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene: Any = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, corners)
        # the first query builds the search tree, which must not happen in two threads at once
        self.first_hits(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    def first_hits(self, origins: Floats, directions: Floats) -> tuple[NDArray[np.int32], Floats, Floats, Floats]:
        found = self._scene.run(_each(origins, directions), directions, query="INTERSECT", output=1)
        return found["primID"], found["tfar"], found["u"], found["v"]

    def is_blocked(self, origins: Floats, directions: Floats, reach_m: float) -> NDArray[np.bool_]:
        limits = np.full(len(directions), reach_m, dtype=np.float32)
        blocked: NDArray[np.bool_] = (
            self._scene.run(_each(origins, directions), directions, limits, query="OCCLUDED") == 0
        )
        return blocked


def _rays(origins: NDArray[np.floating], directions: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """(1, 3) or (N, 3) origins and (N, 3) directions as they are traced."""
    origins = np.ascontiguousarray(origins, dtype=np.float32).reshape(-1, 3)
    return origins, np.ascontiguousarray(directions, dtype=np.float32)


def _each(origins: Floats, directions: Floats) -> Floats:
    return np.ascontiguousarray(np.broadcast_to(origins, directions.shape))

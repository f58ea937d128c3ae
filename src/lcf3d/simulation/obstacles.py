"""Where scenery stands on the ground, so that nobody is placed inside a tree or a wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.kernels import kernel
from lcf3d.simulation.meshes.primitives import Mesh
from lcf3d.simulation.roads import Terrain

CELL_M = 0.2
LOWEST_M = 0.3
"""What is lower (kerbs, pavements) is no obstacle."""
HIGHEST_M = 3.6
"""What hangs higher (leaves, roofs) is no obstacle."""


class ObstacleMap:
    """Grid of ground cells with something solid above them, for a square around the street.

    Args:
        mesh: the scenery, in the world.
        terrain: height of the land.
        low: (x, y) corner of the square.
        high: its opposite corner.
    """

    def __init__(self, mesh: Mesh, terrain: Terrain, low: tuple[float, float], high: tuple[float, float]) -> None:
        self._low = np.array(low)
        shape = np.ceil((np.array(high) - self._low) / CELL_M).astype(int) + 1
        self._taken = np.zeros(shape, dtype=np.bool_)
        corners = mesh.corners
        ground = terrain.height(corners[:, 0, 0], corners[:, 0, 1])
        z = corners[:, :, 2] - ground[:, None]
        x_low, x_high = _extremes(corners[:, :, 0])
        y_low, y_high = _extremes(corners[:, :, 1])
        z_low, z_high = _extremes(z)
        inside = (x_high > low[0]) & (y_high > low[1]) & (x_low < high[0]) & (y_low < high[1])
        relevant = inside & (z_high > LOWEST_M) & (z_low < HIGHEST_M)
        x0, y0 = self._low.tolist()
        mark_cells(corners[relevant], ground[relevant], x0, y0, CELL_M, LOWEST_M, HIGHEST_M, self._taken)

    def is_free(self, pose: tuple[float, float, float], size: tuple[float, float, float]) -> bool:
        """Whether a footprint (x, y, yaw) of (length, width) covers no taken cell; outside the square all is free."""
        x, y, yaw = pose
        half_length, half_width = size[0] / 2 + CELL_M, size[1] / 2 + CELL_M
        along = np.linspace(-half_length, half_length, max(2, int(2 * half_length / CELL_M) + 2))
        across = np.linspace(-half_width, half_width, max(2, int(2 * half_width / CELL_M) + 2))
        a, b = np.meshgrid(along, across)
        i = ((x + a * np.cos(yaw) - b * np.sin(yaw) - self._low[0]) / CELL_M).astype(np.int64)
        j = ((y + a * np.sin(yaw) + b * np.cos(yaw) - self._low[1]) / CELL_M).astype(np.int64)
        inside = (i >= 0) & (j >= 0) & (i < self._taken.shape[0]) & (j < self._taken.shape[1])
        return not bool(self._taken[i[inside], j[inside]].any())


def _extremes(values: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Least and greatest of (T, 3) values by row; on so short rows quicker than numpy's reductions."""
    a, b, c = values[:, 0], values[:, 1], values[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


@kernel
def mark_cells(corners, ground, x0, y0, cell, lowest, highest, taken):  # type: ignore[no-untyped-def]
    """Mark the cells below points sampled densely on (T, 3, 3) triangles, between two heights above ``ground`` (T,)."""
    for t in range(len(corners)):
        size = 0.0
        for k in range(3):
            for c in range(3):
                size = max(size, abs(corners[t, k, c] - corners[t, (k + 1) % 3, c]))
        steps = int(size / (0.8 * cell)) + 1
        for a in range(steps + 1):
            for b in range(steps + 1 - a):
                u, v = a / steps, b / steps
                w = 1.0 - u - v
                z = w * corners[t, 0, 2] + u * corners[t, 1, 2] + v * corners[t, 2, 2] - ground[t]
                if z < lowest or z > highest:
                    continue
                i = int((w * corners[t, 0, 0] + u * corners[t, 1, 0] + v * corners[t, 2, 0] - x0) / cell)
                j = int((w * corners[t, 0, 1] + u * corners[t, 1, 1] + v * corners[t, 2, 1] - y0) / cell)
                if 0 <= i < taken.shape[0] and 0 <= j < taken.shape[1]:
                    taken[i, j] = True

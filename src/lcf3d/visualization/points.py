"""Points of a scan painted into a camera's image, coloured by depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.geometry.camera import project_points
from lcf3d.structures import Camera

# near to far; differs in lightness too, for eyes that see few hues
_NEAR_M, _FAR_M = 3.0, 60.0
_COLOURS = np.array([[255, 80, 40], [255, 210, 60], [90, 230, 140], [60, 150, 255], [90, 70, 200]], dtype=np.float64)


def paint_points(
    image: NDArray[np.uint8], camera: Camera, points: NDArray[np.floating], radius: int | None = None
) -> NDArray[np.uint8]:
    """The image with every point of the scan that the camera sees, the nearest on top.

    Args:
        image: (H, W, 3) uint8 RGB.
        camera: its calibration.
        points: (N, 3 or more) LiDAR frame.
        radius: of the dots in pixels; one for every 1,200 of the width without it.
    """
    painted = image.copy()
    height, width = image.shape[:2]
    pixels, _ = project_points(points, camera)
    ranges = np.linalg.norm(points[:, :3], axis=1)
    inside = np.isfinite(pixels).all(axis=1)
    inside &= ((pixels >= 0) & (pixels < [width, height])).all(axis=1, where=np.isfinite(pixels))
    order = np.flatnonzero(inside)
    order = order[np.argsort(-ranges[order])]
    places = np.log(np.clip(ranges[order], _NEAR_M, _FAR_M) / _NEAR_M) / np.log(_FAR_M / _NEAR_M) * (len(_COLOURS) - 1)
    colours = np.stack([np.interp(places, np.arange(len(_COLOURS)), channel) for channel in _COLOURS.T], axis=1)
    columns, rows = pixels[order].astype(np.int64).T
    size = width // 1200 + 1 if radius is None else radius
    for dy in range(-size // 2, size // 2 + 1):
        for dx in range(-size // 2, size // 2 + 1):
            y, x = np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)
            painted[y, x] = colours
    return painted

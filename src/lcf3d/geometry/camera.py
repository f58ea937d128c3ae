"""Projection of boxes and points into cameras, with near-plane clipping and visibility."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.geometry.boxes import EDGES, YAW, box_corners
from lcf3d.geometry.lens import (
    NEAR,
    bound_through_lens,
    directions_of_pixels,
    lens_numbers,
    project_through_lens,
)
from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, Camera, FloatArray


def project_points(points: NDArray[np.floating], camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) and depths (N,) of (N, 3 or more) LiDAR-frame points.

    Pixels are NaN where depth <= `NEAR`; through a lens, where the point is outside of its field (a fisheye lens may
    see points of negative depth).
    """
    if camera.distortion is not None:
        pixels, depths = np.empty((len(points), 2)), np.empty(len(points))
        project_through_lens(points, lens_numbers(camera), pixels, depths)
        return pixels, depths
    homogeneous = points[:, :3] @ camera.pixels_from_lidar[:, :3].T + camera.pixels_from_lidar[:, 3]
    depths = homogeneous[:, 2]
    pixels = np.full((len(points), 2), np.nan)
    front = depths > NEAR
    pixels[front] = homogeneous[front, :2] / depths[front, None]
    return pixels, depths


@kernel
def _project_boxes(boxes, cos, sin, edges, projection, limits):  # type: ignore[no-untyped-def]
    """Image boxes (N, 4) of the parts in front of the near plane, clipped to (0, 0, *limits), and (N,) visibility.

    ``cos`` and ``sin`` (N,) are those of the boxes' yaws; corners are in the order of `box_corners`.
    """
    projected, visible = np.zeros((len(boxes), 4)), np.zeros(len(boxes), np.bool_)
    homogeneous = np.empty((8, 3))
    for n in range(len(boxes)):
        x1 = y1 = np.inf
        x2 = y2 = -np.inf
        behind = 0
        for c in range(8):
            length = boxes[n, 3] / 2 if c % 4 < 2 else -(boxes[n, 3] / 2)
            width = boxes[n, 4] / 2 if c % 4 == 0 or c % 4 == 3 else -(boxes[n, 4] / 2)
            height = boxes[n, 5] / 2 if c >= 4 else -(boxes[n, 5] / 2)
            x = boxes[n, 0] + cos[n] * length - sin[n] * width
            y = boxes[n, 1] + sin[n] * length + cos[n] * width
            z = boxes[n, 2] + height
            for r in range(3):
                homogeneous[c, r] = (
                    projection[r, 0] * x + projection[r, 1] * y + projection[r, 2] * z + projection[r, 3]
                )
            if homogeneous[c, 2] >= NEAR:
                u, v = homogeneous[c, 0] / homogeneous[c, 2], homogeneous[c, 1] / homogeneous[c, 2]
                x1, x2, y1, y2 = min(x1, u), max(x2, u), min(y1, v), max(y2, v)
            else:
                behind += 1
        if 0 < behind < 8:
            for e in range(len(edges)):
                a, b = edges[e, 0], edges[e, 1]
                da, db = homogeneous[a, 2] - NEAR, homogeneous[b, 2] - NEAR
                if (da >= 0) != (db >= 0):
                    t = da / (da - db)
                    u = (homogeneous[a, 0] + t * (homogeneous[b, 0] - homogeneous[a, 0])) / NEAR
                    v = (homogeneous[a, 1] + t * (homogeneous[b, 1] - homogeneous[a, 1])) / NEAR
                    x1, x2, y1, y2 = min(x1, u), max(x2, u), min(y1, v), max(y2, v)
        x1, x2 = min(max(x1, 0.0), limits[0]), min(max(x2, 0.0), limits[0])
        y1, y2 = min(max(y1, 0.0), limits[1]), min(max(y2, 0.0), limits[1])
        if x2 > x1 and y2 > y1:
            visible[n] = True
            projected[n, 0], projected[n, 1], projected[n, 2], projected[n, 3] = x1, y1, x2, y2
    return projected, visible


def project_boxes(boxes: FloatArray, camera: Camera) -> tuple[FloatArray, BoolArray]:
    """Image boxes of 3D boxes (docs/method.md, projection; paper section 4.1.3).

    Each box is cut at the near plane, or where the field of a lens ends, projected, bounded by an axis-aligned
    rectangle and clipped to the image.

    Args:
        boxes: (N, 7) canonical boxes.
        camera: where to project.

    Returns:
        (N, 4) pixel boxes clipped to the image, zeros where not visible; and (N,) whether they have positive area.
    """
    if camera.distortion is None:
        # copies, so that one compiled version serves arrays that are read-only and others
        own, matrix, limits = (
            np.array(boxes, order="C"),
            np.array(camera.pixels_from_lidar),
            (camera.width, camera.height),
        )
        projected: tuple[FloatArray, BoolArray] = _project_boxes(
            own, np.cos(own[:, YAW]), np.sin(own[:, YAW]), EDGES, matrix, limits
        )
        return projected
    bounds = np.empty((len(boxes), 4))
    bound_through_lens(boxes, box_corners(boxes), EDGES, lens_numbers(camera), bounds)
    clipped = np.empty_like(bounds)
    np.clip(bounds[:, 0::2], 0, camera.width, out=clipped[:, 0::2])
    np.clip(bounds[:, 1::2], 0, camera.height, out=clipped[:, 1::2])
    visible = (clipped[:, 2] > clipped[:, 0]) & (clipped[:, 3] > clipped[:, 1])
    clipped[~visible] = 0
    return clipped, visible


def depths_of(points: NDArray[np.floating], camera: Camera) -> FloatArray:
    """(N,) depths in metres of (N, 3) LiDAR-frame points along the camera's optical axis."""
    depths: FloatArray = points[:, :3] @ camera.pixels_from_lidar[2, :3] + camera.pixels_from_lidar[2, 3]
    return depths


def pixel_rays(pixels: FloatArray, camera: Camera) -> FloatArray:
    """(N, 3) directions in the LiDAR frame, of any length, of the rays through (N, 2) pixels.

    A pixel outside of a lens's field gives the direction on its border that lies on the pixel's side.
    """
    if camera.distortion is None:
        homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        rays: FloatArray = homogeneous @ np.linalg.inv(camera.pixels_from_lidar[:, :3]).T
        return rays
    directions, _ = directions_of_pixels(pixels, camera)
    camera_from_lidar = np.linalg.solve(camera.intrinsics, camera.pixels_from_lidar[:, :3])
    turned: FloatArray = directions @ np.linalg.inv(camera_from_lidar).T
    return turned


def pixels_in_field(pixels: FloatArray, camera: Camera) -> BoolArray:
    """(N,) whether (N, 2) pixels show anything: a fisheye lens may leave the corners of its image black."""
    if camera.distortion is None:
        return np.ones(len(pixels), dtype=bool)
    return directions_of_pixels(pixels, camera)[1]


def cut_by_field(boxes: FloatArray, camera: Camera) -> BoolArray:
    """(N,) whether (N, 4) pixel boxes reach the border of a lens's field within the image, to two pixels."""
    cut = np.zeros(len(boxes), dtype=bool)
    if camera.distortion is None:
        return cut
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    for side, way in ((0, -2.0), (1, -2.0), (2, 2.0), (3, 2.0)):
        pixels = middle.copy()
        pixels[:, side % 2] = boxes[:, side] + way
        cut |= ~pixels_in_field(pixels, camera)
    return cut


def require_pinhole(camera: Camera, what: str) -> None:
    """Refuse a camera whose lens has no place in ``what``, a format or a method.

    Raises:
        ConfigError: the camera has a distortion.
    """
    if camera.distortion is not None:
        raise ConfigError(
            f"{what} has no place for the {camera.distortion.model} distortion of camera {camera.name!r}; undistort "
            "its images first and give the pinhole camera that they then have"
        )

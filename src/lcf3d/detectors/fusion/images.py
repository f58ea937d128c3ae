"""What a network makes of a camera's image before its first layer; numpy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import Image
from lcf3d.errors import DatasetError, ShapeError
from lcf3d.geometry.camera import project_points
from lcf3d.structures import BoolArray, Camera, Frame, IntArray

_ONE = 2048
"""1 in the fixed-point weights of `resize_bilinear`."""


def image_of(frame: Frame, camera: Camera) -> Image:
    """(H, W, 3) uint8 RGB image of a camera.

    Raises:
        DatasetError: the frame has none.
        ShapeError: it is no RGB image of the size that the calibration is for.
    """
    if camera.name not in frame.images:
        raise DatasetError(f"frame {frame.id} has no image of camera {camera.name}, which the network needs")
    image = frame.images[camera.name]
    if image.shape != (camera.height, camera.width, 3):
        raise ShapeError(
            f"the image of camera {camera.name} in frame {frame.id} must have shape "
            f"{(camera.height, camera.width, 3)} as its calibration says, got {image.shape}"
        )
    return image


def points_in_image(points: NDArray[np.floating], camera: Camera) -> BoolArray:
    """(N,) whether each of the (N, 3 or more) points is seen by the camera (what OpenMMLab's KITTI training keeps)."""
    pixels, _ = project_points(points, camera)
    u, v = pixels.T
    inside: BoolArray = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return inside


def resize_bilinear(image: Image, width: int, height: int) -> Image:
    """The (H, W, 3) uint8 image at another size, in the fixed-point arithmetic that training pipelines resize with.

    Bilinear between pixel centres without smoothing; weights are multiples of 1 / 2048. To the bit what OpenCV makes.
    """
    left, right, weights = _taps(image.shape[1], width)
    values = image.astype(np.int32)
    rows = values[:, left] * weights[0][:, None] + values[:, right] * weights[1][:, None]
    upper, lower, weights = _taps(image.shape[0], height)
    rows >>= 4
    sums = (rows[upper] * weights[0][:, None, None] >> 16) + (rows[lower] * weights[1][:, None, None] >> 16)
    return ((sums + 2) >> 2).astype(np.uint8)


def _taps(old: int, new: int) -> tuple[IntArray, IntArray, tuple[NDArray[np.int32], NDArray[np.int32]]]:
    """For each of ``new`` places along an axis of ``old`` pixels: the pixel before and after, and their weights."""
    position = ((np.arange(new) + 0.5) * (old / new) - 0.5).astype(np.float32)
    before = np.floor(position).astype(np.int64)
    fraction = position - before.astype(np.float32)
    weights = [np.rint(part * np.float32(_ONE)).astype(np.int32) for part in (1 - fraction, fraction)]
    return before.clip(0, old - 1), (before + 1).clip(0, old - 1), (weights[0], weights[1])

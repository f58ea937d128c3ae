"""What a network makes of a camera's image before its first layer; numpy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import Image
from lcf3d.errors import DatasetError, ShapeError
from lcf3d.geometry.camera import project_points
from lcf3d.structures import BoolArray, Camera, Frame


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

"""The image of a camera, where it is there and fits its calibration."""

from __future__ import annotations

from lcf3d.detectors.base import Image
from lcf3d.errors import DatasetError, ShapeError
from lcf3d.frame import Frame
from lcf3d.geometry.camera import require_pinhole
from lcf3d.structures import Camera


def image_of(frame: Frame, camera: Camera) -> Image:
    """(H, W, 3) uint8 RGB image of a camera.

    Raises:
        DatasetError: the frame has none.
        ShapeError: it is no RGB image of the size that the calibration is for.
        ConfigError: it was taken through a lens that is no pinhole, which the networks know nothing of.
    """
    require_pinhole(camera, "a network that projects points into images")
    if camera.name not in frame.images:
        raise DatasetError(f"frame {frame.id} has no image of camera {camera.name}, which the network needs")
    image = frame.images[camera.name]
    if image.shape != (camera.height, camera.width, 3):
        raise ShapeError(
            f"the image of camera {camera.name} in frame {frame.id} must have shape "
            f"{(camera.height, camera.width, 3)} as its calibration says, got {image.shape}"
        )
    return image

"""Images brought to a network's input, and boxes and masks brought back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from lcf3d.detectors.base import Image
from lcf3d.detectors.camera.onnx_layouts import Layout
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, InstanceMask

# the grey that fills what a letterbox leaves free, as YOLOX and Ultralytics train with
PADDING = 114
ALMOST = 1.02
"""An image that would be magnified by less than this is taken as it is: resampling would blur it for nothing."""
IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32)
IMAGENET_STD = np.array([0.229, 0.224, 0.225], dtype=np.float32)


@dataclass(frozen=True)
class Placement:
    """Where an image lies in the network's input: ``input = image * scale + offset``, in pixels, for x and y.

    Attributes:
        scale: (x, y).
        offset: (x, y) pixels.
        width: of the image in pixels.
        height: of the image in pixels.
    """

    scale: tuple[float, float]
    offset: tuple[int, int]
    width: int
    height: int

    def to_image(self, boxes: FloatArray) -> FloatArray:
        """(N, 4) boxes of the network's input as boxes of the image, clipped to it."""
        image: FloatArray = (boxes - np.tile(self.offset, 2)) / np.tile(self.scale, 2)
        image[:, 0::2] = np.clip(image[:, 0::2], 0, self.width)
        image[:, 1::2] = np.clip(image[:, 1::2], 0, self.height)
        return image


def prepare_image(
    image: Image, size: tuple[int, int], layout: Layout, imagenet: bool = False
) -> tuple[NDArray[np.float32], Placement]:
    """The network's input for an image.

    Args:
        image: (H, W, 3) uint8 RGB.
        size: (height, width) of the input.
        layout: says how the image fits in, the channel order and the divisor.
        imagenet: after division, subtract ImageNet's mean and divide by its deviation.

    Returns:
        (1, 3, height, width) float32 and where the image lies in it.
    """
    height, width = image.shape[:2]
    scales = (size[1] / width, size[0] / height)
    if layout.fit != "stretch":
        scale = min(scales)
        scales = (1.0 if 1 < scale < ALMOST else scale,) * 2
    fitted = (max(1, round(width * scales[0])), max(1, round(height * scales[1])))
    resized = image
    if fitted != (width, height):
        resized = np.asarray(PIL.Image.fromarray(image).resize(fitted, PIL.Image.Resampling.BILINEAR))
    free = (size[1] - fitted[0], size[0] - fitted[1])
    offset = (free[0] // 2, free[1] // 2) if layout.fit == "centre" else (0, 0)
    values = np.full((1, 3, *size), np.float32(PADDING) / np.float32(layout.divisor), dtype=np.float32)
    _fill(values[0], np.ascontiguousarray(resized), offset[0], offset[1], layout.bgr, np.float32(layout.divisor))
    if imagenet:
        values = (values - IMAGENET_MEAN[:, None, None]) / IMAGENET_STD[:, None, None]
    # the image was rounded to whole pixels, so the true scale is that of the rounded size
    placement = Placement((fitted[0] / width, fitted[1] / height), offset, width, height)
    return values, placement


@kernel
def _fill(values, image, left, top, bgr, divisor):  # type: ignore[no-untyped-def]
    """Put (h, w, 3) pixels over a divisor into the planes (3, H, W), from a place on."""
    for channel in range(3):
        source = 2 - channel if bgr else channel
        for y in range(image.shape[0]):
            for x in range(image.shape[1]):
                values[channel, top + y, left + x] = np.float32(image[y, x, source]) / divisor


def instance_masks(
    coefficients: NDArray[np.floating],
    prototypes: NDArray[np.floating],
    boxes: FloatArray,
    placement: Placement,
    size: tuple[int, int],
) -> tuple[InstanceMask, ...]:
    """Masks of detections from their coefficients and the shared prototypes, at the image's resolution.

    A pixel belongs to the object when its centre lies in the box and the bilinearly interpolated sum of prototypes,
    weighted by the coefficients, is positive (a sigmoid above one half).

    Args:
        coefficients: (N, K) of the detections.
        prototypes: (K, h, w) over the whole network input.
        boxes: (N, 4) their boxes in image pixels.
        placement: of the image in the network's input.
        size: (height, width) of the network's input.
    """
    shape = prototypes.shape[1:]
    masks = []
    for box, weights in zip(boxes, coefficients, strict=True):
        first = np.ceil(box[:2] - 0.5).astype(int)
        columns, rows = (np.arange(first[i], int(np.ceil(box[2 + i] - 0.5))) for i in (0, 1))
        if not (len(columns) and len(rows)):
            masks.append(InstanceMask(0, 0, np.zeros((0, 0), dtype=bool)))
            continue
        x, y = (
            ((pixels + 0.5) * placement.scale[i] + placement.offset[i]) * shape[1 - i] / size[1 - i] - 0.5
            for i, pixels in enumerate((columns, rows))
        )
        left, right, across = _interpolation(x, shape[1])
        above, below, down = _interpolation(y, shape[0])
        corner_x, corner_y = int(left[0]), int(above[0])
        crop = prototypes[:, corner_y : int(below[-1]) + 1, corner_x : int(right[-1]) + 1]
        logits = np.tensordot(np.asarray(weights, dtype=crop.dtype), crop, axes=1)
        wide = logits[:, left - corner_x] * (1 - across) + logits[:, right - corner_x] * across
        full = wide[above - corner_y] * (1 - down[:, None]) + wide[below - corner_y] * down[:, None]
        masks.append(InstanceMask(int(first[0]), int(first[1]), full > 0))
    return tuple(masks)


def _interpolation(
    positions: FloatArray, length: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Lower and upper cell and the upper one's weight for each position; ends are held."""
    positions = np.clip(positions, 0, length - 1)
    lower = np.floor(positions).astype(np.intp)
    return lower, np.minimum(lower + 1, length - 1), (positions - lower).astype(np.float32)

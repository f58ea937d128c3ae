"""Images at another size, as the training pipelines of published networks make them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import Image
from lcf3d.structures import IntArray

_ONE = 2048
"""1 in the fixed-point weights of `resize_bilinear`."""


def fitted_size(width: int, height: int, box: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of an image when its longer and shorter side fit those of ``box``, in its proportions."""
    scale = min(max(box) / max(width, height), min(box) / min(width, height))
    return int(width * scale + 0.5), int(height * scale + 0.5)


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

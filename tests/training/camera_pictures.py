"""Tiny labelled images: coloured rectangles on grey, so that everything about them is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcf3d.training.camera_images import LabelledImage
from lcf3d.training.samples import ImageSample

COLOURS = {"Car": (200, 30, 30), "Pedestrian": (30, 200, 30), "Cyclist": (30, 30, 200)}


def sample(
    objects: Sequence[tuple[str, tuple[int, int, int, int]]],
    size: tuple[int, int] = (64, 96),
    hidden: Sequence[float] | None = None,
) -> ImageSample:
    """A sample with an image of (height, width) and a filled rectangle for each (class name, box)."""
    image = np.full((*size, 3), 90, dtype=np.uint8)
    owner = np.zeros(size, dtype=np.uint8)
    for number, (name, (x1, y1, x2, y2)) in enumerate(objects, 1):
        image[y1:y2, x1:x2] = COLOURS.get(name, (250, 250, 0))
        owner[y1:y2, x1:x2] = number
    boxes = np.array([box for _, box in objects], dtype=float).reshape(-1, 4)
    names = np.array([name for name, _ in objects], dtype=np.str_)
    share = np.zeros(len(boxes)) if hidden is None else np.array(hidden, dtype=float)
    return ImageSample(image, boxes, boxes.copy(), names, share, np.zeros(len(boxes)), owner)


def picture(
    objects: Sequence[tuple[str, tuple[int, int, int, int]]], size: tuple[int, int] = (64, 96)
) -> LabelledImage:
    """The same as a labelled image."""
    from lcf3d.training.camera_images import from_sample

    return from_sample(sample(objects, size))

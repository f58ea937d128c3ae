"""Random views of labelled images: cut, scaled, mirrored, and with the light, sharpness and noise of other cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL import ImageEnhance, ImageFilter

from lcf3d.detectors.camera.onnx_images import PADDING
from lcf3d.structures import FloatArray
from lcf3d.training.camera_images import IGNORED, LabelledImage

# pixels of the network's input; smaller objects are neither demanded nor forbidden
LOWEST_HEIGHT, LOWEST_WIDTH = 10.0, 3.0
# objects of which the cut leaves less are neither demanded nor forbidden
LEAST_LEFT = 0.3


@dataclass(frozen=True)
class Augmentation:
    """How views are drawn.

    Attributes:
        scales: smallest and largest factor on the image's size.
        as_it_is: share of the views at the image's own scale.
        gain: largest change of brightness, contrast and each colour, as a share.
        blurred: share of the views that are blurred.
        noisy: share of the views with noise.
        grey: share of the views without colours.
        sought: share of the views that hold a chosen pedestrian or cyclist, which are rarer than cars.
    """

    scales: tuple[float, float] = (0.5, 2.2)
    as_it_is: float = 0.4
    gain: float = 0.3
    blurred: float = 0.25
    noisy: float = 0.3
    grey: float = 0.05
    sought: float = 0.4


def draw_view(
    source: LabelledImage, size: tuple[int, int], settings: Augmentation, rng: np.random.Generator
) -> LabelledImage:
    """A random view of an image.

    Args:
        source: the image.
        size: (height, width) of the view.
        settings: how it is drawn.
        rng: of all that is random.
    """
    low, high = np.log(settings.scales)
    scale = 1.0 if rng.random() < settings.as_it_is else float(np.exp(rng.uniform(low, high)))
    rare = np.flatnonzero(source.labels > 0)
    target = None
    if len(rare) and rng.random() < settings.sought:
        box = source.visible[rng.choice(rare)]
        target = (box[:2] + box[2:]) / 2
    corner = np.array(
        [
            _start(rng, source.image.shape[1 - i], size[1 - i] / scale, None if target is None else target[i])
            for i in (0, 1)
        ]
    )
    view = cut(source, size, scale, corner)
    if rng.random() < 0.5:
        view = mirrored(view)
    image = _developed(view.image, settings, rng)
    return LabelledImage(image, view.boxes, view.visible, view.labels, view.owner, view.numbers)


def cut(source: LabelledImage, size: tuple[int, int], scale: float, corner: FloatArray) -> LabelledImage:
    """The window of an image that starts at ``corner`` (x, y), magnified by ``scale`` to ``size`` (height, width).

    What lies outside the image is grey. Objects of which too little is left, or that become too small, are ignored;
    objects outside are left out.
    """
    image = _window(source.image, size, scale, corner, PIL.Image.Resampling.BILINEAR, PADDING)
    owner = None
    if source.owner is not None:
        owner = _window(source.owner, size, scale, corner, PIL.Image.Resampling.NEAREST, 0)
    shift, bounds = np.tile(corner, 2), np.array([size[1], size[0]] * 2, dtype=np.float64)
    boxes = np.clip((source.boxes - shift) * scale, 0, bounds)
    whole = (source.visible - shift) * scale
    visible = np.clip(whole, 0, bounds)
    kept = (visible[:, 2:] > visible[:, :2]).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    boxes, visible, whole, labels = boxes[kept], visible[kept], whole[kept], source.labels[kept].copy()
    sides, seen = boxes[:, 2:] - boxes[:, :2], visible[:, 2:] - visible[:, :2]
    left = seen.prod(axis=1) / np.maximum((whole[:, 2:] - whole[:, :2]).prod(axis=1), 1e-6)
    labels[(left < LEAST_LEFT) | (sides[:, 1] < LOWEST_HEIGHT) | (sides[:, 0] < LOWEST_WIDTH)] = IGNORED
    return LabelledImage(image, boxes, visible, labels, owner, source.numbers[kept])


def mirrored(view: LabelledImage) -> LabelledImage:
    """The view with left and right exchanged."""
    width = view.image.shape[1]
    boxes, visible = view.boxes.copy(), view.visible.copy()
    for original, turned in ((view.boxes, boxes), (view.visible, visible)):
        turned[:, [0, 2]] = width - original[:, [2, 0]]
    owner = None if view.owner is None else view.owner[:, ::-1]
    return LabelledImage(view.image[:, ::-1], boxes, visible, view.labels, owner, view.numbers)


def _start(rng: np.random.Generator, length: int, window: float, target: float | None) -> float:
    """Where a window of an axis begins: inside where it fits, around the image where it is larger.

    With a target (a position on the axis) the window holds it, as far as the image's ends allow.
    """
    low, high = min(0.0, length - window), max(0.0, length - window)
    if target is not None:
        low, high = float(np.clip(target - 0.9 * window, low, high)), float(np.clip(target - 0.1 * window, low, high))
    return float(rng.uniform(low, high))


def _window(
    pixels: NDArray[np.uint8],
    size: tuple[int, int],
    scale: float,
    corner: FloatArray,
    how: PIL.Image.Resampling,
    filling: int,
) -> NDArray[np.uint8]:
    """The window as ``size`` pixels; only the part inside the image is resampled."""
    limits = np.array([pixels.shape[1], pixels.shape[0]], dtype=np.float64)
    first = np.maximum(0, np.ceil(-corner * scale - 1e-9)).astype(int)
    last = np.minimum([size[1], size[0]], np.floor((limits - corner) * scale + 1e-9)).astype(int)
    canvas = np.full((*size, *pixels.shape[2:]), filling, dtype=np.uint8)
    if (last <= first).any():
        return canvas
    low = np.clip(corner + first / scale, 0, limits)
    high = np.clip(corner + last / scale, 0, limits)
    part = PIL.Image.fromarray(pixels).resize(
        (int(last[0] - first[0]), int(last[1] - first[1])), how, (low[0], low[1], high[0], high[1])
    )
    canvas[first[1] : last[1], first[0] : last[0]] = np.asarray(part)
    return canvas


def _developed(image: NDArray[np.uint8], settings: Augmentation, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image with other brightness, contrast, colours, sharpness and noise."""
    gain = settings.gain
    picture = PIL.Image.fromarray(np.ascontiguousarray(image))
    if rng.random() < settings.blurred:
        picture = picture.filter(ImageFilter.BoxBlur(float(rng.uniform(0.1, 0.9))))
    # now and then no colour at all, as of a grey camera
    colour = 0.0 if rng.random() < settings.grey else rng.uniform(1 - 1.5 * gain, 1 + 1.5 * gain)
    picture = ImageEnhance.Color(picture).enhance(colour)
    factors = rng.uniform(1 - gain, 1 + gain) * rng.uniform(1 - gain / 3, 1 + gain / 3, 3)
    contrast, middle = rng.uniform(1 - gain, 1 + gain), 110.0
    levels = ((np.arange(256) - middle) * contrast + middle)[None] * factors[:, None]
    table: list[int] = np.clip(levels, 0, 255).astype(int).ravel().tolist()
    developed = np.asarray(picture.point(table))
    if rng.random() < settings.noisy:
        noise = rng.standard_normal(developed.shape, dtype=np.float32) * np.float32(rng.uniform(1, 8))
        developed = np.clip(developed + noise, 0, 255).astype(np.uint8)
    return developed

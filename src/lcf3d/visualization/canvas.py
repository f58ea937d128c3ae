"""Anti-aliased lines, and labels that keep out of each other's way."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont

from lcf3d.structures import FloatArray
from lcf3d.visualization.strokes import Strokes

Colour = tuple[int, int, int]

DASH, GAP = 6.0, 4.0
_HALO = (0, 0, 0)
_LABEL_PADDING = 2


class _Label(NamedTuple):
    """A text in its place ``x1, y1, x2, y2``, on a plate (RGBA) if it has one."""

    place: tuple[int, int, int, int]
    text: str
    ink: Colour
    plate: tuple[int, int, int, int] | None
    size: float


@lru_cache(maxsize=8)
def font(size: float) -> PIL.ImageFont.FreeTypeFont | PIL.ImageFont.ImageFont:
    """The font that comes with Pillow, ``size`` pixels high."""
    return PIL.ImageFont.load_default(size)


def text_size(text: str, size: float) -> tuple[int, int]:
    """Width and line height of a text in pixels."""
    return int(np.ceil(font(size).getlength(text))), int(np.ceil(size * 1.25))


class Canvas:
    """Draws over a picture; coordinates are pixels of that picture, fractions allowed.

    Lines go into the picture at once, text on top of all when it is finished.

    Args:
        background: RGB picture, left as it is.
    """

    def __init__(self, background: PIL.Image.Image) -> None:
        self.width, self.height = background.size
        self._strokes = Strokes(np.array(background.convert("RGB")))
        self._labels: list[_Label] = []

    def lines(
        self,
        segments: FloatArray,
        colour: Colour,
        width: float = 2.0,
        opacity: float = 1.0,
        dashed: bool = False,
        halo: bool = False,
    ) -> None:
        """Straight lines.

        Args:
            segments: (M, 4) ``x1, y1, x2, y2``; rows with NaN are skipped.
            colour: RGB.
            width: in pixels.
            opacity: 0 to 1.
            dashed: broken lines.
            halo: a dark rim, for bright pictures.
        """
        if dashed:
            margin = width + 1
            bounds = (-margin, -margin, self.width + margin, self.height + margin)
            segments = _dashes(clip_segments(segments, bounds), width)
        if halo:
            self._strokes.lines(segments, _HALO, width + 1.6, 0.55 * opacity)
        self._strokes.lines(segments, colour, width, opacity)

    def polygon(self, corners: FloatArray, colour: Colour, opacity: float) -> None:
        """A filled polygon with (K, 2) corners."""
        self._strokes.polygon(corners, colour, opacity)

    def label(
        self, around: Sequence[float], text: str, colour: Colour, size: float = 12.0, filled: bool = True
    ) -> bool:
        """A label beside a box, where it covers no other label; left out when there is no such place.

        Args:
            around: ``x1, y1, x2, y2`` of what is labelled.
            text: one line.
            colour: of the plate (``filled``, the text is then black) or of the text.
            size: font size in pixels.
            filled: whether the text stands on a plate of the colour.

        Returns:
            Whether a place was found.
        """
        width, height = text_size(text, size)
        width, height = width + 2 * _LABEL_PADDING, height + _LABEL_PADDING
        x1, y1, x2, y2 = around
        for x, y in (
            (x1, y1 - height),
            (x2 - width, y1 - height),
            (x1, y2),
            (x2 - width, y2),
            (x2, y1),
            (x1 - width, y1),
            (x1, y1),
        ):
            place = (round(x), round(y), round(x) + width, round(y) + height)
            inside = place[0] >= 0 and place[1] >= 0 and place[2] <= self.width and place[3] <= self.height
            if inside and not any(_overlap(place, other.place) for other in self._labels):
                ink, plate = (_HALO, (*colour, 235)) if filled else (colour, (*_HALO, 150))
                self._labels.append(_Label(place, text, ink, plate, size))
                return True
        return False

    def text(self, x: float, y: float, text: str, colour: Colour, size: float = 12.0, plate: bool = False) -> None:
        """Text with its top left corner at a place, on a dark ``plate`` or none; later labels keep away from it."""
        width, height = text_size(text, size)
        place = (round(x) - _LABEL_PADDING, round(y), round(x) + width + _LABEL_PADDING, round(y) + height)
        self._labels.append(_Label(place, text, colour, (*_HALO, 150) if plate else None, size))

    def image(self) -> PIL.Image.Image:
        """The finished RGB picture."""
        pixels = self._strokes.pixels
        for label in self._labels:
            if label.plate is not None:
                x1, y1, x2, y2 = np.maximum(label.place, 0)
                *rgb, alpha = label.plate
                under = pixels[y1:y2, x1:x2]
                under[:] = (under * (1 - alpha / 255) + np.array(rgb) * (alpha / 255) + 0.5).astype(np.uint8)
        picture = PIL.Image.fromarray(pixels)
        draw = PIL.ImageDraw.Draw(picture)
        for label in self._labels:
            middle = (label.place[0] + _LABEL_PADDING, (label.place[1] + label.place[3]) / 2)
            draw.text(middle, label.text, fill=label.ink, font=font(label.size), anchor="lm")
        return picture


def clip_segments(segments: FloatArray, bounds: tuple[float, float, float, float]) -> FloatArray:
    """The parts of (M, 4) segments that lie within ``bounds`` (x1, y1, x2, y2); rows with NaN or outside are left out.

    Liang and Barsky's parametric clipping.
    """
    segments = segments[np.isfinite(segments).all(axis=1)]
    start, delta = segments[:, :2], segments[:, 2:] - segments[:, :2]
    enter, leave = np.zeros(len(segments)), np.ones(len(segments))
    outside = np.zeros(len(segments), dtype=bool)
    for axis in (0, 1):
        for direction, distance in (
            (-delta[:, axis], start[:, axis] - bounds[axis]),
            (delta[:, axis], bounds[axis + 2] - start[:, axis]),
        ):
            # a direction next to zero may overflow: the parameter is then as good as infinite
            with np.errstate(over="ignore"):
                t = np.divide(distance, direction, out=np.zeros(len(segments)), where=direction != 0)
            enter = np.where(direction < 0, np.maximum(enter, t), enter)
            leave = np.where(direction > 0, np.minimum(leave, t), leave)
            outside |= (direction == 0) & (distance < 0)
    kept = ~outside & (enter <= leave)
    ends = (start + enter[:, None] * delta, start + leave[:, None] * delta)
    return np.concatenate(ends, axis=1)[kept]


def _dashes(segments: FloatArray, width: float) -> FloatArray:
    """(K, 4) dashes of (M, 4) segments, shorter by their round ends."""
    parts = [np.zeros((0, 4))]
    for segment in segments:
        delta = segment[2:] - segment[:2]
        length = float(np.hypot(*delta))
        starts = np.arange(0, max(length, 1e-6), DASH + GAP)
        t = np.stack([starts, np.clip(starts + DASH - width, starts, length)], axis=1) / max(length, 1e-6)
        parts.append((segment[:2] + t[..., None] * delta).reshape(-1, 4))
    return np.concatenate(parts)


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]

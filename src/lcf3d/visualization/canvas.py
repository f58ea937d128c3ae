"""Anti-aliased lines, and labels that keep out of each other's way."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from numpy.typing import NDArray

from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray
from lcf3d.visualization.strokes import Strokes

Colour = tuple[int, int, int]

DASH, GAP = 6.0, 4.0
_HALO = (0, 0, 0)
_LABEL_PADDING = 2


class _Label(NamedTuple):
    """A text in its place ``x1, y1, x2, y2``, on a plate of a colour and so many 255ths of opacity."""

    place: tuple[int, int, int, int]
    text: str
    ink: Colour
    plate: Colour
    opacity: int
    size: float


@lru_cache(maxsize=8)
def font(size: float) -> PIL.ImageFont.FreeTypeFont | PIL.ImageFont.ImageFont:
    """The font that comes with Pillow, ``size`` pixels high."""
    return PIL.ImageFont.load_default(size)


def text_size(text: str, size: float) -> tuple[int, int]:
    """Width and line height of a text in pixels."""
    words = text.split(" ")
    length = sum(_length(word, size) for word in words) + (len(words) - 1) * _length(" ", size)
    return int(np.ceil(length)), int(np.ceil(size * 1.25))


# words come again and again; shaping and drawing one takes longer than all else about a label
@lru_cache(maxsize=8192)
def _length(word: str, size: float) -> float:
    return float(font(size).getlength(word))


@lru_cache(maxsize=8192)
def _word(word: str, size: float, height: int) -> NDArray[np.uint8]:
    """How much of each pixel a word covers, with a pixel of room before it."""
    picture = PIL.Image.new("L", (int(np.ceil(_length(word, size))) + 3, height))
    PIL.ImageDraw.Draw(picture).text((1, height / 2), word, fill=255, font=font(size), anchor="lm")
    return np.array(picture)


@lru_cache(maxsize=1024)
def text_mask(text: str, size: float, width: int, height: int) -> NDArray[np.uint8]:
    """(height, width) how much of each pixel a text covers, 255 for all of it; centred between top and bottom."""
    mask = np.zeros((height, width), np.uint8)
    x = float(_LABEL_PADDING)
    for word in text.split(" "):
        drawn = _word(word, size, height)
        left = round(x) - 1
        part = mask[:, left : left + drawn.shape[1]]
        np.maximum(part, drawn[:, : part.shape[1]], out=part)
        x += _length(word, size) + _length(" ", size)
    return mask


def plain(height: int, width: int, colour: Sequence[int]) -> NDArray[np.uint8]:
    """(height, width, 3) pixels of one colour; row by row, as three values at a time take ten times as long."""
    rows = np.empty((height, 3 * width), np.uint8)
    rows[:] = np.tile(np.array(colour, np.uint8), width)
    return rows.reshape(height, width, 3)


class Canvas:
    """Draws over a picture; coordinates are pixels of that picture, fractions allowed.

    Lines go into the picture at once, text on top of all when it is finished.

    Args:
        background: RGB picture, left as it is; or its (H, W, 3) uint8 pixels, which are drawn into.
    """

    def __init__(self, background: PIL.Image.Image | NDArray[np.uint8]) -> None:
        if isinstance(background, PIL.Image.Image):
            background = np.array(background.convert("RGB"))
        self.height, self.width = background.shape[:2]
        self._strokes = Strokes(background)
        self._labels: list[_Label] = []
        # places of the labels, so many of them
        self._taken = np.empty((16, 4), np.int64)

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
        corners = [
            (x1, y1 - height),
            (x2 - width, y1 - height),
            (x1, y2),
            (x2 - width, y2),
            (x2, y1),
            (x1 - width, y1),
            (x1, y1),
        ]
        # beyond any picture, where no whole number could hold it
        far = 1e6
        tried = np.clip(np.rint(corners), -far, far).astype(np.int64)
        free = _first_free(tried, width, height, self.width, self.height, self._taken, len(self._labels))
        if free < 0:
            return False
        x, y = tried[free].tolist()
        ink, plate, opacity = (_HALO, colour, 235) if filled else (colour, _HALO, 150)
        self._put(_Label((x, y, x + width, y + height), text, ink, plate, opacity, size))
        return True

    def text(self, x: float, y: float, text: str, colour: Colour, size: float = 12.0, plate: bool = False) -> None:
        """Text with its top left corner at a place, on a dark ``plate`` or none; later labels keep away from it."""
        width, height = text_size(text, size)
        place = (round(x) - _LABEL_PADDING, round(y), round(x) + width + _LABEL_PADDING, round(y) + height)
        self._put(_Label(place, text, colour, _HALO, 150 if plate else 0, size))

    def _put(self, label: _Label) -> None:
        if len(self._labels) == len(self._taken):
            self._taken = np.concatenate([self._taken, self._taken])
        self._taken[len(self._labels)] = label.place
        self._labels.append(label)

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) the finished picture."""
        pixels = self._strokes.pixels
        for label in self._labels:
            x1, y1, x2, y2 = label.place
            _stamp(
                pixels,
                x1,
                y1,
                text_mask(label.text, label.size, x2 - x1, y2 - y1),
                label.plate,
                label.opacity,
                label.ink,
            )
        self._labels.clear()
        return pixels

    def image(self) -> PIL.Image.Image:
        """The finished RGB picture."""
        return PIL.Image.fromarray(self.pixels())


@kernel
def _first_free(corners, width, height, right, bottom, taken, count):  # type: ignore[no-untyped-def]
    """The first of some upper left corners where a label is in the picture and over no other; -1 if there is none."""
    for k in range(len(corners)):
        x1, y1 = corners[k]
        x2, y2 = x1 + width, y1 + height
        free = x1 >= 0 and y1 >= 0 and x2 <= right and y2 <= bottom
        for n in range(count):
            if not free:
                break
            free = not (x1 < taken[n, 2] and taken[n, 0] < x2 and y1 < taken[n, 3] and taken[n, 1] < y2)
        if free:
            return k
    return -1


@kernel
def _stamp(pixels, left, top, mask, plate, opacity, ink):  # type: ignore[no-untyped-def]
    """Put a plate and a text over the pixels from a corner on, as far as they are in the picture."""
    height, width = mask.shape
    share = opacity / 255
    for row in range(max(0, -top), min(height, pixels.shape[0] - top)):
        for column in range(max(0, -left), min(width, pixels.shape[1] - left)):
            cover = mask[row, column] / 255
            for c in range(3):
                under = pixels[top + row, left + column, c]
                under = np.floor(under * (1 - share) + plate[c] * share + 0.5)
                pixels[top + row, left + column, c] = np.uint8(under * (1 - cover) + ink[c] * cover + 0.5)


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

"""Anti-aliased lines and filled polygons, blended straight into a picture by compiled functions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray
from lcf3d.visualization.scratch import scratch


class Strokes:
    """Draws into one picture.

    Args:
        pixels: (H, W, 3) uint8 RGB, changed in place.
    """

    def __init__(self, pixels: NDArray[np.uint8]) -> None:
        self.pixels = pixels
        size = pixels.shape[0] * pixels.shape[1]
        # zero again after each stroke
        self._coverage = scratch("coverage", size, np.float32, zeros=True).reshape(pixels.shape[:2])
        self._touched = scratch("touched", size, np.int64)

    def lines(self, segments: FloatArray, colour: tuple[int, int, int], width: float, opacity: float) -> None:
        """Lines with round ends; where they cross each other they cover once.

        Args:
            segments: (M, 4) ``x1, y1, x2, y2`` in pixels (the centre of the first is 0.5); rows with NaN are skipped.
            colour: RGB.
            width: in pixels.
            opacity: 0 to 1.
        """
        count = _cover(np.ascontiguousarray(segments, dtype=np.float64), width / 2, self._coverage, self._touched)
        _blend(self.pixels, self._coverage, self._touched, count, np.array(colour, dtype=np.float64), opacity)

    def polygon(self, corners: FloatArray, colour: tuple[int, int, int], opacity: float) -> None:
        """A filled polygon with (K, 2) finite corners in pixels."""
        inside = np.ascontiguousarray(corners, dtype=np.float64)
        _fill(self.pixels, inside, np.array(colour, dtype=np.float64), opacity)


@kernel
def _cover(segments, half, coverage, touched):  # type: ignore[no-untyped-def]
    """Raise ``coverage`` to the share of each pixel that a line covers; pixels that had none go into ``touched``.

    Walks along the longer side of each segment and looks at the few pixels across.
    """
    count = 0
    height, width = coverage.shape
    reach = half + 0.5
    for n in range(len(segments)):
        x1, y1, x2, y2 = segments[n]
        # beyond that squares overflow
        if not abs(x1) + abs(y1) + abs(x2) + abs(y2) < 1e100:
            continue
        steep = abs(y2 - y1) > abs(x2 - x1)
        if steep:
            x1, y1, x2, y2 = y1, x1, y2, x2
        if x2 < x1:
            x1, y1, x2, y2 = x2, y2, x1, y1
        dx, dy = x2 - x1, y2 - y1
        squared = dx * dx + dy * dy
        slope = dy / dx if dx > 0 else 0.0
        across = reach * np.sqrt(1 + slope * slope)
        along, limit = (height, width) if steep else (width, height)
        for a in range(max(0, int(np.floor(x1 - reach))), min(along, int(np.ceil(x2 + reach)) + 1)):
            x = a + 0.5
            middle = y1 + slope * (min(max(x, x1), x2) - x1)
            for b in range(max(0, int(np.floor(middle - across))), min(limit, int(np.ceil(middle + across)) + 1)):
                y = b + 0.5
                t = ((x - x1) * dx + (y - y1) * dy) / squared if squared > 0 else 0.0
                t = min(max(t, 0.0), 1.0)
                off_x, off_y = x - x1 - t * dx, y - y1 - t * dy
                distance = np.sqrt(off_x * off_x + off_y * off_y)
                share = min(min(1.0, 2 * half), reach - distance)
                if share <= 0:
                    continue
                row, column = (a, b) if steep else (b, a)
                if coverage[row, column] == 0:
                    touched[count] = row * width + column
                    count += 1
                if share > coverage[row, column]:
                    coverage[row, column] = share
    return count


@kernel
def _blend(pixels, coverage, touched, count, colour, opacity):  # type: ignore[no-untyped-def]
    """Put ``colour`` over the touched pixels as far as they are covered, and clear their coverage."""
    width = coverage.shape[1]
    for k in range(count):
        row, column = touched[k] // width, touched[k] % width
        share = coverage[row, column] * opacity
        coverage[row, column] = 0
        for c in range(3):
            pixels[row, column, c] = np.uint8(pixels[row, column, c] * (1 - share) + colour[c] * share + 0.5)


@kernel
def _fill(pixels, corners, colour, opacity):  # type: ignore[no-untyped-def]
    """Put ``colour`` over the pixels whose centres lie within a polygon (even-odd rule)."""
    height, width = pixels.shape[:2]
    first = max(0, int(np.floor(corners[:, 1].min())))
    last = min(height, int(np.ceil(corners[:, 1].max())))
    crossings = np.empty(len(corners))
    for row in range(first, last):
        y, found = row + 0.5, 0
        for k in range(len(corners)):
            xa, ya = corners[k]
            xb, yb = corners[(k + 1) % len(corners)]
            if (ya <= y) != (yb <= y):
                crossings[found] = xa + (y - ya) / (yb - ya) * (xb - xa)
                found += 1
        crossings[:found].sort()
        for pair in range(0, found - 1, 2):
            start = max(0, int(np.ceil(crossings[pair] - 0.5)))
            stop = min(width, int(np.ceil(crossings[pair + 1] - 0.5)))
            for column in range(start, stop):
                for c in range(3):
                    value = pixels[row, column, c] * (1 - opacity) + colour[c] * opacity
                    pixels[row, column, c] = np.uint8(value + 0.5)

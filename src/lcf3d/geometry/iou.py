"""Overlaps of boxes: 2D in the image, rotated in bird's-eye view, and 3D.

The rotated intersection needs no polygon clipping. In the frame of box A, the intersection with A of the polygon B is
the integral around B of ``clip(y, -w/2, w/2) dx`` with x clipped to ``[-l/2, l/2]`` (Green's theorem after clamping the
plane onto A): four edges, no arrays, continuous in all its inputs, exact for identical, nested and touching boxes.
"""

from __future__ import annotations

import math

import numpy as np

from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray


def image_iou(boxes_a: FloatArray, boxes_b: FloatArray) -> FloatArray:
    """(N, M) IoU of (N, 4) and (M, 4) axis-aligned pixel boxes ``(x1, y1, x2, y2)``; 0 for empty boxes."""
    intersection = _image_intersection(boxes_a, boxes_b)
    union = image_area(boxes_a)[:, None] + image_area(boxes_b)[None] - intersection
    iou: FloatArray = np.divide(intersection, union, out=np.zeros_like(intersection), where=union > 0)
    return iou


def image_cover(boxes_a: FloatArray, boxes_b: FloatArray) -> FloatArray:
    """(N, M) share of each of (N, 4) pixel boxes that lies in each of (M, 4) others; 0 for empty boxes."""
    area = image_area(boxes_a)[:, None]
    intersection = _image_intersection(boxes_a, boxes_b)
    cover: FloatArray = np.divide(intersection, area, out=np.zeros_like(intersection), where=area > 0)
    return cover


def _image_intersection(boxes_a: FloatArray, boxes_b: FloatArray) -> FloatArray:
    """(N, M) common area of (N, 4) and (M, 4) pixel boxes."""
    top_left = np.maximum(boxes_a[:, None, :2], boxes_b[None, :, :2])
    bottom_right = np.minimum(boxes_a[:, None, 2:], boxes_b[None, :, 2:])
    sides = np.maximum(bottom_right - top_left, 0)
    intersection: FloatArray = sides[..., 0] * sides[..., 1]
    return intersection


def image_area(boxes: FloatArray) -> FloatArray:
    """(N,) areas of (N, 4) pixel boxes; reversed boxes have none."""
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 0)
    area: FloatArray = sides[:, 0] * sides[:, 1]
    return area


@kernel(inline="always")
def _clipped_edge_integral(xa, ya, xb, yb, half_length, half_width):  # type: ignore[no-untyped-def]
    """Integral of clip(y, +-half_width) dx along the edge a -> b, x clipped to +-half_length."""
    dx = xb - xa
    if dx == 0.0:
        return 0.0
    x0 = min(max(xa, -half_length), half_length)
    x1 = min(max(xb, -half_length), half_length)
    if x0 == x1:
        return 0.0
    slope = (yb - ya) / dx
    y0 = ya if x0 == xa else ya + slope * (x0 - xa)
    y1 = yb if x1 == xb else yb + slope * (x1 - xb)
    low, high = min(y0, y1), max(y0, y1)
    clipped_low = min(max(low, -half_width), half_width)
    clipped_high = min(max(high, -half_width), half_width)
    span = high - low
    if span > 0.0:
        below = max(min(high, -half_width) - low, 0.0)
        above = max(high - max(low, half_width), 0.0)
        middle = clipped_high - clipped_low
        mean = (0.5 * (clipped_low + clipped_high) * middle + half_width * (above - below)) / span
    else:
        mean = clipped_low
    return (x1 - x0) * mean


@kernel
def turned_intersection(ax, ay, a_length, a_width, cos_a, sin_a, bx, by, b_length, b_width, cos_b, sin_b):  # type: ignore[no-untyped-def]
    """Area that two rotated rectangles share, from cosine and sine of their yaws (scalars; numba)."""
    dx, dy = bx - ax, by - ay
    reach = 0.5 * (math.hypot(a_length, a_width) + math.hypot(b_length, b_width))
    if dx * dx + dy * dy >= reach * reach:
        return 0.0
    cx, cy = dx * cos_a + dy * sin_a, dy * cos_a - dx * sin_a
    cos_d, sin_d = cos_a * cos_b + sin_a * sin_b, cos_a * sin_b - sin_a * cos_b
    lx, ly = 0.5 * b_length * cos_d, 0.5 * b_length * sin_d
    wx, wy = -0.5 * b_width * sin_d, 0.5 * b_width * cos_d
    x0, y0 = cx + lx + wx, cy + ly + wy
    x1, y1 = cx - lx + wx, cy - ly + wy
    x2, y2 = cx - lx - wx, cy - ly - wy
    x3, y3 = cx + lx - wx, cy + ly - wy
    half_length, half_width = 0.5 * a_length, 0.5 * a_width
    area = -(
        _clipped_edge_integral(x0, y0, x1, y1, half_length, half_width)
        + _clipped_edge_integral(x1, y1, x2, y2, half_length, half_width)
        + _clipped_edge_integral(x2, y2, x3, y3, half_length, half_width)
        + _clipped_edge_integral(x3, y3, x0, y0, half_length, half_width)
    )
    return min(area, a_length * a_width, b_length * b_width) if area > 0.0 else 0.0


@kernel
def bev_intersection(ax, ay, a_length, a_width, a_yaw, bx, by, b_length, b_width, b_yaw):  # type: ignore[no-untyped-def]
    """Area that two rotated rectangles share (scalars; numba)."""
    reach = 0.5 * (math.hypot(a_length, a_width) + math.hypot(b_length, b_width))
    # most pairs of a frame are far apart: no cosines for them
    if (bx - ax) * (bx - ax) + (by - ay) * (by - ay) >= reach * reach:
        return 0.0
    return turned_intersection(
        ax,
        ay,
        a_length,
        a_width,
        math.cos(a_yaw),
        math.sin(a_yaw),
        bx,
        by,
        b_length,
        b_width,
        math.cos(b_yaw),
        math.sin(b_yaw),
    )


@kernel
def pair_bev_iou(a, b):  # type: ignore[no-untyped-def]
    """Bird's-eye-view IoU of two canonical boxes (7,) (numba)."""
    shared = bev_intersection(a[0], a[1], a[3], a[4], a[6], b[0], b[1], b[3], b[4], b[6])
    union = a[3] * a[4] + b[3] * b[4] - shared
    return shared / union if union > 0.0 else 0.0


@kernel
def pair_iou_3d(a, b):  # type: ignore[no-untyped-def]
    """3D IoU of two canonical boxes (7,) (numba)."""
    height = min(a[2] + 0.5 * a[5], b[2] + 0.5 * b[5]) - max(a[2] - 0.5 * a[5], b[2] - 0.5 * b[5])
    if height <= 0.0:
        return 0.0
    height = min(height, min(a[5], b[5]))
    shared = height * bev_intersection(a[0], a[1], a[3], a[4], a[6], b[0], b[1], b[3], b[4], b[6])
    union = a[3] * a[4] * a[5] + b[3] * b[4] * b[5] - shared
    return shared / union if union > 0.0 else 0.0


@kernel
def _iou_matrix(boxes_a, boxes_b, three_d):  # type: ignore[no-untyped-def]
    result = np.empty((len(boxes_a), len(boxes_b)))
    for i in range(len(boxes_a)):
        for j in range(len(boxes_b)):
            result[i, j] = pair_iou_3d(boxes_a[i], boxes_b[j]) if three_d else pair_bev_iou(boxes_a[i], boxes_b[j])
    return result


def bev_iou(boxes_a: FloatArray, boxes_b: FloatArray) -> FloatArray:
    """(N, M) rotated bird's-eye-view IoU of (N, 7) and (M, 7) canonical boxes."""
    result: FloatArray = _iou_matrix(_contiguous(boxes_a), _contiguous(boxes_b), False)
    return result


def iou_3d(boxes_a: FloatArray, boxes_b: FloatArray) -> FloatArray:
    """(N, M) 3D IoU of (N, 7) and (M, 7) canonical boxes: shared volume over joint volume."""
    result: FloatArray = _iou_matrix(_contiguous(boxes_a), _contiguous(boxes_b), True)
    return result


def _contiguous(boxes: FloatArray) -> FloatArray:
    """(N, 7) float64 in C order and writable as far as numba's types go, so that one compiled version serves all."""
    array = np.ascontiguousarray(boxes, dtype=np.float64)
    return array if array.flags.writeable else array.copy()

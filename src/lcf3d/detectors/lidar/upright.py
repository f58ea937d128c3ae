"""Whether what stands in a box ends where the box ends: poles, trunks and bushes are told from persons so.

A network that looks down on pillars judges heights by statistics of cells; the returns themselves are sharper. The
topmost beam that still hits an object misses its top by less than the distance between two beams. A box that rises
further above its highest return claims something that beams have passed through, and one with returns right above it
is a piece of something taller.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.kernels import kernel
from lcf3d.structures import Detections3D, FloatArray, IntArray

DEVIATION_M = 0.05
"""Error of a box's top: of simulated persons and riders, 19 in 20 rise no further above the last beam that hit them."""
MOST = 2.0
"""Largest drop of the score's logit for a missing top, and for returns above the box."""
MARGIN_M = 0.1
FOOT_M = 0.2
"""Returns lower than this in a box may be the ground."""
HEAD_M = 0.15
OVER_M = 2.5
"""Returns from ``HEAD_M`` to this far above the top belong to something taller."""
FEWEST = 2
BEAM_STEP = math.radians(0.1)
LOWEST_BEAM = math.radians(-60.0)
BEAM_STEPS = 1200
_CELL = 1.0
_SIDE = 200
_REACH = 100.0


def checked(
    found: Detections3D, points: NDArray[np.floating], config: LidarConfig, score_threshold: float
) -> Detections3D:
    """Detections whose scores know what stands in their boxes; those that fall to the threshold are left out.

    Args:
        found: in the frame of the points.
        points: (N, 3 or more) x, y, z in the LiDAR frame, metres, not levelled.
        config: `LidarConfig.upright` names the classes that are looked at.
        score_threshold: scores stay above it.
    """
    rows: IntArray = np.flatnonzero(np.isin(np.array(found.class_names)[found.labels], config.upright))
    if not len(rows):
        return found
    scores = found.scores.copy()
    logits = np.log(np.clip(scores[rows], 1e-6, None) / np.clip(1 - scores[rows], 1e-6, None))
    scores[rows] = 1 / (1 + np.exp(doubts(points, found.boxes[rows]) - logits))
    return replace(found, scores=scores)[scores > score_threshold]


def doubts(points: NDArray[np.floating], boxes: FloatArray) -> FloatArray:
    """(B,) what the returns take from the logits of (B, 7) boxes' scores: 0 where nothing speaks against a box."""
    seen = heights_in(points, boxes)
    gap, spacing, body, above = seen.T
    missing = np.maximum(gap - spacing, 0.0)
    top = np.minimum(0.5 * (missing / DEVIATION_M) ** 2, MOST)
    # a fifth as many returns above the box as in it are enough
    taken: FloatArray = np.where(body >= FEWEST, top, 0.0) + MOST * np.minimum(5 * above / (body + 1), 1.0)
    return taken


def heights_in(points: NDArray[np.floating], boxes: FloatArray) -> FloatArray:
    """What the returns say of the heights in boxes.

    Args:
        points: (N, 3 or more) LiDAR frame; points that are not finite are passed over.
        boxes: (B, 7) LiDAR frame; boxes beyond 100 m are not looked at.

    Returns:
        (B, 4): metres from the highest return to the top; metres between two beams there (infinite where one beam
        only hit the object); number of returns in the box; and of those above it. The first is 0 without returns.
    """
    cloud = points if points.flags.c_contiguous else np.ascontiguousarray(points)
    seen: FloatArray = _heights(cloud, np.ascontiguousarray(boxes[:, :7], dtype=np.float64))
    return seen


@kernel
def _heights(points, boxes):  # type: ignore[no-untyped-def]
    first, following = _in_cells(points, boxes)
    seen = np.zeros((len(boxes), 4))
    hit = np.zeros(BEAM_STEPS, np.bool_)
    for b in range(len(boxes)):
        x, y, half_length, half_width = boxes[b, 0], boxes[b, 1], 0.5 * boxes[b, 3], 0.5 * boxes[b, 4]
        bottom, top = boxes[b, 2] - 0.5 * boxes[b, 5], boxes[b, 2] + 0.5 * boxes[b, 5]
        cos, sin = math.cos(boxes[b, 6]), math.sin(boxes[b, 6])
        i0, i1, j0, j1 = _cells_of(boxes[b])
        hit[:] = False
        highest, body, above = -1e9, 0, 0
        for i in range(i0, i1):
            for j in range(j0, j1):
                n = first[i, j]
                while n >= 0:
                    dx, dy, z = points[n, 0] - x, points[n, 1] - y, points[n, 2]
                    inside = abs(dx * cos + dy * sin) < half_length + MARGIN_M
                    if inside and abs(dy * cos - dx * sin) < half_width + MARGIN_M and z > bottom + FOOT_M:
                        if z < top + HEAD_M:
                            body += 1
                            highest = max(highest, z)
                            angle = math.atan2(z, math.hypot(points[n, 0], points[n, 1]))
                            hit[min(max(int((angle - LOWEST_BEAM) / BEAM_STEP), 0), BEAM_STEPS - 1)] = True
                        elif z < top + OVER_M:
                            above += 1
                    n = following[n]
        seen[b, 2], seen[b, 3] = body, above
        if body > 0:
            seen[b, 0], seen[b, 1] = top - highest, _spacing(hit) * math.hypot(x, y)
    return seen


@kernel
def _cells_of(box):  # type: ignore[no-untyped-def]
    """Cells that a box with its margin may reach: first and past the last, along x and y."""
    reach = 0.5 * math.hypot(box[3], box[4]) + 2 * MARGIN_M
    if not (abs(box[0]) < _REACH and abs(box[1]) < _REACH and reach < _REACH):
        return 0, 0, 0, 0
    i0, i1 = int((box[0] - reach + _REACH) / _CELL), int((box[0] + reach + _REACH) / _CELL) + 1
    j0, j1 = int((box[1] - reach + _REACH) / _CELL), int((box[1] + reach + _REACH) / _CELL) + 1
    return max(i0, 0), min(i1, _SIDE), max(j0, 0), min(j1, _SIDE)


@kernel
def _in_cells(points, boxes):  # type: ignore[no-untyped-def]
    """The points of the cells that boxes reach, as chains: the first of each cell, and the one after each point."""
    wanted = np.zeros((_SIDE, _SIDE), np.bool_)
    for b in range(len(boxes)):
        i0, i1, j0, j1 = _cells_of(boxes[b])
        wanted[i0:i1, j0:j1] = True
    first = np.full((_SIDE, _SIDE), -1, np.int64)
    following = np.full(len(points), -1, np.int64)
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        # comparisons with NaN are false
        if abs(x) < _REACH and abs(y) < _REACH and math.isfinite(points[n, 2]):
            i, j = int((x + _REACH) / _CELL), int((y + _REACH) / _CELL)
            if wanted[i, j]:
                following[n] = first[i, j]
                first[i, j] = n
    return first, following


@kernel
def _spacing(hit):  # type: ignore[no-untyped-def]
    """Radians between neighbouring beams that hit, from the steps of elevation that were; infinite for one beam."""
    beams, low, high = 0, -1, -1
    for k in range(len(hit)):
        if hit[k]:
            if low < 0:
                low = k
            if k == 0 or not hit[k - 1]:
                beams += 1
            high = k
    return BEAM_STEP * (high - low) / (beams - 1) if beams > 1 else np.inf

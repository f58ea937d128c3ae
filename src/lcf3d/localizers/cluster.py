"""The dominant depth cluster of a frustum: which of its points belong to the object that the 2D box shows."""

from __future__ import annotations

import math

import numpy as np

from lcf3d.kernels import kernel
from lcf3d.localizers.ground import station_of

BIN = 0.25
BINS = 400
# returns lower than this over the ground belong to it
CLEARANCE = 0.2
# an object may rise this far above the mean height of its class
HEADROOM = 0.5
# relative error of the height of an object in the image (spread of the class and error of the 2D box) that is one sigma
HEIGHT_SPREAD = 0.14
# what the image's opinion on the range is worth at the least, should the 2D box show only a part of the object
PRIOR_FLOOR = 0.02
# enough points to see a shape in, few enough to be quick
MOST_POINTS = 64
# a gap within an object grows with the range, like the distance between neighbouring beams
GAP_PER_METRE = 0.01


@kernel
def weigh_points(points, gaussian, planes, top, reaches, weights):  # type: ignore[no-untyped-def]
    """Ranges of a frustum's points, and how much each speaks for the object (numba).

    Args:
        points: (N, 3 or more) in the frustum frame.
        gaussian: (N,) the Gaussian mask (times the instance mask).
        planes: the ground, from `ground_along`.
        top: greatest height of the object over the ground, NaN if unknown.
        reaches: (N,) filled with metres.
        weights: (N,) filled with the fourth power of the Gaussian mask (its sigma, the size of the 2D box, would
            hardly tell the middle from the rim), 0 for the ground, for what is higher than ``top``, and for NaN.
    """
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        reaches[i] = math.hypot(x, y)
        weights[i] = 0.0
        if reaches[i] < BIN * BINS:
            s = station_of(reaches[i])
            height = z - (planes[s, 0] + planes[s, 1] * x + planes[s, 2] * y)
            if height > CLEARANCE and not height > top + HEADROOM:
                square = gaussian[i] * gaussian[i]
                weights[i] = square * square


@kernel
def image_height_score(reach, ground, height, projection, image_size, box2d):  # type: ignore[no-untyped-def]
    """How well an upright object of known height, standing at a range on the frustum's axis, fills the 2D box (numba).

    Args:
        reach: range along the axis in metres.
        ground: height of the ground there.
        height: of the object in metres; NaN, for an object of unknown height, fits everywhere alike.
        projection: (3, 4) pixels from the frustum frame.
        image_size: (2,) width and height in pixels.
        box2d: (4,) pixels.

    Returns:
        From `PRIOR_FLOOR` to 1.
    """
    if math.isnan(height):
        return 1.0
    depth_foot = projection[2, 0] * reach + projection[2, 2] * ground + projection[2, 3]
    depth_head = depth_foot + projection[2, 2] * height
    if depth_foot < 0.5 or depth_head < 0.5:
        return PRIOR_FLOOR
    foot = (projection[1, 0] * reach + projection[1, 2] * ground + projection[1, 3]) / depth_foot
    head = (projection[1, 0] * reach + projection[1, 2] * (ground + height) + projection[1, 3]) / depth_head
    foot, head = min(foot, image_size[1]), max(head, 0.0)
    tall = max(box2d[3] - box2d[1], 1.0)
    if foot - head < 1.0:
        return PRIOR_FLOOR
    size_off = math.log((foot - head) / tall) / HEIGHT_SPREAD
    foot_off, head_off = (foot - box2d[3]) / (tall * HEIGHT_SPREAD), (head - box2d[1]) / (tall * HEIGHT_SPREAD)
    square = size_off * size_off + 0.5 * (foot_off * foot_off + head_off * head_off)
    return PRIOR_FLOOR + (1.0 - PRIOR_FLOOR) * math.exp(-0.5 * square)


@kernel
def range_profile(reaches, weights, window, planes, height, projection, image_size, box2d, profile):  # type: ignore[no-untyped-def]
    """Score of every range bin as the place where the object's near surface is (numba).

    The score is the weight of the points within ``window`` from the bin on, times `image_height_score`.

    Args:
        reaches: (N,) ranges in metres.
        weights: (N,) from `weigh_points`.
        window: depth of the object's near surface in metres.
        planes: the ground, from `ground_along`.
        height: mean height of the class in metres.
        projection: (3, 4) pixels from the frustum frame.
        image_size: (2,) pixels.
        box2d: (4,) pixels.
        profile: (BINS,) filled; 0 where no point lies.
    """
    histogram = np.empty(BINS)
    for b in range(BINS):
        histogram[b] = 0.0
    for n in range(len(reaches)):
        if weights[n] > 0.0:
            histogram[int(reaches[n] / BIN)] += weights[n]
    span = max(1, int(window / BIN + 0.5))
    for b in range(BINS):
        profile[b] = 0.0
        if histogram[b] == 0.0:
            continue
        inside = 0.0
        for s in range(min(span, BINS - b)):
            inside += histogram[b + s]
        reach = (b + 0.5) * BIN
        s = station_of(reach)
        prior = image_height_score(reach, planes[s, 0] + planes[s, 1] * reach, height, projection, image_size, box2d)
        profile[b] = inside * prior


@kernel
def take_cluster(points, reaches, weights, low, high, gap, taken):  # type: ignore[no-untyped-def]
    """The heaviest connected group among the weighted points between two ranges (numba).

    Points are thinned evenly to `MOST_POINTS` first. Two points belong together when they are nearer than ``gap``,
    seen from above.

    Args:
        points: (N, 3 or more) in the frustum frame.
        reaches: (N,) metres.
        weights: (N,) from `weigh_points`.
        low: least range.
        high: greatest range.
        gap: metres.
        taken: (MOST_POINTS, 3) its first rows are filled with x, y and weight.

    Returns:
        How many rows were filled, and how many points they stand for before thinning.
    """
    count = 0
    for i in range(len(points)):
        if weights[i] > 0.0 and low <= reaches[i] <= high:
            count += 1
    stride = max((count + MOST_POINTS - 1) // MOST_POINTS, 1)
    used = seen = 0
    for i in range(len(points)):
        if weights[i] > 0.0 and low <= reaches[i] <= high:
            if seen % stride == 0:
                taken[used, 0], taken[used, 1], taken[used, 2] = points[i, 0], points[i, 1], weights[i]
                used += 1
            seen += 1
    kept = _heaviest_component(taken[:used], gap)
    return kept, kept * stride


@kernel
def _heaviest_component(taken, gap):  # type: ignore[no-untyped-def]
    """Move the rows of the heaviest component to the front; returns its size."""
    used = len(taken)
    component, stack = np.empty(used, np.int64), np.empty(used, np.int64)
    for i in range(used):
        component[i] = -1
    heaviest, most, components = -1, 0.0, 0
    for first in range(used):
        if component[first] >= 0:
            continue
        stack[0], component[first] = first, components
        depth, mass = 1, 0.0
        while depth:
            depth -= 1
            i = stack[depth]
            mass += taken[i, 2]
            for j in range(used):
                if component[j] < 0:
                    dx, dy = taken[i, 0] - taken[j, 0], taken[i, 1] - taken[j, 1]
                    if dx * dx + dy * dy < gap * gap:
                        component[j] = components
                        stack[depth] = j
                        depth += 1
        if mass > most:
            heaviest, most = components, mass
        components += 1
    kept = 0
    for i in range(used):
        if component[i] == heaviest:
            taken[kept, 0], taken[kept, 1], taken[kept, 2] = taken[i, 0], taken[i, 1], taken[i, 2]
            kept += 1
    return kept

"""Which 2D boxes of two views show one object: epipolar assignment (paper section 4.2.3, equations 9-10)."""

from __future__ import annotations

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.fusion.matching import Assignment, assign
from lcf3d.geometry.camera import pixel_rays
from lcf3d.geometry.epipolar import (
    baseline,
    curve_distances,
    epipolar_lines,
    epipole,
    fundamental_matrix,
    infinite_homography,
    inverse_depths,
    line_distances,
)
from lcf3d.structures import BoolArray, Camera, Detections2D, FloatArray, IntArray

# heights that the visible part of a road user may have, in metres: a child behind a car, a lorry
BELIEVABLE_HEIGHTS = (0.5, 4.5)
# an edge of a 2D box this near to the image's border is where the image ends, not the object, in pixels
BORDER = 2.0
# pairs that must speak for exchanged views, and none against, before they are called so
EXCHANGED_PAIRS = 3
# a lens's box farther than this from the axis has no place in a plane image: depth is not checked there
STRAIGHT_FIELD = np.deg2rad(75.0)
# detections of lower score have no say in that: among many false ones some pair by chance
CONFIDENT = 0.5


def check_stereo_pair(left: Camera, right: Camera) -> None:
    """Refuse two cameras that cannot be a stereo pair.

    Raises:
        ConfigError: images of different size, cameras at the same place, or the first camera of a pair side by side
            stands to the right of the second.
    """
    names = f"stereo pair {left.name}/{right.name}"
    if (left.width, left.height) != (right.width, right.height):
        raise ConfigError(
            f"{names}: both images must have one size, got {left.width} x {left.height} and "
            f"{right.width} x {right.height}; use the images as they were calibrated"
        )
    offset = baseline(left, right)
    if offset[0] < 0 and abs(offset[0]) >= np.abs(offset[1:]).max():
        raise ConfigError(
            f"{names}: the first camera must be the left one, but by its calibration {right.name!r} stands "
            f"{-offset[0]:.2f} m to the left of {left.name!r}; exchange the two"
        )


def epipolar_costs(left_boxes: FloatArray, right_boxes: FloatArray, fundamental: FloatArray) -> FloatArray:
    """(N, M) sum of the pixel distances of two right corners to the epipolar lines of the left ones (equation 10).

    The corners are top left and bottom right. Infinite where a left corner is the epipole, which has no line.

    Args:
        left_boxes: (N, 4) pixels.
        right_boxes: (M, 4) pixels.
        fundamental: (3, 3) of `fundamental_matrix`.
    """
    costs = np.zeros((len(left_boxes), len(right_boxes)))
    for corner in (slice(0, 2), slice(2, 4)):
        costs += line_distances(epipolar_lines(fundamental, left_boxes[:, corner]), right_boxes[:, corner])
    return np.where(np.isnan(costs), np.inf, costs)


def curve_costs(left: Camera, right: Camera, left_boxes: FloatArray, right_boxes: FloatArray) -> FloatArray:
    """`epipolar_costs` for cameras with lenses: distances to the epipolar curves of the left corners."""
    costs = np.zeros((len(left_boxes), len(right_boxes)))
    for corner in (slice(0, 2), slice(2, 4)):
        costs += curve_distances(left, right, left_boxes[:, corner], right_boxes[:, corner])
    return np.where(np.isnan(costs), np.inf, costs)


def straight_boxes(boxes: FloatArray, camera: Camera) -> FloatArray:
    """(N, 4) boxes as a pinhole camera of the same projection would have them, sides by the middles of their sides.

    Those of a pinhole camera are returned as they are. NaN where a side is seen `STRAIGHT_FIELD` or more from the axis.
    """
    if camera.distortion is None or not len(boxes):
        return boxes
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    result = np.empty_like(boxes)
    for side in range(4):
        pixels = middle.copy()
        pixels[:, side % 2] = boxes[:, side]
        rays = pixel_rays(pixels, camera)
        homogeneous = rays @ camera.pixels_from_lidar[:, :3].T
        usable = homogeneous[:, 2] > np.cos(STRAIGHT_FIELD) * np.linalg.norm(rays, axis=1)
        result[:, side] = np.divide(
            homogeneous[:, side % 2], homogeneous[:, 2], out=np.full(len(boxes), np.nan), where=usable
        )
    return result


def believable_pairs(
    left: Camera, right: Camera, left_boxes: FloatArray, right_boxes: FloatArray, tolerance_px: float
) -> BoolArray:
    """(N, M) whether two boxes, seen as one object, put it before the cameras and give it a believable height.

    The epipolar distance alone does not tell apart objects at the same distance beside each other. The places of the
    boxes along the epipolar lines give a depth, and depth and height in the image a height in metres, which must be one
    of `BELIEVABLE_HEIGHTS`. Not in the paper; docs/stereo.md has what it brings.

    Args:
        left: camera of ``left_boxes``.
        right: camera of ``right_boxes``.
        left_boxes: (N, 4) pixels.
        right_boxes: (M, 4) pixels.
        tolerance_px: how far the boxes may be off along the epipolar line.

    Returns:
        True also where nothing can be said: both vertical edges lie on the image's border.
    """
    whole_left = [_off_border(left_boxes, column, left) for column in (0, 2)]
    whole_right = [_off_border(right_boxes, column, right) for column in (0, 2)]
    bent_widths = left_boxes[:, 2] - left_boxes[:, 0]
    left_boxes, right_boxes = straight_boxes(left_boxes, left), straight_boxes(right_boxes, right)
    total, count = np.zeros((2, len(left_boxes), len(right_boxes)))
    for column in (0, 2):
        left_points = np.stack([left_boxes[:, column], left_boxes[:, 1::2].mean(axis=1)], axis=1)
        right_points = np.stack([right_boxes[:, column], right_boxes[:, 1::2].mean(axis=1)], axis=1)
        inverse = inverse_depths(left, right, left_points, right_points)
        whole = whole_left[column // 2][:, None] & whole_right[column // 2]
        usable = whole & ~np.isnan(inverse)
        total[usable] += inverse[usable]
        count += usable
    inverse = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    # a height of h pixels at inverse depth q is h / (f q) metres
    heights = (left_boxes[:, 3] - left_boxes[:, 1])[:, None] / left.intrinsics[1, 1]
    slack: FloatArray = np.full((len(left_boxes), 1), tolerance_px * inverse_depth_per_pixel(left, right))
    if left.distortion is not None:  # a pixel of the lens's image is more of them off the axis
        slack *= np.maximum((left_boxes[:, 2] - left_boxes[:, 0]) / np.maximum(bent_widths, 1e-9), 1.0)[:, None]
    low, high = heights / BELIEVABLE_HEIGHTS[1] - slack, heights / BELIEVABLE_HEIGHTS[0] + slack
    return np.asarray(np.isnan(inverse) | ((inverse >= low) & (inverse <= high)))


def _off_border(boxes: FloatArray, column: int, camera: Camera) -> BoolArray:
    """(N,) whether a vertical edge of each box (column 0 or 2) lies within the image."""
    return np.asarray((boxes[:, column] > BORDER) & (boxes[:, column] < camera.width - BORDER))


def inverse_depth_per_pixel(left: Camera, right: Camera) -> float:
    """Change of inverse depth (1 / metre) by a pixel along the epipolar line of the image's middle."""
    centre = np.array([left.width / 2, left.height / 2, 1.0])
    far, near = infinite_homography(left, right) @ centre, epipole(left, right)
    speed = np.linalg.norm(near[:2] - far[:2] / far[2] * near[2])
    return float(abs(far[2]) / speed) if speed > 0 else np.inf


def pair_views(
    left: Camera,
    right: Camera,
    left_found: Detections2D,
    right_found: Detections2D,
    *,
    gate_px: float,
    check_depth: bool,
    decisive_score: float = 0.0,
    method: Assignment = "gated",
) -> IntArray:
    """Pairs of detections of two views that show one object: the assignment of least epipolar distance.

    Solved by the Jonker-Volgenant algorithm. ``paper`` assigns on the full matrix and then drops what cannot be a
    pair; ``gated`` takes that out first and minimises with the gate as the cost of staying alone, so that a hopeless
    pair cannot part a good one.

    Args:
        left: first camera.
        right: second camera.
        left_found: its detections to pair.
        right_found: those of the second camera, of the same class list.
        gate_px: pairs whose mean corner distance is larger are none.
        check_depth: pairs that are not `believable_pairs` are none.
        decisive_score: one score of a pair must be higher.
        method: see above.

    Returns:
        (P, 2) indices of left and right detections.
    """
    if not len(left_found) or not len(right_found):
        return np.zeros((0, 2), dtype=np.int64)
    if left.distortion is None and right.distortion is None:
        costs = epipolar_costs(left_found.boxes, right_found.boxes, fundamental_matrix(left, right))
    else:
        costs = curve_costs(left, right, left_found.boxes, right_found.boxes)
    distance = costs / 2
    # what a pair saves against two lonely boxes; the margin keeps a pair right at the gate from rounding
    saved = gate_px + 1e-6 - distance
    possible = (left_found.labels[:, None] == right_found.labels) & (saved > 0)
    possible &= np.maximum(left_found.scores[:, None], right_found.scores) > decisive_score
    if check_depth:
        possible &= believable_pairs(left, right, left_found.boxes, right_found.boxes, gate_px)
    if method == "gated":
        match = assign(np.where(possible, saved, 0.0), 0.0, "gated")
    else:
        match = assign(-np.minimum(distance, 1e6), -np.inf, "paper")
    paired = np.flatnonzero(match >= 0)
    paired = paired[possible[paired, match[paired]]]
    return np.stack([paired, match[paired]], axis=1)


def check_not_exchanged(
    left: Camera, right: Camera, left_found: Detections2D, right_found: Detections2D, gate_px: float
) -> None:
    """Refuse detections that fit the cameras only with the two views exchanged, or are one view's twice.

    Only `CONFIDENT` detections and a third of the gate are taken, so that only what fits well speaks; on frames in
    order it never did (benchmarks/stereo_pairing.py).

    Raises:
        ConfigError: both views have the same boxes; or there are no pairs, but `EXCHANGED_PAIRS` or more when the views
            are exchanged.
    """
    left_found, right_found = left_found[left_found.scores > CONFIDENT], right_found[right_found.scores > CONFIDENT]
    if min(len(left_found), len(right_found)) < EXCHANGED_PAIRS:
        return
    if np.array_equal(left_found.boxes, right_found.boxes):
        raise ConfigError(
            f"stereo pair {left.name}/{right.name}: both views have the same {len(left_found)} boxes; give each camera "
            "its own images or detections"
        )
    as_given = pair_views(left, right, left_found, right_found, gate_px=gate_px / 3, check_depth=True)
    if len(as_given):
        return
    exchanged = pair_views(left, right, right_found, left_found, gate_px=gate_px / 3, check_depth=True)
    if len(exchanged) >= EXCHANGED_PAIRS:
        raise ConfigError(
            f"stereo pair {left.name}/{right.name}: the detections of the two views have no object in common, but "
            f"{len(exchanged)} with the views exchanged; give each camera its own images or detections"
        )

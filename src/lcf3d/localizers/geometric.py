"""The geometric localizer: a box for each frustum from geometry alone, without weights or training data.

It is the fusion's default until a network is trained (paper section 4.1.4 has a Frustum PointNet in this place).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numba import njit

from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.localizers.cluster import BIN, BINS, GAP_PER_METRE, MOST_POINTS, range_profile, take_cluster, weigh_points
from lcf3d.localizers.fit import (
    EDGE_DEVIATION,
    FULL_COUNT,
    HEIGHT,
    LIFT,
    OPEN_STRENGTH,
    PIXEL_DEVIATION,
    SOLID_STRENGTH,
    YAW,
    Evidence,
    X,
    Y,
    image_cost,
    open_cost,
    search,
    solid_cost,
)
from lcf3d.localizers.ground import STATIONS, fit_plane, ground_along, lowest_returns, station_of
from lcf3d.localizers.shapes import SHAPES, ObjectShape
from lcf3d.structures import FloatArray

# fewest points of a cluster that a box is fitted to
FEWEST_POINTS = 3
# depth clusters tried in a frustum; the second must have this share of the first one's score
CLUSTERS = 2
SECOND_SHARE = 0.1
# what a cluster's lower score costs in the comparison of the fits
SCORE_COST = 2.0
# an object of unknown class is taken as solid from this width on, in metres
SOLID_WIDTH = 1.2
# a point off the instance mask counts this share of one on it, so that a bad mask does not lose the object
OFF_MASK = 0.1


class GeometricLocalizer:
    """Boxes by depth clustering and a fit to points, 2D box, ground and class sizes; a `Localizer`.

    Deterministic; a frame's ground is modelled once. Boxes stand upright. Headings are known only up to half a turn,
    and those of pedestrians hardly at all. Classes without an `ObjectShape` get the size that the 2D box has at the
    cluster's distance.

    Args:
        shapes: sizes by class name.
    """

    def __init__(self, shapes: Mapping[str, ObjectShape] = SHAPES) -> None:
        self.shapes = dict(shapes)

    def __call__(self, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 7) in the frustum frames, NaN where no cluster was found, and qualities (K,) in [0, 1].

        The quality is high when points and 2D box agree with the box.
        """
        count = len(proposals)
        boxes, quality = np.full((count, 7), np.nan), np.zeros(count)
        if not count:
            return boxes, quality
        projections, image_sizes = np.empty((count, 3, 4)), np.empty((count, 2))
        for k, c in enumerate(proposals.camera_index):
            camera = proposals.cameras[c]
            projections[k] = _turned(camera.pixels_from_lidar, float(proposals.axis_yaw[k]))
            image_sizes[k] = camera.width, camera.height
        rows = np.array([_row(self.shapes.get(name)) for name in proposals.class_names])[proposals.labels]
        gaussian = proposals.gaussian
        if proposals.mask is not None:
            gaussian = gaussian * (OFF_MASK + (1 - OFF_MASK) * proposals.mask)
        _localize_all(
            np.array(proposals.points[:, :3], dtype=np.float64),
            np.array(gaussian, dtype=np.float64),
            np.array(proposals.offsets),
            np.array(proposals.axis_yaw),
            np.array(proposals.boxes2d),
            projections,
            image_sizes,
            rows,
            lowest_returns(proposals.cloud),
            boxes,
            quality,
        )
        boxes[:, YAW] = wrap_angle(boxes[:, YAW])
        return boxes, quality


def _turned(projection: FloatArray, yaw: float) -> FloatArray:
    """(3, 4) pixels from the frustum frame of heading ``yaw``, given pixels from LiDAR."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    result = projection.copy()
    result[:, 0] = cos * projection[:, 0] + sin * projection[:, 1]
    result[:, 1] = cos * projection[:, 1] - sin * projection[:, 0]
    return result


def _row(shape: ObjectShape | None) -> list[float]:
    """An `ObjectShape` as numba reads it; NaN for an unknown class."""
    if shape is None:
        return [np.nan] * 8
    return [
        shape.length,
        shape.width,
        shape.height,
        shape.length_deviation,
        shape.width_deviation,
        shape.height_deviation,
        float(shape.solid),
        shape.edge_deviation,
    ]


@njit(cache=True, nogil=True)
def _localize_all(  # type: ignore[no-untyped-def]
    points, gaussian, offsets, axis_yaw, boxes2d, projections, image_sizes, rows, grid, boxes, quality
):
    """Fill ``boxes`` (K, 7) and ``quality`` (K,) for all proposals of a frame."""
    around = np.empty(3)
    fit_plane(grid, 0.0, 0.0, 20.0, np.nan, around)
    planes, profile = np.empty((STATIONS, 3)), np.empty(BINS)
    taken = np.empty((MOST_POINTS, 3))
    for k in range(len(offsets) - 1):
        part, weight = points[offsets[k] : offsets[k + 1]], gaussian[offsets[k] : offsets[k + 1]]
        row, projection, box2d, image_size = rows[k], projections[k], boxes2d[k], image_sizes[k]
        expected = around[0]
        if np.isnan(expected):
            # nothing was hit around the sensor: let the lowest point stand on the ground
            expected = np.nanmin(part[:, 2])
        ground_along(grid, axis_yaw[k], expected, planes)
        reaches, weights = np.empty(len(part)), np.empty(len(part))
        weigh_points(part, weight, planes, row[2], reaches, weights)
        diagonal = math.hypot(row[0], row[1])
        window = 0.5 if np.isnan(diagonal) else (0.25 if row[6] > 0.0 else 0.5) * diagonal
        range_profile(reaches, weights, window, planes, row[2], projection, image_size, box2d, profile)
        first, best = profile.max(), np.inf
        for _ in range(CLUSTERS):
            peak = np.argmax(profile)
            score = profile[peak]
            if score <= SECOND_SHARE * first:
                break
            near = peak * BIN
            plane = planes[station_of(near)]
            mean, deviation, solid, edge = _size(row, near, plane, projection, box2d)
            reach = math.hypot(mean[0], mean[1])
            gap = (0.25 * reach if solid else 0.3) + GAP_PER_METRE * near
            used, count = take_cluster(part, reaches, weights, near - 0.25 * reach, near + 1.4 * reach, gap, taken)
            if used >= FEWEST_POINTS:
                strength = (SOLID_STRENGTH if solid else OPEN_STRENGTH) * min(1.0, count / FULL_COUNT)
                sigma = np.empty(2)
                sigma[0] = math.hypot(PIXEL_DEVIATION, edge * (box2d[2] - box2d[0]))
                sigma[1] = math.hypot(PIXEL_DEVIATION, EDGE_DEVIATION * (box2d[3] - box2d[1]))
                evidence = Evidence(
                    taken[:used], strength, plane, projection, image_size, box2d, sigma, mean, deviation, solid
                )
                q, value = search(near, evidence)
                value += SCORE_COST * math.log(first / score)
                if value < best:
                    best = value
                    boxes[k] = q
                    boxes[k, 2] = plane[0] + plane[1] * q[X] + plane[2] * q[Y] + q[LIFT] + 0.5 * q[HEIGHT]
                    quality[k] = _quality(q, evidence, count)
            hidden = int(max(window, 1.0) / BIN)
            profile[max(peak - hidden, 0) : peak + hidden + 1] = 0.0


@njit(cache=True, nogil=True)
def _size(row, near, plane, projection, box2d):  # type: ignore[no-untyped-def]
    """Mean and deviation of length, width, height, whether solid, and edge deviation, of a class or of a 2D box."""
    mean, deviation = row[0:3].copy(), row[3:6].copy()
    if not np.isnan(mean[0]):
        return mean, deviation, row[6] > 0.0, row[7]
    ground = plane[0] + plane[1] * near
    depth = max(projection[2, 0] * near + projection[2, 2] * ground + projection[2, 3], 0.5)
    across = abs(projection[0, 1]) / depth
    down = abs(projection[1, 2]) / depth
    mean[:] = max((box2d[2] - box2d[0]) / across, 0.2)
    mean[2] = max((box2d[3] - box2d[1]) / down, 0.2)
    deviation[:] = 0.3 * mean
    return mean, deviation, mean[1] > SOLID_WIDTH, EDGE_DEVIATION


@njit(cache=True, nogil=True)
def _quality(q, evidence, count):  # type: ignore[no-untyped-def]
    surface = solid_cost(q, evidence.points) if evidence.solid else open_cost(q, evidence.points)
    return (1.0 - surface) * math.exp(-0.1 * image_cost(q, evidence)) * math.sqrt(min(1.0, count / FULL_COUNT))

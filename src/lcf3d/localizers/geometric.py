"""The geometric localizer: a box for each frustum from geometry alone, without weights or training data.

It is the fusion's default until a network is trained (paper section 4.1.4 has a Frustum PointNet in this place).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.geometry.ground import fit_plane, lowest_returns
from lcf3d.geometry.lens import local_projection
from lcf3d.kernels import kernel
from lcf3d.localizers.cluster import BIN, BINS, GAP_PER_METRE, MOST_POINTS, range_profile, take_cluster, weigh_points
from lcf3d.localizers.fit import (
    BOX2D,
    DEVIATION,
    EDGE_DEVIATION,
    EDGE_SIGMA,
    EVIDENCE,
    FULL_COUNT,
    GROUND,
    HEIGHT,
    IMAGE_SIZE,
    LIFT,
    MEAN,
    OPEN_STRENGTH,
    PIXEL_DEVIATION,
    PROJECTION,
    SOLID,
    SOLID_STRENGTH,
    STRENGTH,
    YAW,
    X,
    Y,
    image_cost,
    open_cost,
    search,
    solid_cost,
)
from lcf3d.localizers.ground import RADIUS, STATIONS, ground_along, station_of
from lcf3d.localizers.shapes import SHAPES, ObjectShape
from lcf3d.structures import FloatArray

# fewest points of a cluster that a box is fitted to
FEWEST_POINTS = 3
# fits below this quality are none: points and 2D box show no object of the class together
LEAST_QUALITY = 0.1
# depth clusters tried in a frustum; the second must have this share of the first one's score
CLUSTERS = 2
SECOND_SHARE = 0.1
# what a cluster's lower score costs in the comparison of the fits
SCORE_COST = 2.0
# an object of unknown class is taken as solid from this width on, in metres
SOLID_WIDTH = 1.2
# spread of its size
UNKNOWN_DEVIATION = 0.3
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
        """Boxes (K, 7) in the frustum frames, NaN where no object was found, and qualities (K,) in [0, 1].

        The quality is high when many points and the 2D box agree with the box. Since the fit makes the projection
        agree with the 2D box, the image IoU alone says little about a box of this localizer.
        """
        count = len(proposals)
        boxes, quality = np.full((count, 7), np.nan), np.zeros(count)
        if not count:
            return boxes, quality
        projections, image_sizes = np.empty((count, 3, 4)), np.empty((count, 2))
        for k, c in enumerate(proposals.camera_index):
            camera = proposals.cameras[c]
            pixels_from_lidar = camera.pixels_from_lidar
            if camera.distortion is not None:
                pixels_from_lidar = local_projection(camera, proposals.boxes2d[k])
            projections[k] = _turned(pixels_from_lidar, float(proposals.axis_yaw[k]))
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


@kernel
def _localize_all(  # type: ignore[no-untyped-def]
    points, gaussian, offsets, axis_yaw, boxes2d, projections, image_sizes, rows, grid, boxes, quality
):
    """Fill ``boxes`` (K, 7) and ``quality`` (K,) for all proposals of a frame."""
    around, planes, evidence = np.empty(3), np.empty((STATIONS, 3)), np.empty(EVIDENCE)
    around[0], around[1], around[2] = np.nan, 0.0, 0.0
    fit_plane(grid, 0.0, 0.0, 2.0 * RADIUS, around)
    for k in range(len(offsets) - 1):
        part, weight = points[offsets[k] : offsets[k + 1]], gaussian[offsets[k] : offsets[k + 1]]
        expected = around[0]
        if math.isnan(expected):
            # nothing was hit around the sensor: let the lowest point stand on the ground
            expected = np.inf
            for i in range(len(part)):
                if part[i, 2] < expected:
                    expected = part[i, 2]
        ground_along(grid, axis_yaw[k], expected, planes)
        for i in range(4):
            evidence[BOX2D + i] = boxes2d[k, i]
            for r in range(3):
                evidence[PROJECTION + 4 * r + i] = projections[k, r, i]
        evidence[IMAGE_SIZE], evidence[IMAGE_SIZE + 1] = image_sizes[k, 0], image_sizes[k, 1]
        quality[k] = _localize_one(part, weight, rows[k], planes, projections[k], evidence, boxes[k])


@kernel
def _localize_one(points, gaussian, row, planes, projection, evidence, box):  # type: ignore[no-untyped-def]
    """Fill ``box`` (7,) with the best fit to any of the proposal's depth clusters; returns its quality."""
    reaches, weights, profile = np.empty(len(points)), np.empty(len(points)), np.empty(BINS)
    taken = np.empty((MOST_POINTS, 3))
    weigh_points(points, gaussian, planes, row[2], reaches, weights)
    diagonal = math.hypot(row[0], row[1])
    window = 0.5 if math.isnan(diagonal) else (0.25 if row[6] > 0.0 else 0.5) * diagonal
    image_size, box2d = evidence[IMAGE_SIZE:BOX2D], evidence[BOX2D:EDGE_SIGMA]
    range_profile(reaches, weights, window, planes, row[2], projection, image_size, box2d, profile)
    first, best, quality = profile[_peak(profile)], np.inf, 0.0
    for _ in range(CLUSTERS):
        peak = _peak(profile)
        score = profile[peak]
        if score <= SECOND_SHARE * first:
            break
        near = peak * BIN
        plane = planes[station_of(near)]
        solid = _set_size(row, near, plane, projection, evidence)
        reach = math.hypot(evidence[MEAN], evidence[MEAN + 1])
        gap = (0.25 * reach if solid else 0.3) + GAP_PER_METRE * near
        used, count = take_cluster(points, reaches, weights, near - 0.25 * reach, near + 1.4 * reach, gap, taken)
        if used >= FEWEST_POINTS:
            evidence[STRENGTH] = (SOLID_STRENGTH if solid else OPEN_STRENGTH) * min(1.0, count / FULL_COUNT)
            for i in range(3):
                evidence[GROUND + i] = plane[i]
            q, value = search(taken[:used], evidence)
            value += SCORE_COST * math.log(first / score)
            if value < best:
                best = value
                for i in range(7):
                    box[i] = q[i]
                box[2] = plane[0] + plane[1] * q[X] + plane[2] * q[Y] + q[LIFT] + 0.5 * q[HEIGHT]
                quality = _quality(q, taken[:used], evidence, count)
        hidden = int(max(window, 1.0) / BIN)
        for b in range(max(peak - hidden, 0), min(peak + hidden + 1, BINS)):
            profile[b] = 0.0
    if quality < LEAST_QUALITY:
        for i in range(7):
            box[i] = np.nan
        return 0.0
    return quality


@kernel
def _peak(profile):  # type: ignore[no-untyped-def]
    """Place of the highest value, the first of equal ones."""
    peak = 0
    for b in range(1, len(profile)):
        if profile[b] > profile[peak]:
            peak = b
    return peak


@kernel
def _set_size(row, near, plane, projection, evidence):  # type: ignore[no-untyped-def]
    """Enter the sizes of the class, or of the 2D box at that range if unknown; returns whether the body is solid."""
    wide, tall = evidence[BOX2D + 2] - evidence[BOX2D], evidence[BOX2D + 3] - evidence[BOX2D + 1]
    edge, solid = row[7], row[6] > 0.0
    for i in range(3):
        evidence[MEAN + i], evidence[DEVIATION + i] = row[i], row[3 + i]
    if math.isnan(row[0]):
        foot = plane[0] + plane[1] * near
        depth = max(projection[2, 0] * near + projection[2, 2] * foot + projection[2, 3], 0.5)
        across = math.hypot(projection[0, 1], projection[1, 1]) / depth
        evidence[MEAN] = evidence[MEAN + 1] = max(wide / across, 0.2)
        evidence[MEAN + 2] = max(tall / across, 0.2)
        for i in range(3):
            evidence[DEVIATION + i] = UNKNOWN_DEVIATION * evidence[MEAN + i]
        edge, solid = EDGE_DEVIATION, evidence[MEAN] > SOLID_WIDTH
    evidence[EDGE_SIGMA] = math.hypot(PIXEL_DEVIATION, edge * wide)
    evidence[EDGE_SIGMA + 1] = math.hypot(PIXEL_DEVIATION, EDGE_DEVIATION * tall)
    evidence[SOLID] = 1.0 if solid else 0.0
    return solid


@kernel
def _quality(q, points, evidence, count):  # type: ignore[no-untyped-def]
    surface = solid_cost(q, points) if evidence[SOLID] > 0.0 else open_cost(q, points)
    return (1.0 - surface) * math.exp(-0.1 * image_cost(q, evidence)) * math.sqrt(min(1.0, count / FULL_COUNT))

"""Projection through a distorting lens, and back (`lcf3d.distortion` has the models).

A lens sees a cone of directions, not a half space: what is outside of the cone is in no image. Straight edges bend, so
that their images are sampled along the arcs of directions that they span.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from lcf3d.distortion import Distortion, Field
from lcf3d.errors import ConfigError
from lcf3d.geometry.boxes import EDGES, box_corners
from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, Camera, FloatArray

# nothing nearer to the camera than this is projected, in metres
NEAR = 0.1
# an edge is sampled at least this densely, in radians: a bend of 0.1 pixels at a focal length of 700
SAMPLE_ANGLE = math.radians(2.0)
# most pieces of an edge; directions tried along the border of the field
PIECES, BORDER = 64, 180

# a lens as one array of numbers (numba compiles that fastest), each at its place
RAYS = 0  # the 12 numbers, row by row, of camera coordinates from LiDAR
FISHEYE = 12  # 1, or 0 for Brown-Conrady
COSINE = 13  # of half the field
INTRINSICS = 14  # fx, skew, cx, fy, cy
COEFFICIENTS = 19
NUMBERS = 27


@lru_cache(maxsize=64)
def lens_numbers(camera: Camera) -> FloatArray:
    """(`NUMBERS`,) all that projecting through the lens of a camera with a distortion takes."""
    field, distortion, k = camera.lens_field, camera.distortion, camera.intrinsics
    if field is None or distortion is None:
        raise ConfigError(f"camera {camera.name!r} has no distortion: project as a pinhole camera does")
    numbers = np.empty(NUMBERS)
    numbers[RAYS:FISHEYE] = np.linalg.solve(k, camera.pixels_from_lidar).ravel()
    numbers[FISHEYE] = distortion.model == "fisheye"
    numbers[COSINE] = math.cos(field.half_angle)
    numbers[INTRINSICS:COEFFICIENTS] = k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]
    numbers[COEFFICIENTS:] = distortion.padded
    return numbers


@kernel
def _pixel(x, y, z, n):  # type: ignore[no-untyped-def]
    """Pixel of a camera-coordinate direction inside the field (numba)."""
    k = n[COEFFICIENTS:]
    if n[FISHEYE] > 0:
        rho = math.hypot(x, y)
        angle = math.atan2(rho, z)
        t = angle * angle
        radius = angle * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))
        scale = radius / rho if rho > 1e-12 else 0.0
        a, b = x * scale, y * scale
    else:
        x, y = x / z, y / z
        s = x * x + y * y
        g = (1 + s * (k[0] + s * (k[1] + s * k[4]))) / (1 + s * (k[5] + s * (k[6] + s * k[7])))
        a = x * g + 2 * k[2] * x * y + k[3] * (s + 2 * x * x)
        b = y * g + k[2] * (s + 2 * y * y) + 2 * k[3] * x * y
    i = n[INTRINSICS:COEFFICIENTS]
    return i[0] * a + i[1] * b + i[2], i[3] * b + i[4]


@kernel
def project_through_lens(points, n, pixels, depths):  # type: ignore[no-untyped-def]
    """Fill ``pixels`` (N, 2), NaN outside the field, and ``depths`` (N,) of (N, 3 or more) points (numba)."""
    for p in range(len(points)):
        x, y, z = np.float64(points[p, 0]), np.float64(points[p, 1]), np.float64(points[p, 2])
        a = n[0] * x + n[1] * y + n[2] * z + n[3]
        b = n[4] * x + n[5] * y + n[6] * z + n[7]
        c = n[8] * x + n[9] * y + n[10] * z + n[11]
        depths[p] = c
        norm = math.sqrt(a * a + b * b + c * c)
        if norm > NEAR and c >= n[COSINE] * norm:
            pixels[p, 0], pixels[p, 1] = _pixel(a, b, c, n)
        else:
            pixels[p, 0], pixels[p, 1] = np.nan, np.nan


@kernel
def _unit(v, out):  # type: ignore[no-untyped-def]
    norm = max(math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), 1e-12)
    out[0], out[1], out[2] = v[0] / norm, v[1] / norm, v[2] / norm


@kernel
def _edge_pixels(a, b, n, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (`PIECES` + 1, 2) with pixels along an edge, NaN outside of the field; returns how many, and cuts.

    The edge goes between two camera-coordinate positions. Samples lie evenly on the arc of its directions; one that
    lies outside next to one inside is moved to the border of the field.
    """
    u, v, w = np.empty(3), np.empty(3), np.empty(3)
    _unit(a, u)
    _unit(b, v)
    cosine = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    # v made perpendicular to u: directions are cos(t) u + sin(t) w
    for i in range(3):
        w[i] = v[i] - cosine * u[i]
    sine = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    angle = math.atan2(sine, cosine)
    for i in range(3):
        w[i] /= max(sine, 1e-12)
    pieces = min(max(math.ceil(angle / SAMPLE_ANGLE), 1), PIECES)
    # cos(t) u_z + sin(t) w_z is the cosine to the axis: largest at its peak, falling on both sides
    limit, cuts = n[COSINE], 0
    for s in range(pieces + 1):
        t = angle * s / pieces
        if math.cos(t) * u[2] + math.sin(t) * w[2] < limit:
            cuts += 1
            inner = np.nan
            for step in (-1, 1):
                other = angle * (s + step) / pieces
                if 0 <= s + step <= pieces and math.cos(other) * u[2] + math.sin(other) * w[2] >= limit:
                    inner = other
            if math.isnan(inner):
                out[s, 0], out[s, 1] = np.nan, np.nan
                continue
            outer = t
            for _ in range(20):
                middle = 0.5 * (inner + outer)
                if math.cos(middle) * u[2] + math.sin(middle) * w[2] >= limit:
                    inner = middle
                else:
                    outer = middle
            t = inner
        c, d = math.cos(t), math.sin(t)
        out[s, 0], out[s, 1] = _pixel(c * u[0] + d * w[0], c * u[1] + d * w[1], c * u[2] + d * w[2], n)
    return pieces + 1, cuts


@kernel
def _positions(corners, n, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` with the camera coordinates of (8, 3) corners."""
    for c in range(8):
        for r in range(3):
            out[c, r] = (
                n[4 * r] * corners[c, 0] + n[4 * r + 1] * corners[c, 1] + n[4 * r + 2] * corners[c, 2] + n[4 * r + 3]
            )


@kernel
def bound_through_lens(boxes, corners, edges, n, bounds):  # type: ignore[no-untyped-def]
    """Fill ``bounds`` (N, 4) with the extent of each box's image, inf where it has none (numba).

    Of a box that the border of the field cuts, the border inside of it counts too.
    """
    at, pixels = np.empty((8, 3)), np.empty((PIECES + 1, 2))
    for k in range(len(corners)):
        _positions(corners[k], n, at)
        x1 = y1 = np.inf
        x2 = y2 = -np.inf
        cuts = 0
        for e in range(len(edges)):
            count, outside = _edge_pixels(at[edges[e, 0]], at[edges[e, 1]], n, pixels)
            cuts += outside
            for s in range(count):
                u, v = pixels[s, 0], pixels[s, 1]
                if not math.isnan(u):
                    x1, x2, y1, y2 = min(x1, u), max(x2, u), min(y1, v), max(y2, v)
        if cuts > 0:
            sine = math.sqrt(max(1.0 - n[COSINE] * n[COSINE], 0.0))
            for s in range(BORDER):
                turn = 2 * math.pi * s / BORDER
                x, y, z = sine * math.cos(turn), sine * math.sin(turn), n[COSINE]
                if _meets(boxes[k], x, y, z, n):
                    u, v = _pixel(x, y, z, n)
                    x1, x2, y1, y2 = min(x1, u), max(x2, u), min(y1, v), max(y2, v)
        bounds[k, 0], bounds[k, 1], bounds[k, 2], bounds[k, 3] = x1, y1, x2, y2


@kernel
def _meets(box, x, y, z, n):  # type: ignore[no-untyped-def]
    """Whether the ray from the camera in a camera-coordinate direction meets a box."""
    # the camera and the direction in LiDAR coordinates: the left part of the rays' matrix is a rotation
    cos, sin = math.cos(box[6]), math.sin(box[6])
    origin, way = np.empty(3), np.empty(3)
    for i in range(3):
        origin[i] = -(n[i] * n[3] + n[4 + i] * n[7] + n[8 + i] * n[11]) - box[i]
        way[i] = n[i] * x + n[4 + i] * y + n[8 + i] * z
    origin[0], origin[1] = cos * origin[0] + sin * origin[1], cos * origin[1] - sin * origin[0]
    way[0], way[1] = cos * way[0] + sin * way[1], cos * way[1] - sin * way[0]
    enter, leave = NEAR, np.inf
    for i in range(3):
        half = 0.5 * box[3 + i]
        if abs(way[i]) < 1e-12:
            if abs(origin[i]) > half:
                return False
        else:
            first, second = (-half - origin[i]) / way[i], (half - origin[i]) / way[i]
            enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
    return enter < leave


@kernel
def _all_edges(corners, edges, n, out):  # type: ignore[no-untyped-def]
    at = np.empty((8, 3))
    for k in range(len(corners)):
        _positions(corners[k], n, at)
        for e in range(len(edges)):
            _edge_pixels(at[edges[e, 0]], at[edges[e, 1]], n, out[k, e])


def edges_through_lens(boxes: FloatArray, camera: Camera) -> FloatArray:
    """(N, 12, `PIECES` + 1, 2) pixels along the bent edges of (N, 7) boxes, NaN where there is nothing (any more)."""
    pixels = np.full((len(boxes), len(EDGES), PIECES + 1, 2), np.nan)
    _all_edges(box_corners(boxes), EDGES, lens_numbers(camera), pixels)
    return pixels


def polygon_through_lens(corners: FloatArray, camera: Camera) -> FloatArray:
    """(M, 2) pixels around a face with (4, 3) corners in the LiDAR frame; empty unless all of it is in the field."""
    numbers = lens_numbers(camera)
    at = corners @ numbers[:12].reshape(3, 4)[:, :3].T + numbers[3:12:4]
    parts, pixels = [], np.empty((PIECES + 1, 2))
    for a, b in zip(at, np.roll(at, -1, axis=0), strict=True):
        count, cuts = _edge_pixels(a, b, numbers, pixels)
        if cuts:
            return np.zeros((0, 2))
        parts.append(pixels[:count].copy())
    return np.concatenate(parts)


def directions_of_pixels(pixels: FloatArray, camera: Camera) -> tuple[FloatArray, BoolArray]:
    """(N, 3) unit directions in camera coordinates of (N, 2) pixels of a lens, and whether each lies in its field.

    A pixel outside of the field gives the direction on the field's border that lies on its side.
    """
    k, field, distortion = camera.intrinsics, camera.lens_field, camera.distortion
    if field is None or distortion is None:
        raise ConfigError(f"camera {camera.name!r} has no distortion: project as a pinhole camera does")
    y = (pixels[:, 1] - k[1, 2]) / k[1, 1]
    x = (pixels[:, 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    radii = np.hypot(x, y)
    angles = np.interp(radii, field.radii, field.angles)
    if distortion.model == "fisheye":
        angles, inside = _fisheye_angles(angles, radii, distortion, field.half_angle), radii <= field.radii[-1]
        side = np.stack([x, y], axis=1) / np.maximum(radii, 1e-12)[:, None]
        return np.column_stack([np.sin(angles)[:, None] * side, np.cos(angles)]), inside
    start = np.tan(angles) / np.maximum(radii, 1e-12)
    plane, inside = _undistort(np.stack([x, y], axis=1), np.stack([x * start, y * start], axis=1), distortion, field)
    directions = np.column_stack([plane, np.ones(len(plane))])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True), inside


def _fisheye_angles(angles: FloatArray, radii: FloatArray, distortion: Distortion, most: float) -> FloatArray:
    """Newton steps from a good guess to the angles of (N,) radii."""
    k = distortion.padded
    for _ in range(4):
        t = angles * angles
        slope = 1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * 9 * k[3])))
        off = distortion.radii(angles) - radii
        angles = np.clip(angles - off / np.maximum(slope, 1e-6), 0, most)
    return angles


def _undistort(
    target: FloatArray, start: FloatArray, distortion: Distortion, field: Field
) -> tuple[FloatArray, BoolArray]:
    """(N, 2) ideal positions that a Brown-Conrady lens bends to ``target`` (Newton's method), and where that worked."""
    k, most = distortion.padded, math.tan(field.half_angle)
    p, q = start[:, 0], start[:, 1]
    for _ in range(12):
        s = p * p + q * q
        above, below = 1 + s * (k[0] + s * (k[1] + s * k[4])), 1 + s * (k[5] + s * (k[6] + s * k[7]))
        g = above / below
        slope = (k[0] + s * (2 * k[1] + s * 3 * k[4]) - g * (k[5] + s * (2 * k[6] + s * 3 * k[7]))) / below
        off_x = p * g + 2 * k[2] * p * q + k[3] * (s + 2 * p * p) - target[:, 0]
        off_y = q * g + k[2] * (s + 2 * q * q) + 2 * k[3] * p * q - target[:, 1]
        xx = g + 2 * p * p * slope + 2 * k[2] * q + 6 * k[3] * p
        xy = 2 * p * q * slope + 2 * k[2] * p + 2 * k[3] * q
        yy = g + 2 * q * q * slope + 6 * k[2] * q + 2 * k[3] * p
        det = xx * yy - xy * xy
        det = np.where(np.abs(det) < 1e-9, 1e-9, det)
        p, q = p - (yy * off_x - xy * off_y) / det, q - (xx * off_y - xy * off_x) / det
        shrink = np.minimum(1.0, most / np.maximum(np.hypot(p, q), 1e-12))
        p, q = p * shrink, q * shrink
    residual = np.hypot(off_x, off_y)
    return np.stack([p, q], axis=1), np.asarray(residual < 1e-6)


def local_projection(camera: Camera, box: FloatArray) -> FloatArray:
    """(3, 4) the pinhole projection, pixels from LiDAR, that is nearest to the lens around a (4,) pixel box.

    Its axis is the ray through the middle of the box, its image plane is stretched and turned so that the middles of
    the box's sides are where the lens has them: what takes a pinhole camera's numbers can look at one object through
    it. Depths (third row) are along that ray.
    """
    middle, half = (box[:2] + box[2:]) / 2, np.maximum((box[2:] - box[:2]) / 2, 1.0)
    numbers = lens_numbers(camera)
    rays_from_lidar = numbers[:12].reshape(3, 4)
    for _ in range(8):
        # left, right, top, bottom; drawn in to the middle where a side lies outside of the field
        sides = middle + np.array([[-1, 0], [1, 0], [0, -1], [0, 1]]) * half
        directions, inside = directions_of_pixels(np.concatenate([[middle], sides]), camera)
        if inside.all():
            break
        half = half / 2
        if not inside[0]:
            centre = camera.intrinsics[:2, 2]
            middle = centre + 0.95 * (middle - centre)
    axis = directions[0]
    right = directions[2] - directions[1]
    right = right - (right @ axis) * axis
    right /= max(float(np.linalg.norm(right)), 1e-12)
    frame = np.stack([right, np.cross(axis, right), axis])
    local = directions @ frame.T
    plane = local[1:, :2] / local[1:, 2:]
    steps = np.stack([plane[1] - plane[0], plane[3] - plane[2]], axis=1)
    stretch = np.diag(2 * half) @ np.linalg.inv(steps)
    offset = middle - stretch @ plane.mean(axis=0)
    pixels_from_frame = np.eye(3)
    pixels_from_frame[:2, :2], pixels_from_frame[:2, 2] = stretch, offset
    projection: FloatArray = pixels_from_frame @ frame @ rays_from_lidar
    return projection

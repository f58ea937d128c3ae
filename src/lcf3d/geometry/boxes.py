"""3D boxes: corners, and conversions between the canonical convention and those of other tools.

Canonical box: ``(x, y, z, length, width, height, yaw)``, geometric centre, LiDAR frame (x forward, y left, z up),
yaw counter-clockwise about +z from +x, in [-pi, pi).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray

X, Y, Z, LENGTH, WIDTH, HEIGHT, YAW = range(7)

# Corner signs in (length, width, height); the front is +length:
#
#        4 -------- 5         z
#       /|         /|         |  x (front)
#      7 -------- 6 |         | /
#      | |        | |   y ----o
#      | 0 -------- 1
#      |/         |/
#      3 -------- 2
#
# 0-3 bottom, 4-7 top; 0 front left, 1 front right, 2 rear right, 3 rear left.
CORNER_SIGNS = np.array(
    [[1, 1, -1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1]],
    dtype=np.float64,
)
EDGES = np.array(
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]], dtype=np.int64
)


def wrap_angle(angle: FloatArray) -> FloatArray:
    """Angles brought into [-pi, pi)."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
    # the remainder of a tiny negative number rounds up to the divisor itself
    return np.where(wrapped >= np.pi, -np.pi, wrapped)


def box_corners(boxes: FloatArray) -> FloatArray:
    """(N, 8, 3) corners of (N, 7) canonical boxes, in the order drawn at `CORNER_SIGNS`."""
    corners = np.empty((len(boxes), 8, 3))
    # a copy in C order, so that one compiled version serves all
    _fill_corners(np.array(boxes, dtype=np.float64, order="C"), corners)
    return corners


@kernel
def _fill_corners(boxes, corners):  # type: ignore[no-untyped-def]
    """Fill ``corners`` (N, 8, 3)."""
    for n in range(len(boxes)):
        cos, sin = np.cos(boxes[n, 6]), np.sin(boxes[n, 6])
        for c in range(8):
            ahead = CORNER_SIGNS[c, 0] * (boxes[n, 3] / 2)
            aside = CORNER_SIGNS[c, 1] * (boxes[n, 4] / 2)
            corners[n, c, 0] = boxes[n, 0] + cos * ahead - sin * aside
            corners[n, c, 1] = boxes[n, 1] + sin * ahead + cos * aside
            corners[n, c, 2] = boxes[n, 2] + CORNER_SIGNS[c, 2] * (boxes[n, 5] / 2)


def bev_corners(boxes: FloatArray) -> FloatArray:
    """(N, 4, 2) bird's-eye-view corners of (N, 7) boxes: front left, front right, rear right, rear left."""
    return box_corners(boxes)[:, :4, :2]


def transform_boxes(boxes: FloatArray, target_from_source: FloatArray) -> FloatArray:
    """(N, 7) boxes moved by a rigid transform; a tilt of the vertical axis is dropped, the heading is projected.

    Exact for transforms that keep the vertical axis.
    """
    # a copy in C order, so that one compiled version serves all
    result = np.array(boxes, dtype=np.float64, order="C")
    _transform(result, np.array(target_from_source, dtype=np.float64, order="C"))
    return result


@kernel
def _transform(boxes, transform):  # type: ignore[no-untyped-def]
    """Move ``boxes`` (N, 7) in place, each by itself: no digit of a box depends on the others."""
    for n in range(len(boxes)):
        x, y, z = boxes[n, 0], boxes[n, 1], boxes[n, 2]
        for r in range(3):
            boxes[n, r] = transform[r, 0] * x + transform[r, 1] * y + transform[r, 2] * z + transform[r, 3]
        cos, sin = np.cos(boxes[n, 6]), np.sin(boxes[n, 6])
        ahead, aside = transform[0, 0] * cos + transform[0, 1] * sin, transform[1, 0] * cos + transform[1, 1] * sin
        yaw = math.atan2(aside, ahead)
        # -pi stands for pi
        boxes[n, 6] = -math.pi if yaw >= math.pi else yaw


def lidar_from_kitti(
    locations: FloatArray, dimensions_hwl: FloatArray, rotation_y: FloatArray, camera_from_lidar: FloatArray
) -> FloatArray:
    """Canonical boxes from KITTI objects.

    Args:
        locations: (N, 3) bottom centres in the rectified reference camera (x right, y down, z forward).
        dimensions_hwl: (N, 3) height, width, length.
        rotation_y: (N,) rotation about the camera's y axis, clockwise seen from above, 0 along camera x.
        camera_from_lidar: (4, 4) ``R0_rect @ Tr_velo_to_cam``.

    Returns:
        (N, 7) canonical boxes; exactly inverted by `kitti_from_lidar`.
    """
    boxes = np.empty((len(locations), 7))
    boxes[:, :3], boxes[:, 3:6], boxes[:, 6] = locations, dimensions_hwl, rotation_y
    _turn_kitti(boxes, np.array(camera_from_lidar, dtype=np.float64, order="C"))
    return boxes


@kernel
def _turn_kitti(boxes, camera_from_lidar):  # type: ignore[no-untyped-def]
    """Turn KITTI's columns (location, height, width, length, rotation_y) into canonical ones, in place."""
    for n in range(len(boxes)):
        height, length, turn = boxes[n, 3], boxes[n, 5], boxes[n, 6]
        x, z = boxes[n, 0] - camera_from_lidar[0, 3], boxes[n, 2] - camera_from_lidar[2, 3]
        y = boxes[n, 1] - height / 2 - camera_from_lidar[1, 3]
        for r in range(3):
            # R is orthonormal: its inverse is its transpose
            boxes[n, r] = x * camera_from_lidar[0, r] + y * camera_from_lidar[1, r] + z * camera_from_lidar[2, r]
        boxes[n, 3], boxes[n, 5] = length, height
        # the heading in the camera is (cos ry, 0, -sin ry); its x and y parts in the LiDAR frame give yaw
        cos, sin = math.cos(turn), math.sin(turn)
        ahead = cos * camera_from_lidar[0, 0] - sin * camera_from_lidar[2, 0]
        aside = cos * camera_from_lidar[0, 1] - sin * camera_from_lidar[2, 1]
        yaw = math.atan2(aside, ahead)
        # -pi stands for pi
        boxes[n, 6] = -math.pi if yaw >= math.pi else yaw


def kitti_from_lidar(boxes: FloatArray, camera_from_lidar: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """KITTI bottom centres (N, 3), dimensions h w l (N, 3) and rotation_y (N,) of canonical boxes.

    ``camera_from_lidar`` is ``R0_rect @ Tr_velo_to_cam`` (4, 4). The exact inverse of `lidar_from_kitti`.
    """
    rotation, translation = camera_from_lidar[:3, :3], camera_from_lidar[:3, 3]
    locations = boxes[:, :3] @ rotation.T + translation
    locations[:, 1] += boxes[:, HEIGHT] / 2
    heading = np.stack([np.cos(boxes[:, YAW]), np.sin(boxes[:, YAW])], axis=1)
    camera_heading = heading @ np.linalg.inv(_heading_map(rotation)).T
    rotation_y = wrap_angle(np.arctan2(-camera_heading[:, 1], camera_heading[:, 0]))
    return locations, boxes[:, [HEIGHT, WIDTH, LENGTH]], rotation_y


def _heading_map(rotation: FloatArray) -> FloatArray:
    """(2, 2) map of a heading's camera (x, z) parts to its LiDAR (x, y) parts, for ``camera_from_lidar`` rotation."""
    return rotation.T[:2][:, [0, 2]]


def observation_angle(locations: FloatArray, rotation_y: FloatArray) -> FloatArray:
    """(N,) KITTI ``alpha``: rotation_y as seen along the ray to the (N, 3) camera location."""
    return wrap_angle(rotation_y - np.arctan2(locations[:, 0], locations[:, 2]))


def canonical_from_mmdet3d(boxes: FloatArray) -> FloatArray:
    """Canonical boxes from OpenMMLab (v1.0 and later) LiDAR boxes ``x y z l w h yaw`` with z at the bottom face."""
    result = np.array(boxes[:, :7], dtype=np.float64)
    result[:, Z] += result[:, HEIGHT] / 2
    result[:, YAW] = wrap_angle(result[:, YAW])
    return result


def mmdet3d_from_canonical(boxes: FloatArray) -> FloatArray:
    """OpenMMLab (v1.0 and later) LiDAR boxes ``x y z l w h yaw``, z at the bottom face, of canonical boxes."""
    result = np.array(boxes, dtype=np.float64)
    result[:, Z] -= result[:, HEIGHT] / 2
    return result


def canonical_from_legacy_mmdet3d(boxes: FloatArray) -> FloatArray:
    """Canonical boxes from OpenMMLab boxes before v1.0: ``x y z w l h``, bottom face, yaw clockwise from -y."""
    result = np.array(boxes[:, [0, 1, 2, 4, 3, 5, 6]], dtype=np.float64)
    result[:, Z] += result[:, HEIGHT] / 2
    result[:, YAW] = wrap_angle(-result[:, YAW] - np.pi / 2)
    return result


def legacy_mmdet3d_from_canonical(boxes: FloatArray) -> FloatArray:
    """OpenMMLab boxes before v1.0 of canonical boxes; the inverse of `canonical_from_legacy_mmdet3d`."""
    result = np.array(boxes[:, [0, 1, 2, 4, 3, 5, 6]], dtype=np.float64)
    result[:, Z] -= result[:, HEIGHT] / 2
    result[:, YAW] = wrap_angle(-result[:, YAW] - np.pi / 2)
    return result


def canonical_from_openpcdet(boxes: FloatArray) -> FloatArray:
    """Canonical boxes from OpenPCDet ``x y z dx dy dz heading``: the same convention, with the heading wrapped."""
    result = np.array(boxes[:, :7], dtype=np.float64)
    result[:, YAW] = wrap_angle(result[:, YAW])
    return result


def points_in_boxes(points: NDArray[np.floating], boxes: FloatArray) -> NDArray[np.bool_]:
    """(K, N) whether each of (N, 3 or more) points lies in (or on) each of (K, 7) canonical boxes."""
    inside = np.zeros((len(boxes), len(points)), dtype=bool)
    for k, box in enumerate(boxes):
        dx, dy, dz = points[:, 0] - box[X], points[:, 1] - box[Y], points[:, 2] - box[Z]
        cos, sin = np.cos(box[YAW]), np.sin(box[YAW])
        inside[k] = (
            (np.abs(dx * cos + dy * sin) <= box[LENGTH] / 2)
            & (np.abs(dy * cos - dx * sin) <= box[WIDTH] / 2)
            & (np.abs(dz) <= box[HEIGHT] / 2)
        )
    return inside

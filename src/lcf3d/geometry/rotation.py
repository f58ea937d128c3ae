"""Quaternions, rotation matrices, rigid transforms and headings: pure functions on arrays.

Quaternions are ``(w, x, y, z)``, as nuScenes writes them, and need not be exactly of unit length.
"""

from __future__ import annotations

import numpy as np

from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """(N, 3, 3) rotation matrices of (N, 4) quaternions, which are normalised first."""
    q = np.asarray(quaternions, dtype=np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    matrices = np.empty((len(q), 3, 3))
    matrices[:, 0, 0] = 1 - 2 * (y * y + z * z)
    matrices[:, 0, 1] = 2 * (x * y - w * z)
    matrices[:, 0, 2] = 2 * (x * z + w * y)
    matrices[:, 1, 0] = 2 * (x * y + w * z)
    matrices[:, 1, 1] = 1 - 2 * (x * x + z * z)
    matrices[:, 1, 2] = 2 * (y * z - w * x)
    matrices[:, 2, 0] = 2 * (x * z - w * y)
    matrices[:, 2, 1] = 2 * (y * z + w * x)
    matrices[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return matrices


def quaternions_from_matrices(matrices: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions with w >= 0 of (N, 3, 3) rotation matrices."""
    m = np.asarray(matrices, dtype=np.float64)
    # the outer product q q^T is linear in the matrix; its largest column is q times a well-conditioned scale
    outer = np.empty((len(m), 4, 4))
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    for i, diagonal in enumerate((xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy)):
        outer[:, i, i] = 1 + diagonal
    outer[:, 0, 1] = outer[:, 1, 0] = m[:, 2, 1] - m[:, 1, 2]
    outer[:, 0, 2] = outer[:, 2, 0] = m[:, 0, 2] - m[:, 2, 0]
    outer[:, 0, 3] = outer[:, 3, 0] = m[:, 1, 0] - m[:, 0, 1]
    outer[:, 1, 2] = outer[:, 2, 1] = m[:, 0, 1] + m[:, 1, 0]
    outer[:, 1, 3] = outer[:, 3, 1] = m[:, 0, 2] + m[:, 2, 0]
    outer[:, 2, 3] = outer[:, 3, 2] = m[:, 1, 2] + m[:, 2, 1]
    largest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    q = outer[np.arange(len(m)), largest]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    unit: FloatArray = np.where(q[:, :1] < 0, -q, q)
    return unit


def quaternions_from_yaws(yaws: FloatArray) -> FloatArray:
    """(N, 4) quaternions of rotations by (N,) radians about +z."""
    half = np.asarray(yaws, dtype=np.float64) / 2
    zeros = np.zeros_like(half)
    return np.stack([np.cos(half), zeros, zeros, np.sin(half)], axis=-1)


def yaws_from_quaternions(quaternions: FloatArray) -> FloatArray:
    """(N,) angles in radians from +x to the rotated x axis, seen from above (the nuScenes yaw of a tilted box)."""
    q = np.asarray(quaternions, dtype=np.float64)
    w, x, y, z = q.T
    # twice the first column of the rotation matrix, scaled alike, so that no normalisation is needed
    yaws: FloatArray = np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
    return yaws


def rigid_transforms(quaternions: FloatArray, translations: FloatArray) -> FloatArray:
    """(N, 4, 4) transforms that rotate by (N, 4) quaternions, then move by (N, 3) metres."""
    transforms = np.zeros((len(quaternions), 4, 4))
    transforms[:, :3, :3] = rotation_matrices(quaternions)
    transforms[:, :3, 3] = translations
    transforms[:, 3, 3] = 1
    return transforms


def invert_rigid(transforms: FloatArray) -> FloatArray:
    """Inverses of rigid transforms (..., 4, 4): ``source_from_target`` of ``target_from_source``."""
    inverse = np.zeros_like(np.asarray(transforms, dtype=np.float64))
    rotation = np.swapaxes(transforms[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ transforms[..., :3, 3:4])[..., 0]
    inverse[..., 3, 3] = 1
    return inverse


def transform_points(points: FloatArray, target_from_source: FloatArray) -> FloatArray:
    """(N, 3) points moved by one (4, 4) or by (N, 4, 4) rigid transforms."""
    rotation, translation = target_from_source[..., :3, :3], target_from_source[..., :3, 3]
    moved: FloatArray = np.einsum("...ij,...j->...i", rotation, points) + translation
    return moved


def interpolated(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    """The (4, 4) pose that lies ``share`` of the way between two; beyond 1 the motion is carried on.

    The turn between them goes on evenly about its axis; the way is a straight line.
    """
    pose = np.eye(4)
    _fill_between(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64), float(share), pose)
    return pose


@kernel
def _fill_between(first, second, share, pose):  # type: ignore[no-untyped-def]
    """Fill (4, 4) ``pose``: `interpolated`."""
    turn = np.empty((3, 3))
    for i in range(3):
        pose[i, 3] = (1 - share) * first[i, 3] + share * second[i, 3]
        for j in range(3):
            turn[i, j] = first[0, i] * second[0, j] + first[1, i] * second[1, j] + first[2, i] * second[2, j]
    x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    double_sine = np.sqrt(x * x + y * y + z * z)
    if double_sine > 1e-12:
        x, y, z = x / double_sine, y / double_sine, z / double_sine
    angle = share * np.arctan2(double_sine, turn[0, 0] + turn[1, 1] + turn[2, 2] - 1)
    # Rodrigues' formula
    sine, rest = np.sin(angle), 1 - np.cos(angle)
    turn[0] = 1 - rest * (y * y + z * z), rest * x * y - sine * z, rest * x * z + sine * y
    turn[1] = rest * x * y + sine * z, 1 - rest * (x * x + z * z), rest * y * z - sine * x
    turn[2] = rest * x * z - sine * y, rest * y * z + sine * x, 1 - rest * (x * x + y * y)
    for i in range(3):
        for j in range(3):
            pose[i, j] = first[i, 0] * turn[0, j] + first[i, 1] * turn[1, j] + first[i, 2] * turn[2, j]

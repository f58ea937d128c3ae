"""Quaternions, rotation matrices, rigid transforms and headings: pure functions on arrays.

Quaternions are ``(w, x, y, z)``, as nuScenes writes them, and need not be exactly of unit length.
"""

from __future__ import annotations

import numpy as np

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

    The normalised line between the quaternions is the great circle to a hundredth of a degree for small turns.
    """
    q = quaternions_from_matrices(np.stack([first[:3, :3], second[:3, :3]]))
    if q[0] @ q[1] < 0:
        q[1] = -q[1]
    turned = (1 - share) * q[0] + share * q[1]
    moved = (1 - share) * first[:3, 3] + share * second[:3, 3]
    pose: FloatArray = rigid_transforms(turned[None], moved[None])[0]
    return pose

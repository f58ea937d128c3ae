"""Frames of KITTI layout that are moments of a drive: ids ``SEQUENCE_FRAME`` and, in ``ROOT/poses``, poses."""

from __future__ import annotations

import re

from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import FloatArray

# KITTI's recording rate; the LiDAR turns so often
FRAMES_PER_S = 10.0
_SEQUENCE_ID = re.compile(r"(\d{4})_(\d{6})")


def sequence_of(frame_id: str) -> tuple[str | None, int]:
    """Drive and frame number in it, where ids read ``SEQUENCE_FRAME`` (KITTI tracking, 10 frames a second)."""
    match = _SEQUENCE_ID.fullmatch(frame_id)
    return (match[1], int(match[2])) if match else (None, 0)


def lidar_pose(poses: FloatArray, number: int, camera_from_lidar: FloatArray) -> FloatArray | None:
    """(4, 4) first LiDAR from the LiDAR of a frame, from poses of the camera; None beyond the last pose."""
    if number >= len(poses):
        return None
    pose: FloatArray = invert_rigid(camera_from_lidar) @ poses[number] @ camera_from_lidar
    return pose

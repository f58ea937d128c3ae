"""How the sensor moved since the last frame, from the objects themselves, where the dataset has no poses.

Most objects stand still, and tracks say where the others went: the planar motion that brings this frame's boxes onto
the tracks is the sensor's. It is solved by least squares with weights that fall with the residual, so that what moves
unforeseen or is no object at all counts little.
"""

from __future__ import annotations

import numpy as np

from lcf3d.fusion.memory_motion import position_noise
from lcf3d.fusion.memory_state import Tracks
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.structures import FloatArray, IntArray

# pairs farther apart than this at first, and in the end, are none, metres
REACH_M = (3.0, 2.0, 1.0, 1.0)
# residual at which a pair counts half, metres
SOFTNESS_M = 0.3
MIN_PAIRS = 3
# speeds tried where it is not known, m/s
TRIAL_SPEEDS = np.arange(-2.0, 40.0, 0.5)
TRIAL_REACH_M = 0.5


def estimate_pose(
    tracks: Tracks,
    boxes: FloatArray,
    labels: IntArray,
    world_from_lidar: FloatArray,
    velocity: FloatArray | None,
    elapsed_s: float,
) -> tuple[FloatArray, FloatArray]:
    """(4, 4) ``world_from_lidar`` of a frame, and (3,) the sensor's velocity: ahead and left, m/s, and yaw rate, rad/s.

    Without enough pairs the sensor is taken to move on as before (without a ``velocity``: to stand).

    Args:
        tracks: predicted to the frame's time.
        boxes: (N, 7) of the frame in its LiDAR frame.
        labels: (N,) their classes.
        world_from_lidar: (4, 4) of the frame before.
        velocity: (3,) of the frame before, or None where it is not known.
        elapsed_s: since then.
    """
    first = velocity is None
    speed = np.zeros(3) if velocity is None else velocity
    if first and len(tracks) >= MIN_PAIRS and len(boxes) >= MIN_PAIRS:
        speed = _trial(tracks, boxes, labels, world_from_lidar, elapsed_s)
    step = speed * elapsed_s
    for reach in REACH_M:
        step, pairs = _refined(tracks, boxes, labels, world_from_lidar, step, reach)
        if pairs < MIN_PAIRS:
            return world_from_lidar @ _planar(speed * elapsed_s), speed
    return world_from_lidar @ _planar(step), step / elapsed_s


def _refined(
    tracks: Tracks, boxes: FloatArray, labels: IntArray, world_from_lidar: FloatArray, step: FloatArray, reach: float
) -> tuple[FloatArray, int]:
    """(3,) the step that fits the pairs within reach better, and how many pairs there are."""
    moved = transform_boxes(boxes, world_from_lidar @ _planar(step))
    distance = _distances(tracks, moved, labels)
    if not distance.size:
        return step, 0
    nearest = distance.argmin(axis=1)
    rows = np.flatnonzero(distance.min(axis=1) < reach)
    if len(rows) < MIN_PAIRS:
        return step, len(rows)
    own = nearest[rows]
    # in the LiDAR frame before the step, where the step is applied
    inverse = np.linalg.inv(world_from_lidar)
    target = tracks.positions[own] @ inverse[:2, :2].T + inverse[:2, 3]
    noise = tracks.position_cov[own, 0] + position_noise(np.hypot(boxes[rows, 0], boxes[rows, 1])) ** 2
    weights = 1 / (noise * (1 + (distance[rows, own] / SOFTNESS_M) ** 2))
    weights = weights / weights.sum()
    source = boxes[rows, :2]
    a, b = weights @ source, weights @ target
    cross = ((source - a) * weights[:, None]).T @ (target - b)
    angle = float(np.arctan2(cross[0, 1] - cross[1, 0], cross[0, 0] + cross[1, 1]))
    cos, sin = np.cos(angle), np.sin(angle)
    shift = b - np.array([cos * a[0] - sin * a[1], sin * a[0] + cos * a[1]])
    return np.array([shift[0], shift[1], angle]), len(rows)


def _trial(
    tracks: Tracks, boxes: FloatArray, labels: IntArray, world_from_lidar: FloatArray, elapsed_s: float
) -> FloatArray:
    """(3,) the speed straight ahead that brings most boxes onto tracks; the lowest of equals."""
    best, found = np.zeros(3), -1
    for speed in sorted(TRIAL_SPEEDS, key=abs):
        step = np.array([speed * elapsed_s, 0.0, 0.0])
        distance = _distances(tracks, transform_boxes(boxes, world_from_lidar @ _planar(step)), labels)
        pairs = int((distance.min(axis=1) < TRIAL_REACH_M).sum())
        if pairs > found:
            best, found = step / elapsed_s, pairs
    return best


def _distances(tracks: Tracks, boxes: FloatArray, labels: IntArray) -> FloatArray:
    """(N, T) metres between boxes in the world and tracks, infinite between classes."""
    apart = np.linalg.norm(boxes[:, None, :2] - tracks.positions[None], axis=2)
    distances: FloatArray = np.where(labels[:, None] == tracks.labels[None], apart, np.inf)
    return distances


def _planar(step: FloatArray) -> FloatArray:
    """(4, 4) previous-LiDAR-from-LiDAR of a step (ahead, left, yaw)."""
    transform = np.eye(4)
    cos, sin = np.cos(step[2]), np.sin(step[2])
    transform[:2, :2] = [[cos, -sin], [sin, cos]]
    transform[:2, 3] = step[:2]
    return transform

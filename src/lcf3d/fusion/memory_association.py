"""Which track each detection of a frame belongs to: one to one, of equal class, nearest in the filter's own measure."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from lcf3d.fusion.memory_motion import position_noise
from lcf3d.fusion.memory_state import Tracks
from lcf3d.structures import FloatArray, IntArray

# a pair farther apart than this many standard deviations is none
GATE = 4.0


def associate(
    tracks: Tracks, boxes: FloatArray, labels: IntArray, distances: FloatArray, reach: FloatArray
) -> IntArray:
    """(N,) the track of each detection, or -1.

    Minimises the summed squared Mahalanobis distance over the pairs within the gate, more pairs before nearer ones.

    Args:
        tracks: predicted to the time of the detections.
        boxes: (N, 7) in the world frame.
        labels: (N,) classes.
        distances: (N,) from the sensor, metres.
        reach: (L,) metres that a pair of each class may be apart at most.
    """
    match = np.full(len(boxes), -1, dtype=np.int64)
    if not len(tracks) or not len(boxes):
        return match
    off = boxes[:, None, :2] - tracks.positions[None]
    squared = (off**2).sum(axis=2)
    variance = tracks.position_cov[None, :, 0] + position_noise(distances)[:, None] ** 2
    cost = squared / variance - GATE**2
    possible = (cost < 0) & (squared < reach[labels][:, None] ** 2) & (labels[:, None] == tracks.labels[None])
    rows, columns = linear_sum_assignment(np.where(possible, cost, 0.0))
    good = possible[rows, columns]
    match[rows[good]] = columns[good]
    return match

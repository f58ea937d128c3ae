"""Which track each detection of a frame belongs to: one to one, of equal class, nearest in the filter's own measure."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from lcf3d.fusion.memory_motion import POSITION_NOISE, POSITION_NOISE_BY_DISTANCE, place
from lcf3d.fusion.memory_state import LABEL, Tracks
from lcf3d.kernels import kernel
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
    cost = np.zeros((len(boxes), len(tracks)))
    _costs(tracks.values, tracks.numbers, boxes, np.array(labels), distances, reach, cost)
    rows, columns = linear_sum_assignment(cost)
    good = cost[rows, columns] < 0
    match[rows[good]] = columns[good]
    return match


@kernel
def _costs(values, numbers, boxes, labels, distances, reach, cost):  # type: ignore[no-untyped-def]
    """Fill ``cost`` (N, T): squared Mahalanobis distance less that of the gate; 0 stays for pairs that are none."""
    for j in range(len(values)):
        x, y, variance = place(values[j])
        for i in range(len(boxes)):
            if labels[i] != numbers[j, LABEL]:
                continue
            noise = POSITION_NOISE + POSITION_NOISE_BY_DISTANCE * distances[i]
            squared = (boxes[i, 0] - x) ** 2 + (boxes[i, 1] - y) ** 2
            if squared < reach[labels[i]] * reach[labels[i]]:
                cost[i, j] = min(squared / (variance + noise * noise) - GATE * GATE, 0.0)

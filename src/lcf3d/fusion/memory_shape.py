"""Boxes made better by their track: sizes averaged, heights of the bottom steadied, positions drawn to the filter's.

An object keeps its size, and detectors see it from one side: when its size changes, the corner that faces the sensor
stays where it was measured and the far side gives.
"""

from __future__ import annotations

import numpy as np

from lcf3d.fusion.memory_state import BOTTOM, SIZE, SIZE_WEIGHT
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray

# the past counts at most so many times what the present does in a size
MAX_PAST = 3.0
# share of the track in the height of the bottom a tenth of a second after it was last seen
BOTTOM_SHARE = 0.5
BOTTOM_UNIT_S = 0.1
# share of the filter's correction that a position takes; the detector errs alike from frame to frame
POSITION_SHARE = 0.5


def size_weight(log_odds: FloatArray) -> FloatArray:
    """(N,) how much measured sizes count, by the detections' log-odds; sure ones count more."""
    return np.exp(np.minimum(np.maximum(log_odds, -6.0), 6.0) / 2)


def bottom_share(unseen_s: FloatArray) -> FloatArray:
    """(N,) share of the track in the height of the bottom; a track unseen for long counts less."""
    return np.asarray(BOTTOM_SHARE ** np.maximum(unseen_s / BOTTOM_UNIT_S, 1.0))


@kernel
def reshape(track, box, weight, bottom_share):  # type: ignore[no-untyped-def]
    """Average a track's sizes with those of a measured box, and steady its bottom (numba).

    Args:
        track: (25,) row of `Tracks.values`; changed in place.
        box: (7,) measured, upright as the world is.
        weight: `size_weight` of the box.
        bottom_share: see there.
    """
    past = min(track[SIZE_WEIGHT], MAX_PAST * weight)
    total = past + weight
    for k in range(3):
        track[SIZE + k] = (track[SIZE + k] * past + box[3 + k] * weight) / total
    track[SIZE_WEIGHT] = total
    bottom = box[2] - box[5] / 2
    track[BOTTOM] = bottom + bottom_share * (track[BOTTOM] - bottom)


@kernel
def refine(boxes, match, rigid, tracked, refined):  # type: ignore[no-untyped-def]
    """Fill ``refined`` (N, 7) with detections made better by their tracks (numba).

    Sizes and height are the track's; the side facing the sensor stays, then the position is drawn to the track's.

    Args:
        boxes: (N, 7) measured, in the LiDAR frame.
        match: (N,) track, or -1.
        rigid: (N,) whether the object is; others keep their box.
        tracked: (T, 7) boxes of the tracks in the LiDAR frame.
        refined: (N, 7) to fill.
    """
    for i in range(len(boxes)):
        refined[i] = boxes[i]
        if match[i] < 0 or not rigid[i]:
            continue
        box, own = boxes[i], tracked[match[i]]
        cos, sin = np.cos(box[6]), np.sin(box[6])
        # the sensor seen from the box, in half lengths and widths: beyond +-1 it is in front of that face
        ahead = -(box[0] * cos + box[1] * sin) / (box[3] / 2)
        aside = -(box[1] * cos - box[0] * sin) / (box[4] / 2)
        forward = min(max(ahead, -1.0), 1.0) * (box[3] - own[3]) / 2
        left = min(max(aside, -1.0), 1.0) * (box[4] - own[4]) / 2
        x = box[0] + (cos * forward - sin * left)
        y = box[1] + (sin * forward + cos * left)
        refined[i, 0] = x + POSITION_SHARE * (own[0] - box[0])
        refined[i, 1] = y + POSITION_SHARE * (own[1] - box[1])
        refined[i, 2:6] = own[2:6]

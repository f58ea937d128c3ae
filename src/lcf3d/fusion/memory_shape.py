"""Boxes made better by their track: sizes averaged, heights of the bottom steadied, positions drawn to the filter's.

An object keeps its size, and detectors see it from one side: when its size changes, the corner that faces the sensor
stays where it was measured and the far side gives.
"""

from __future__ import annotations

import numpy as np

from lcf3d.fusion.memory_state import (
    BOTTOM,
    HEADING,
    POSITION_X,
    POSITION_Y,
    SIZE,
    SIZE_H,
    SIZE_WEIGHT,
    STANDING,
    STANDING_X,
    STANDING_Y,
    Tracks,
)
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, IntArray

# the past counts at most so many times what the present does in a size
MAX_PAST = 3.0
# measured sizes count 1 / e as much at this distance: from nearby more of an object is seen
SIZE_DISTANCE = 10.0
# share of the track in the height of the bottom a tenth of a second after it was last seen, at the sensor and far away
BOTTOM_SHARE, FAR_BOTTOM_SHARE, FAR = 0.5, 0.7, 60.0
BOTTOM_UNIT_S = 0.1
# share of the filter's correction that a position takes; the detector errs alike from frame to frame
POSITION_SHARE = 0.5
# share of the model that stands in that position, for what surely stands
STANDING_SHARE = 0.25


def size_weight(log_odds: FloatArray, distances: FloatArray) -> FloatArray:
    """(N,) how much measured sizes count, by the detections' log-odds and distances: sure and near ones count more."""
    return np.asarray(np.exp(np.minimum(np.maximum(log_odds, -6.0), 6.0) / 2 - distances / SIZE_DISTANCE))


def bottom_share(unseen_s: FloatArray, distances: FloatArray) -> FloatArray:
    """(N,) share of the track in the height of the bottom; a track unseen for long counts less, a far one more."""
    share = BOTTOM_SHARE + (FAR_BOTTOM_SHARE - BOTTOM_SHARE) * np.minimum(distances / FAR, 1.0)
    return np.asarray(share ** np.maximum(unseen_s / BOTTOM_UNIT_S, 1.0))


def boxes_now(tracks: Tracks, own: IntArray, measured: FloatArray, share: float) -> FloatArray:
    """(T, 7) boxes of tracks in the world frame.

    What is not seen is where it is if it stands or if it moves, whichever is more probable. What is seen is where it is
    if it moves, drawn to where it is if it stands: else what stands and starts would be held back.

    Args:
        tracks: T of them, with what the frame saw.
        own: (N,) the tracks that are seen.
        measured: (N, 7) their measured boxes.
        share: of the way from the measured position to the track's that they go.
    """
    boxes = np.empty((len(tracks), 7))
    _fill_boxes(tracks.values, own, measured, share, boxes)
    return boxes


@kernel
def _fill_boxes(values, own, measured, share, boxes):  # type: ignore[no-untyped-def]
    """Fill ``boxes``, see `boxes_now`."""
    for i in range(len(values)):
        track = values[i]
        if track[STANDING] > 0.5:
            boxes[i, 0], boxes[i, 1] = track[STANDING_X], track[STANDING_Y]
        else:
            boxes[i, 0], boxes[i, 1] = track[POSITION_X], track[POSITION_Y]
        boxes[i, 2] = track[BOTTOM] + track[SIZE_H] / 2
        boxes[i, 3:6] = track[SIZE : SIZE + 3]
        boxes[i, 6] = track[HEADING]
    for k in range(len(own)):
        i, track = own[k], values[own[k]]
        p = STANDING_SHARE * track[STANDING]
        x = track[POSITION_X] + p * (track[STANDING_X] - track[POSITION_X])
        y = track[POSITION_Y] + p * (track[STANDING_Y] - track[POSITION_Y])
        boxes[i, 0] = x if share == 1 else x + (1 - share) * (measured[k, 0] - x)
        boxes[i, 1] = y if share == 1 else y + (1 - share) * (measured[k, 1] - y)


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
def refine(boxes, match, rigid, upright, tracked, refined):  # type: ignore[no-untyped-def]
    """Fill ``refined`` (N, 7) with detections made better by their tracks (numba).

    Sizes and height are the track's; the side facing the sensor stays, then the position is drawn to the track's.

    Args:
        boxes: (N, 7) measured, in the LiDAR frame.
        match: (N,) track, or -1.
        rigid: (N,) whether the object is.
        upright: (N,) whether at least its height is the track's, on the measured bottom; others keep their box.
        tracked: (T, 7) boxes of the tracks in the LiDAR frame.
        refined: (N, 7) to fill.
    """
    for i in range(len(boxes)):
        refined[i] = boxes[i]
        if match[i] < 0:
            continue
        box, own = boxes[i], tracked[match[i]]
        if not rigid[i]:
            if not upright[i]:
                continue
            refined[i, 2], refined[i, 5] = box[2] + (own[5] - box[5]) / 2, own[5]
            continue
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

"""Boxes made better by their track: sizes averaged, heights of the bottom steadied, positions drawn to the filter's.

An object keeps its size, and detectors see it from one side: when its size changes, the corner that faces the sensor
stays where it was measured and the far side gives.
"""

from __future__ import annotations

import numpy as np

from lcf3d.geometry.boxes import HEIGHT, LENGTH, WIDTH, YAW, Z
from lcf3d.structures import FloatArray

# the past counts at most so many times what the present does in a size
MAX_PAST = 3.0
# share of the track in the height of the bottom a tenth of a second after it was last seen
BOTTOM_SHARE = 0.5
BOTTOM_UNIT_S = 0.1
# share of the filter's correction that a position takes; the detector errs alike from frame to frame
POSITION_SHARE = 0.5


def averaged_sizes(
    sizes: FloatArray, size_weights: FloatArray, measured: FloatArray, log_odds: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(N, 3) sizes of tracks with those measured now, and (N,) how much they then count.

    Args:
        sizes: (N, 3) of the tracks.
        size_weights: (N,) how much they count.
        measured: (N, 3) now.
        log_odds: (N,) of the detections measured; sure ones count more.
    """
    present = size_weight(log_odds)
    past = np.minimum(size_weights, MAX_PAST * present)
    total = past + present
    return (sizes * past[:, None] + measured * present[:, None]) / total[:, None], total


def size_weight(log_odds: FloatArray) -> FloatArray:
    """(N,) how much measured sizes count, by the detections' log-odds."""
    return np.exp(np.clip(log_odds, -6.0, 6.0) / 2)


def steadied_bottoms(bottoms: FloatArray, measured: FloatArray, elapsed_s: FloatArray) -> FloatArray:
    """(N,) heights of the bottom between the track's and the measured ones; a track long unseen counts less."""
    share = BOTTOM_SHARE ** np.maximum(elapsed_s / BOTTOM_UNIT_S, 1.0)
    return measured + share * (bottoms - measured)


def resized(boxes: FloatArray, sizes: FloatArray) -> FloatArray:
    """(N, 7) boxes in the LiDAR frame with (N, 3) other sizes; the bottom and the side facing the sensor stay."""
    cos, sin = np.cos(boxes[:, YAW]), np.sin(boxes[:, YAW])
    # the sensor seen from the box, in half lengths and widths: beyond +-1 it is in front of that face
    ahead = np.clip(-(boxes[:, 0] * cos + boxes[:, 1] * sin) / (boxes[:, LENGTH] / 2), -1, 1)
    aside = np.clip(-(boxes[:, 1] * cos - boxes[:, 0] * sin) / (boxes[:, WIDTH] / 2), -1, 1)
    forward = ahead * (boxes[:, LENGTH] - sizes[:, 0]) / 2
    left = aside * (boxes[:, WIDTH] - sizes[:, 1]) / 2
    result = boxes.copy()
    result[:, 0] += cos * forward - sin * left
    result[:, 1] += sin * forward + cos * left
    result[:, Z] += (sizes[:, 2] - boxes[:, HEIGHT]) / 2
    result[:, LENGTH : HEIGHT + 1] = sizes
    return result

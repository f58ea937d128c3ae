"""Which number an object goes by, and which boxes belong into a file of tracks.

A detector gives one object two boxes now and then, and the second begins a track of its own. The next single box may go
to either track, as the evidence has it; the object's number should not change for that. So a number that has no box in
a frame goes to a box at its place whose own number was seen in fewer frames, or is new. Numbers change places: each
belongs to one track at any time. Scores, boxes and predictions do not depend on them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lcf3d.fusion.memory_motion import place
from lcf3d.fusion.memory_state import BORN, ID, LABEL, NUMBER_HITS, Tracks
from lcf3d.kernels import kernel
from lcf3d.provenance import FusedDetections
from lcf3d.structures import BoolArray, FloatArray, IntArray

# a box is at a track's place when it is nearer than this share of its smaller side: two rigid objects cannot be, while
# boxes of people, wider than people are, come nearer
PLACE_SHARE, PLACE_SHARE_SOFT = 1.0, 0.75
# predicted boxes with a lower score stay out of files of tracks
LEAST_PREDICTED_SCORE = 0.05


def keep_numbers(tracks: Tracks, n_old: int, own: IntArray, boxes: FloatArray, rigid: BoolArray) -> Tracks:
    """The tracks with their numbers where the objects are, and each number that has a box counted once more.

    Numbers that were seen most often choose first, each the nearest box at its place.

    Args:
        tracks: after the frame; the first ``n_old`` were there before it.
        n_old: see ``tracks``.
        own: (N,) track of each detection.
        boxes: (N, 7) of the detections in the world frame.
        rigid: (N,) whether each is of a class that keeps its shape.
    """
    numbers, values = tracks.numbers.copy(), tracks.values.copy()
    without = np.ones(n_old, dtype=bool)
    without[own[own < n_old]] = False
    rows = np.flatnonzero(without)
    rows = rows[np.argsort(-numbers[rows, NUMBER_HITS], kind="stable")]
    if len(rows) and len(own):
        reach = np.where(rigid, PLACE_SHARE, PLACE_SHARE_SOFT) * boxes[:, 3:5].min(axis=1)
        _exchange(numbers, values, rows, own, boxes, reach)
    numbers[own, NUMBER_HITS] += 1
    return Tracks(numbers, values)


@kernel
def _exchange(numbers, values, rows, own, boxes, reach):  # type: ignore[no-untyped-def]
    """Let each of ``rows`` (R,) in turn change numbers with the track of a box nearer than ``reach`` (N,)."""
    taken = np.zeros(len(own), dtype=np.bool_)
    for row in rows:
        best, nearest = -1, np.inf
        x, y, _ = place(values[row])
        for i in range(len(own)):
            other = numbers[own[i]]
            if taken[i] or other[LABEL] != numbers[row, LABEL] or other[NUMBER_HITS] >= numbers[row, NUMBER_HITS]:
                continue
            squared = (boxes[i, 0] - x) ** 2 + (boxes[i, 1] - y) ** 2
            if squared < min(reach[i] * reach[i], nearest):
                best, nearest = i, squared
        if best >= 0:
            taken[best] = True
            other_row = own[best]
            for column in (ID, NUMBER_HITS):
                numbers[row, column], numbers[other_row, column] = numbers[other_row, column], numbers[row, column]
            values[row, BORN], values[other_row, BORN] = values[other_row, BORN], values[row, BORN]


class Tracked(NamedTuple):
    """Outputs of a frame that a file of tracks holds: (K,) their rows, and (K,) numbers."""

    rows: IntArray
    ids: IntArray


def tracked(fused: FusedDetections) -> Tracked | None:
    """The outputs that a file of tracks holds; None where the frame was judged alone.

    All that the frame saw, and predicted boxes that are probable enough and still have the number that was seen. For
    average precision a box of low score costs nothing; tracks are judged whole, and each of their boxes counts in full.
    """
    if fused.tracks is None:
        return None
    likely = (fused.detections.scores >= LEAST_PREDICTED_SCORE) & (fused.tracks.hits > 0)
    rows = np.flatnonzero(~fused.tracks.predicted | likely)
    return Tracked(rows, fused.tracks.ids[rows])

"""Order and grouping of frames for a memory."""

import pytest

from lcf3d.errors import DatasetError
from lcf3d.frame import Frame
from lcf3d.run.sequences import in_order, pending


class Frames:
    def __init__(self, frames):
        self.frames = {frame.id: frame for frame in frames}

    def frame(self, frame_id):
        return self.frames[frame_id]


def test_interleaved_sequences_come_apart_and_frames_in_order_of_time():
    dataset = Frames(
        [
            Frame("a1", timestamp=1.0, sequence="a"),
            Frame("b0", timestamp=0.0, sequence="b"),
            Frame("a0", timestamp=0.0, sequence="a"),
            Frame("x"),
            Frame("b1", timestamp=1.0, sequence="b"),
        ]
    )
    assert in_order(dataset, list(dataset.frames)) == [["a0", "a1"], ["b0", "b1"], ["x"]]


def test_frames_without_any_order_are_refused():
    with pytest.raises(DatasetError, match="no past to remember"):
        in_order(Frames([Frame("x")]), ["x"])


def test_an_interrupted_sequence_begins_anew():
    assert pending([["a0", "a1"], ["b0"]], {"a0", "b0"}.__contains__) == [["a0", "a1"]]

"""Numbers of tracks: who keeps one when a detector gives an object two boxes, and what a file of tracks holds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.datasets.kitti_results import KittiWriter
from lcf3d.formats.kitti_tracking import read_tracks
from lcf3d.frame import Frame
from lcf3d.fusion.memory import remember_sequence
from lcf3d.fusion.memory_identity import LEAST_PREDICTED_SCORE, keep_numbers, tracked
from lcf3d.fusion.memory_motion import begin
from lcf3d.fusion.memory_state import ID, LABEL, NUMBER_HITS, Tracks

from .scenes import PEDESTRIAN, camera, car, pedestrian
from .test_memory import frame, fused


def tracks(places, numbers):
    """Tracks just seen at places, with (id, class, hits of the id)."""
    values = np.zeros((len(places), 25))
    for row, box in zip(values, places, strict=True):
        begin(row, np.array(box, dtype=float), 20.0, 5.0)
    table = np.array([[own, label, 1, hits] for own, label, hits in numbers]).reshape(-1, 4)
    return Tracks(table, values)


def kept(places, numbers, own, boxes, rigid=True):
    boxes = np.array(boxes, dtype=float)
    n_old = len(places) - len([row for row, (_, _, hits) in enumerate(numbers) if hits == 0])
    result = keep_numbers(tracks(places, numbers), n_old, np.array(own), boxes, np.full(len(own), rigid, dtype=bool))
    return result.numbers[:, [ID, NUMBER_HITS]].tolist()


def test_the_better_known_number_goes_to_the_only_box():
    # track 7 was seen 40 times; the box is matched with track 9 beside it, seen twice
    assert kept([car(20), car(20, 1.0)], [(7, 0, 40), (9, 0, 2)], [1], [car(20, 0.8)]) == [[9, 2], [7, 41]]


def test_a_new_track_takes_the_number_of_the_track_that_stands_there():
    assert kept([car(20), car(20, 1.0)], [(7, 0, 40), (8, 0, 0)], [1], [car(20, 1.0)]) == [[8, 0], [7, 41]]


def test_a_lesser_number_takes_nothing_and_two_boxes_keep_theirs():
    assert kept([car(20), car(20, 1.0)], [(7, 0, 2), (9, 0, 40)], [1], [car(20, 0.8)]) == [[7, 2], [9, 41]]
    both = kept([car(20), car(20, 1.0)], [(7, 0, 40), (9, 0, 2)], [0, 1], [car(20), car(20, 1.0)])
    assert both == [[7, 41], [9, 3]]


@pytest.mark.parametrize(("rigid", "apart", "takes"), [(True, 1.75, True), (True, 1.85, False), (False, 1.3, True)])
def test_the_place_is_as_wide_as_the_object(rigid, apart, takes):
    # the car is 1.8 m wide; people must be nearer than three quarters of their width
    numbers = kept([car(20), car(20, apart)], [(7, 0, 40), (8, 0, 0)], [1], [car(20, apart)], rigid)
    assert (numbers[1][0] == 7) == takes
    assert kept([car(20), car(20, 1.4)], [(7, 0, 40), (8, 0, 0)], [1], [car(20, 1.4)], False)[1][0] == 8


def test_another_class_takes_no_number():
    assert kept([car(20), pedestrian(20, 0.3)], [(7, 0, 40), (8, 1, 0)], [1], [pedestrian(20, 0.3)])[1] == [8, 1]


def test_the_best_known_number_chooses_first_and_the_nearest_box():
    places = [car(20), car(20, 0.6), car(20, 1.0), car(20, 1.5)]
    numbers = kept(places, [(1, 0, 5), (2, 0, 9), (3, 0, 0), (4, 0, 0)], [2, 3], [car(20, 1.0), car(20, 1.5)])
    assert [own for own, _ in numbers] == [4, 3, 2, 1]


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.floats(-4, 4), st.integers(0, 1), st.integers(1, 9)), min_size=1, max_size=6), st.data())
def test_numbers_only_change_places(rows, data):
    own = data.draw(st.lists(st.integers(0, len(rows) - 1), unique=True, max_size=len(rows)))
    before = tracks([car(20, y) for y, _, _ in rows], [(i, label, hits) for i, (_, label, hits) in enumerate(rows)])
    boxes = np.array([car(20, rows[i][0]) for i in own], dtype=float).reshape(-1, 7)
    after = keep_numbers(before, len(rows), np.array(own, dtype=np.int64), boxes, np.ones(len(own), dtype=bool))
    assert sorted(after.ids.tolist()) == list(range(len(rows)))
    assert np.array_equal(after.labels, before.labels)
    assert np.array_equal(after.hits, before.hits)
    assert after.number_hits.sum() == before.number_hits.sum() + len(own)
    label_of = dict(zip(before.ids.tolist(), before.numbers[:, LABEL].tolist(), strict=True))
    assert all(label_of[i] == label for i, label in zip(after.ids.tolist(), after.labels.tolist(), strict=True))


def test_a_second_box_of_one_frame_does_not_change_the_number():
    # frame 5 has two boxes of the car; later single boxes lie between both places
    alone = [(frame(0.1 * t), fused([car(20)], [0.9])) for t in range(5)]
    alone += [(frame(0.5), fused([car(20), car(20, 1.2)], [0.9, 0.6]))]
    alone += [(frame(0.1 * t), fused([car(20, 1.1)], [0.9])) for t in range(6, 9)]
    results = list(remember_sequence(alone))
    first = int(results[0].tracks.ids[0])
    for result in results:
        seen = ~result.tracks.predicted
        assert first in result.tracks.ids[seen]
    assert results[-1].tracks.hits[~results[-1].tracks.predicted].tolist() == [9]
    assert results[-1].tracks.ages_s[~results[-1].tracks.predicted] == pytest.approx([0.8])


def test_frames_without_outputs_are_in_the_file(tmp_path):
    results = remember_sequence(
        [(frame(0.1 * t), fused([car(20)], [0.9]) if t == 1 else fused([], [])) for t in range(3)]
    )
    by_id = {f"0000_{t:06d}": result for t, result in enumerate(results)}
    writer = KittiWriter(tmp_path)
    for frame_id, result in by_id.items():
        writer.write(Frame(frame_id, cameras=(camera(),)), result)
    writer.finish(tuple(by_id), by_id.__getitem__)
    tracks = read_tracks(tmp_path / "tracks/0000.txt", results=True)
    assert (tracks.frames.tolist(), tracks.ids.tolist()) == ([1], [0])


def test_files_of_tracks_leave_out_what_is_hardly_probable():
    seen = [(frame(0.1 * t), fused([car(20), pedestrian(8, 2)], [0.95, 0.6], [0, PEDESTRIAN])) for t in range(6)]
    missed = [(frame(0.1 * t), fused([], [])) for t in range(6, 20)]
    results = list(remember_sequence(seen + missed))
    assert tracked(results[5]).rows.tolist() == [0, 1]
    left_out = 0
    for result in results[6:]:
        rows, ids = tracked(result)
        assert ids.tolist() == result.tracks.ids[rows].tolist()
        expected = np.flatnonzero(result.detections.scores >= LEAST_PREDICTED_SCORE)
        assert rows.tolist() == expected.tolist()
        left_out += len(result) - len(rows)
    assert left_out > 0
    assert len(tracked(results[6]).rows) > 0
    assert tracked(fused([car(20)], [0.9])) is None

"""CLEAR, sAMOTA and HOTA on sequences small enough to count by hand, and HOTA against the TrackEval package."""

import numpy as np
import pytest

from lcf3d.evaluation.tracking import TrackedFrames, averaged, clear, hota, track_scores


def sequence(truth, found, overlaps, scores=None):
    scores = [[1.0] * len(own) for own in found] if scores is None else scores
    return TrackedFrames(
        [np.array(own, dtype=np.int64) for own in truth],
        [np.array(own, dtype=np.int64) for own in found],
        [np.array(own, dtype=float) for own in scores],
        [np.array(o, dtype=float).reshape(len(t), len(f)) for o, t, f in zip(overlaps, truth, found, strict=True)],
    )


PERFECT = sequence([[1, 2]] * 5, [[7, 8]] * 5, [np.eye(2)] * 5)


def test_truth_against_itself_is_100():
    counts = clear([PERFECT], 0.25)
    assert (counts.mota, counts.motp, counts.switches) == (100, 100, 0)
    assert hota([PERFECT]) == pytest.approx((100, 100, 100, 100))
    assert averaged([PERFECT], 0.25).best.mota == 100


def test_a_switch_a_miss_and_a_false_alarm_counted_by_hand():
    # object 1: tracks 7 7 9 - 9; in frame 4 a false alarm far from it
    one = sequence([[1]] * 5, [[7], [7], [9], [5], [9]], [[[0.8]], [[0.6]], [[0.5]], [[0.1]], [[0.5]]])
    counts = clear([one], 0.25)
    assert (counts.objects, counts.hits, counts.misses, counts.false_alarms) == (5, 4, 1, 1)
    assert (counts.switches, counts.fragments) == (1, 1)
    assert counts.mota == pytest.approx(100 * (1 - 3 / 5))
    assert counts.motp == pytest.approx(100 * 2.4 / 4)
    # at recall 0.8 the one miss is implied: 2 errors of 0.8 * 5
    assert counts.smoothed_mota(0.8) == pytest.approx(50)


def test_a_switch_over_a_gap_counts_in_clear_but_not_in_the_form_of_kitti():
    one = sequence([[1]] * 3, [[7], [], [9]], [[[0.8]], np.zeros((1, 0)), [[0.8]]])
    assert clear([one], 0.25).switches == 1
    assert clear([one], 0.25, keep="never").switches == 0


def test_matches_are_kept_where_they_still_overlap():
    one = sequence([[1], [1]], [[7], [8, 7]], [[[0.8]], [[0.9, 0.4]]])
    assert clear([one], 0.25).switches == 0
    assert clear([one], 0.25, keep="never").switches == 1


def test_averaging_over_recall_by_hand():
    # 40 objects in 40 frames, two tracks of 20 with scores 0.9 and 0.5, no errors: at every recall sMOTA is 100
    found = [[3 if t < 20 else 4] for t in range(40)]
    scores = [[0.9 if t < 20 else 0.5] for t in range(40)]
    one = sequence([[1]] * 40, found, [[[0.5]]] * 40, scores)
    result = averaged([one], 0.25)
    # positions 1/40 to 20/40 keep the first track (recall 0.5, MOTA 50), those above keep both with one switch
    assert result.amota == pytest.approx((20 * 50 + 20 * (100 - 2.5)) / 40, abs=1.3)
    assert result.samota == pytest.approx(100, abs=3)
    assert result.amotp == pytest.approx(50, abs=1.3)
    assert result.threshold == 0.5


def test_without_output_and_without_objects():
    nothing = sequence([[1]] * 2, [[], []], [np.zeros((1, 0))] * 2)
    assert averaged([nothing], 0.25).samota == 0
    assert clear([nothing], 0.25).mota == 0
    empty = sequence([[], []], [[], []], [np.zeros((0, 0))] * 2)
    assert np.isnan(clear([empty], 0.25).mota)


def test_track_scores_are_means_over_the_track():
    scores = track_scores([np.array([1, 2]), np.array([1])], [np.array([0.2, 0.9]), np.array([0.6])])
    assert [own.tolist() for own in scores] == [pytest.approx([0.4, 0.9]), pytest.approx([0.4])]


def random_sequence(seed):
    rng = np.random.default_rng(seed)
    truth, found, overlaps = [], [], []
    for _ in range(30):
        g = rng.permutation(6)[: rng.integers(0, 6)]
        p = rng.permutation(9)[: rng.integers(0, 8)]
        near = rng.uniform(0, 1, (len(g), len(p))) * (rng.random((len(g), len(p))) < 0.3)
        near[g[:, None] == p[None]] = rng.uniform(0.3, 1)
        truth.append(g), found.append(p), overlaps.append(near)
    return sequence(truth, found, overlaps)


@pytest.mark.parametrize("seed", range(5))
def test_the_best_point_is_that_of_the_outputs_above_its_threshold(seed):
    one, rng = random_sequence(seed), np.random.default_rng(seed)
    # few different scores, so that many outputs go at once
    scored = sequence(one.truth, one.found, one.overlaps, [rng.integers(1, 5, len(own)) / 5 for own in one.found])
    result = averaged([scored], 0.25)
    counts = clear([scored.above(result.threshold)], 0.25, keep="never")
    assert counts == result.best
    assert counts.hits + counts.false_alarms == sum(int((own >= result.threshold).sum()) for own in scored.scores)


@pytest.mark.parametrize("seed", range(5))
def test_against_trackeval(seed):
    trackeval = pytest.importorskip("trackeval", reason="the oracle, not a dependency: pip install trackeval")
    one = random_sequence(seed)
    data = {
        "gt_ids": list(one.truth),
        "tracker_ids": list(one.found),
        "similarity_scores": list(one.overlaps),
        "num_gt_ids": 6,
        "num_tracker_ids": 9,
        "num_gt_dets": sum(map(len, one.truth)),
        "num_tracker_dets": sum(map(len, one.found)),
        "num_timesteps": 30,
    }
    theirs = trackeval.metrics.HOTA().eval_sequence(data)
    ours = hota([one])
    for name in ("HOTA", "DetA", "AssA", "LocA"):
        assert getattr(ours, name.lower()) == pytest.approx(100 * theirs[name].mean(), abs=1e-6)
    theirs = trackeval.metrics.CLEAR({"THRESHOLD": 0.25, "PRINT_CONFIG": False}).eval_sequence(data)
    counts = clear([one], 0.25)
    expected = [theirs[name] for name in ("CLR_TP", "CLR_FN", "CLR_FP", "IDSW")]
    assert [counts.hits, counts.misses, counts.false_alarms, counts.switches] == expected
    assert counts.mota == pytest.approx(100 * theirs["MOTA"])

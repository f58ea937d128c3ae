"""The memory on tiny sequences: a car that stands, drives, hides and comes back, seen by a sensor that moves."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.decisions import Decisions
from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.evidence import to_log_odds
from lcf3d.fusion.memory import remember, remember_sequence
from lcf3d.fusion.memory_config import ClassMemory, MemoryConfig
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D

from .scenes import CAR, PEDESTRIAN, camera, car, lidar, pedestrian, seen

STILL = np.eye(4)


def fused(boxes, scores, labels=None, found2d=None):
    """Outputs that each LiDAR box led to, and free 2D detections of the left camera."""
    detections = lidar(boxes, scores, labels)
    table = Decisions.blank(len(detections))
    table.outcome[:] = Outcome.KEPT
    table.lidar[:] = table.output[:] = np.arange(len(detections))
    found2d = Detections2D.empty(KITTI_CLASSES) if found2d is None else found2d
    free = Decisions.blank(len(found2d))
    free.camera[:], free.detection[:] = 0, np.arange(len(found2d))
    return FusedDetections(detections, table, free, detections, (found2d,), ("left",))


def frame(time, pose=STILL, **more):
    return Frame(f"{time:.1f}", cameras=(camera(),), timestamp=time, world_from_lidar=pose, **more)


def moved(x, y=0.0, yaw=0.0):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:2, 3] = x, y
    return pose


def play(frames, config=None):
    return list(remember_sequence(frames, config))


def test_the_first_frame_comes_back_as_it_is():
    (result,) = play([(frame(0.0), fused([car(20), car(30)], [0.9, 0.4]))])
    assert np.array_equal(result.detections.boxes, [car(20), car(30)])
    assert np.array_equal(result.detections.scores, [0.9, 0.4])
    assert not result.tracks.predicted.any()


def test_without_time_frames_are_judged_alone():
    once = fused([car(20)], [0.6])
    assert all(result is once for result in play([(Frame("a", world_from_lidar=STILL), once), (Frame("b"), once)]))


def test_support_worked_out_by_hand():
    # log-odds 0 support with 4; after two frames at 10 Hz (4 * fade + 4) * fade; 0.1 * (that - 6 * fade) is added
    results = play([(frame(t), fused([car(20)], [0.5])) for t in (0.0, 0.1, 0.2)])
    fade = np.exp(-0.1 / 0.45)
    weight = MemoryConfig().of("Car").seen_weight
    assert to_log_odds(results[1].detections.scores)[0] == pytest.approx(weight * (4 * fade - 6 * fade))
    assert to_log_odds(results[2].detections.scores)[0] == pytest.approx(weight * ((4 * fade + 4) * fade - 6 * fade))
    assert results[2].tracks.hits.tolist() == [3]
    assert results[2].tracks.ages_s == pytest.approx([0.2])


@settings(deadline=None, max_examples=25)
@given(st.lists(st.floats(0.02, 0.98), min_size=2, max_size=5), st.integers(0, 3), st.floats(0, 0.9))
def test_more_support_in_the_past_never_lowers_a_score(scores, which, more):
    which = min(which, len(scores) - 2)
    better = list(scores)
    better[which] += (1 - better[which]) * more

    def last(values):
        return play([(frame(0.1 * t), fused([car(20)], [s])) for t, s in enumerate(values)])[-1].detections.scores[0]

    assert last(better) >= last(scores) - 1e-12


def test_a_new_box_where_somebody_looked_loses_and_one_from_outside_the_view_does_not():
    behind = car(-20)
    results = play([(frame(0.0), fused([], [])), (frame(0.1), fused([car(20), behind], [0.5, 0.5]))])
    by_x = dict(zip(results[1].detections.boxes[:, 0], results[1].detections.scores, strict=True))
    assert by_x[20.0] < 0.5
    assert by_x[-20.0] == 0.5


def drive(speed, missing, n=8, score=0.99, step_s=0.1):
    """A car that drives along x, not detected in the frames named."""
    return [
        (frame(t * step_s), fused(*(([], []) if t in missing else ([car(15 + speed * step_s * t, 1.0)], [score]))))
        for t in range(n)
    ]


@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_a_missed_object_is_predicted_where_it_went(speed):
    result = play(drive(speed, missing={7}))[-1]
    assert result.tracks.predicted.tolist() == [True]
    assert result.outcomes.tolist() == [Outcome.PREDICTED]
    assert result.detections.boxes[0] == pytest.approx(car(15 + speed * 0.7, 1.0), abs=0.05)
    assert result.detections.velocities[0] == pytest.approx([speed, 0], abs=0.3)
    assert result.tracks.unseen_s == pytest.approx([0.1])
    assert "predicted: no detection of this frame shows it" in result.explain(0)


def test_predicted_scores_decay_and_end():
    results = play(drive(0.0, missing=set(range(5, 30)), n=30))
    scores = [r.detections.scores[0] if len(r) else 0.0 for r in results[5:]]
    assert scores[0] > 0.2
    assert all(b <= a for a, b in pairwise(scores))
    assert scores[-1] == 0.0
    # the track itself is forgotten: the same place begins a new one
    again = play([*drive(0.0, missing=set(range(5, 30)), n=30), (frame(3.0), fused([car(15, 1.0)], [0.9]))])
    assert again[-1].tracks.ids[0] != again[0].tracks.ids[0]


def test_a_free_camera_detection_confirms_a_predicted_box():
    frames = drive(0.0, missing={7})
    alone = play(frames)[-1].detections.scores[0]
    shown = fused([], [], found2d=seen(camera(), [car(15, 1.0)], [0.9]))
    confirmed = play([*frames[:-1], (frames[-1][0], shown)])[-1].detections.scores[0]
    assert to_log_odds(np.array([confirmed])) - to_log_odds(np.array([alone])) == pytest.approx(3.0 * 0.9)


def test_a_box_that_another_hides_is_believed_longer():
    frames = drive(0.0, missing={7})
    open_score = play(frames)[-1].detections.scores[0]
    truck = [8.0, 0.5, -0.3, 4.0, 2.5, 3.0, 0.0]
    hidden = play([*frames[:-1], (frames[-1][0], fused([truck], [0.9]))])[-1]
    assert hidden.detections.scores[hidden.tracks.predicted][0] > open_score


def wall(x):
    y, z = np.meshgrid(np.linspace(-4, 6, 200), np.linspace(-2, 1, 60))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel(), np.zeros(y.size)]).astype(np.float32)


def test_free_space_refutes_a_predicted_box():
    frames = drive(0.0, missing={7})
    alone = play(frames)[-1].detections.scores[0]
    beams_through = play([*frames[:-1], (frame(0.7, points=wall(40.0)), fused([], []))])[-1].detections.scores
    beams_stopped = play([*frames[:-1], (frame(0.7, points=wall(6.0)), fused([], []))])[-1].detections.scores
    assert beams_stopped[0] == pytest.approx(alone)
    assert not len(beams_through) or beams_through[0] < alone / 5


@pytest.mark.parametrize(
    ("label", "score", "stays"), [(PEDESTRIAN, 0.05, True), (PEDESTRIAN, 0.99, False), (CAR, 0.05, False)]
)
def test_a_predicted_box_gives_way_to_its_own_class_and_to_what_is_as_sure(label, score, stays):
    # in the last frame something 1.2 m beside: too far for the car's filter to be the car, and it overlaps it
    frames = [(frame(0.1 * t), fused([car(20)], [0.95])) for t in range(6)]
    last = play([*frames, (frame(0.6), fused([car(20, 1.2)], [score], [label]))])[-1]
    assert bool((last.tracks.predicted & (last.detections.labels == CAR)).any()) == stays


def test_ego_motion_is_taken_out():
    # the sensor drives at 10 m/s and turns; the parked car stays one track and has no speed
    frames = []
    for t in range(8):
        pose = moved(1.0 * t, 0.02 * t * t, 0.02 * t)
        inverse = np.linalg.inv(pose)
        x, y = (inverse @ [30, 2, 0, 1])[:2]
        frames.append((frame(0.1 * t, pose), fused([car(x, y, -0.02 * t)], [0.9])))
    results = play(frames)
    assert len({int(r.tracks.ids[0]) for r in results}) == 1
    assert results[-1].detections.velocities[0] == pytest.approx([0, 0], abs=0.3)


@pytest.mark.parametrize("speed", [0.0, 12.0])
def test_without_poses_ego_motion_is_estimated_from_the_objects(speed):
    parked = np.array([[12, 4], [20, -4], [28, 4], [35, -4.5], [44, 4], [50, -4]])
    frames = []
    for t in range(8):
        inverse = np.linalg.inv(moved(speed * 0.1 * t, 0.0, 0.01 * t))
        xy = parked @ inverse[:2, :2].T + inverse[:2, 3]
        boxes = [car(x, y, -0.01 * t) for x, y in xy]
        # one car drives along
        boxes.append(car(15.0, 0.0, 0.0))
        frames.append((Frame(str(t), cameras=(camera(),), timestamp=0.1 * t), fused(boxes, [0.9] * 7)))
    last = play(frames)[-1]
    assert sorted(last.tracks.ids.tolist()) == list(range(7))
    own = last.detections.velocities[last.tracks.ids == 6][0]
    assert own == pytest.approx([speed, 0], abs=1.0)


def test_sizes_gain_from_the_past_and_the_side_that_faces_the_sensor_stays():
    boxes = [car(20.0)] * 5 + [[20.5, 0, -0.8, 5.0, 1.8, 1.6, 0.0]]  # the rear at 18 m, measured too long once
    result = play([(frame(0.1 * t), fused([b], [0.95])) for t, b in enumerate(boxes)])[-1]
    x, length = result.detections.boxes[0][[0, 3]]
    assert 4.0 < length < 4.5
    assert x - length / 2 == pytest.approx(18.0, abs=0.15)


def test_people_keep_the_box_of_the_frame_but_for_their_height():
    boxes = [pedestrian(10, 0.1 * t) for t in range(4)]
    boxes[-1][3], boxes[-1][5] = 0.9, 1.4  # a leg forward, and measured 0.4 m too low: the bottom is at -1.4
    result = play([(frame(0.1 * t), fused([b], [0.9], [PEDESTRIAN])) for t, b in enumerate(boxes)])[-1]
    x, y, z, length, width, height, yaw = result.detections.boxes[0]
    assert [x, y, length, width, yaw] == [10, pytest.approx(0.3), 0.9, 0.6, 0.0]
    # three times the present, which weighs as much, and the present
    assert height == pytest.approx((3 * 1.8 + 1.4) / 4)
    assert z - height / 2 == pytest.approx(-1.4)
    loose = MemoryConfig().of("Pedestrian").model_copy(update={"upright": False})
    frames = [(frame(0.1 * t), fused([b], [0.9], [PEDESTRIAN])) for t, b in enumerate(boxes)]
    assert np.array_equal(play(frames, MemoryConfig(classes={"Pedestrian": loose}))[-1].detections.boxes[0], boxes[-1])


def test_a_pole_taken_for_a_person_loses_and_what_walks_gains():
    steps = [0.12 * t for t in range(12)]
    frames = [
        (frame(0.1 * t), fused([pedestrian(10, -2), pedestrian(10, step)], [0.6, 0.6], [PEDESTRIAN] * 2))
        for t, step in enumerate(steps)
    ]
    last, plain = (
        play(frames, MemoryConfig(classes={"Pedestrian": MemoryConfig().of("Pedestrian").model_copy(update=change)}))[
            -1
        ]
        for change in ({}, {"standing_doubt": 0.0})
    )
    by_y = {bool(box[1] > 0): score for box, score in zip(last.detections.boxes, last.detections.scores, strict=True)}
    assert plain.detections.scores[0] == pytest.approx(plain.detections.scores[1])
    added = {moves: to_log_odds(np.array([score]))[0] for moves, score in by_y.items()}
    before = to_log_odds(plain.detections.scores[:1])[0]
    # of people half stand, of false alarms 0.8
    assert added[True] - before == pytest.approx(np.log(0.5 / 0.2), abs=0.1)
    assert added[False] - before == pytest.approx(np.log(0.5 / 0.8), abs=0.1)


def test_classes_do_not_share_tracks():
    results = play(
        [
            (frame(0.0), fused([pedestrian(10)], [0.9], [PEDESTRIAN])),
            (frame(0.1), fused([pedestrian(10)], [0.9], [CAR])),
        ]
    )
    assert results[0].tracks.ids[0] not in results[1].tracks.ids[~results[1].tracks.predicted]


@pytest.mark.parametrize(
    ("second", "note"),
    [
        (frame(-1.0), "time went back by 1.000 s"),
        (frame(5.0), "no frame for 5.00 s"),
        (frame(0.1, moved(30.0)), "the pose jumped (300 m/s"),
        (frame(0.1, sequence="other"), "this one is of other"),
    ],
)
def test_a_break_begins_anew_and_is_told(second, note):
    first, once = fused([car(20)], [0.9]), fused([car(20)], [0.6])
    results = play([(frame(0.0), first), (second, once)])
    assert any(note in text for text in results[1].notes)
    assert np.array_equal(results[1].detections.scores, [0.6])
    assert np.array_equal(results[1].detections.boxes, once.detections.boxes)
    assert results[1].tracks.ids[0] != results[0].tracks.ids[0]


def test_a_duplicate_frame_is_judged_alone_and_changes_nothing():
    frames = drive(5.0, missing=set(), n=4)
    twice = [*frames[:3], frames[2], frames[3]]
    results = play(twice)
    assert "judged alone" in results[3].notes[0]
    assert np.array_equal(results[3].detections.scores, frames[2][1].detections.scores)
    assert np.array_equal(results[4].detections.boxes, play(frames)[3].detections.boxes)


def test_frames_that_are_missing_for_less_than_a_second_are_bridged():
    frames = drive(5.0, missing=set(), n=12)
    results = play([*frames[:4], *frames[9:]])
    assert not any(result.notes for result in results)
    assert len({int(result.tracks.ids[0]) for result in results}) == 1
    assert results[4].tracks.hits.tolist() == [5]


def test_two_sequences_interleaved_by_name_begin_anew_and_are_told():
    frames = drive(5.0, missing=set(), n=4)
    mixed = []
    for one, found in frames:
        for name in ("a", "b"):
            mixed.append((frame(one.timestamp, sequence=name), found))
    results = play(mixed)
    assert all("the memory began anew" in result.notes[0] for result in results[1:])
    # nothing of one drive speaks for the other: every frame is as if it were the first
    for (_, alone), result in zip(mixed, results, strict=True):
        assert np.array_equal(result.detections.scores, alone.detections.scores)
        assert np.array_equal(result.detections.boxes, alone.detections.boxes)


def test_what_follows_a_step_back_in_time_is_remembered():
    frames = drive(5.0, missing=set(), n=4)
    again = [*frames, *frames]
    results = play(again)
    assert [bool(result.notes) for result in results] == [False] * 4 + [True] + [False] * 3
    for first, second in zip(results[:4], results[4:], strict=True):
        assert np.array_equal(first.detections.scores, second.detections.scores)
        assert not set(first.tracks.ids.tolist()) & set(second.tracks.ids.tolist())


def test_a_memory_of_another_configuration_is_refused():
    memory, _ = remember(None, fused([car(20)], [0.9]), frame(0.0), MemoryConfig())
    # equal settings in another object, or read from a file, are the same settings
    remember(memory, fused([car(20)], [0.9]), frame(0.1), MemoryConfig())
    other = fused([car(20)], [0.9])
    names = replace(other.detections, class_names=("Car", "Pedestrian", "Rider"))
    with pytest.raises(ConfigError, match="begin a new memory"):
        remember(memory, replace(other, detections=names), frame(0.1), MemoryConfig())
    with pytest.raises(ConfigError, match="begin a new memory"):
        remember(memory, fused([car(20)], [0.9]), frame(0.1), MemoryConfig(horizon_s=0.5))


def test_scores_that_are_no_probabilities_are_refused():
    with pytest.raises(ConfigError, match="needs probabilities"):
        remember(None, fused([car(20)], [3.0]), frame(0.0), MemoryConfig())


def test_the_state_is_bounded():
    config = MemoryConfig(max_tracks=5)
    memory = None
    rng = np.random.default_rng(0)
    for t in range(6):
        many = fused(np.array([car(*xy) for xy in rng.uniform(5, 60, (20, 2))]), rng.uniform(0.1, 0.9, 20))
        memory, _ = remember(memory, many, frame(0.1 * t), config)
        assert len(memory.tracks) <= 5


def test_the_state_stays_of_one_size_over_ten_thousand_frames():
    config, rng = MemoryConfig(horizon_s=0.5), np.random.default_rng(0)
    memory, largest, sizes, eyes = None, 0, [], (camera(),)
    # two that stand, and one that is somewhere else in every frame
    stand = [car(15, 2.0), car(25, -3.0)]
    seen_now = [fused([*stand, car(rng.uniform(30, 60), rng.uniform(-8, 8))], [0.9, 0.8, 0.3]) for _ in range(50)]
    for t in range(10_000):
        one = Frame(str(t), cameras=eyes, timestamp=0.1 * t, world_from_lidar=STILL)
        memory, found = remember(memory, seen_now[t % 50], one, config)
        largest = max(largest, len(memory.tracks))
        if t in (100, 9_999):
            sizes.append(memory.tracks.values.nbytes + memory.tracks.numbers.nbytes)
            # a slice of a larger table would keep all of it
            assert memory.tracks.values.base is None
    assert largest <= 2 + 6
    assert sizes[1] <= sizes[0] * 2
    oldest = found.tracks.ages_s.max()
    assert oldest == pytest.approx(999.9, abs=0.1)
    assert np.isfinite(memory.tracks.values).all()


def test_remember_is_pure():
    frames = drive(5.0, missing=set(), n=3)
    memory, _ = remember(None, frames[0][1], frames[0][0], MemoryConfig())
    one, first = remember(memory, frames[1][1], frames[1][0], MemoryConfig())
    two, second = remember(memory, frames[1][1], frames[1][0], MemoryConfig())
    assert np.array_equal(first.detections.boxes, second.detections.boxes)
    assert np.array_equal(one.tracks.positions, two.tracks.positions)


def test_velocities_that_the_detector_gave_are_kept():
    with_speed = fused([car(20)], [0.9])
    given_speed = Detections3D([car(20)], [0.9], [CAR], KITTI_CLASSES, velocities=[[3.0, 1.0]])
    with_speed = replace(with_speed, detections=given_speed)
    results = play([(frame(0.0), with_speed), (frame(0.1), with_speed)])
    assert np.array_equal(results[1].detections.velocities, [[3.0, 1.0]])


def test_provenance_survives_json_and_follows_the_outputs():
    result = play(
        [
            (frame(0.0), fused([car(20), car(30)], [0.5, 0.4])),
            (frame(0.1), fused([car(20), car(30)], [0.4, 0.5])),
        ]
    )[-1]
    back = FusedDetections.from_json(result.to_json())
    assert np.array_equal(back.tracks.ids, result.tracks.ids)
    assert back.explanations() == [result.explain(0), result.explain(1)]
    # the LiDAR detection that led to each output is still the one whose box it has
    for row, output in enumerate(result.lidar.output):
        assert result.lidar_inputs.boxes[row][0] == pytest.approx(result.detections.boxes[output][0])


def test_memory_at_two_hertz_moves_with_a_fast_car():
    results = play(drive(15.0, missing={5}, n=6, step_s=0.5))
    assert len({int(r.tracks.ids[0]) for r in results[2:5]}) == 1
    assert results[5].tracks.predicted.all()


def test_class_settings_by_name():
    config = MemoryConfig(classes={"Car": ClassMemory(seen_weight=0.0)})
    assert config.of("Car").seen_weight == 0.0
    assert not config.of("pedestrian").rigid
    assert config.of("truck").speed_spread == MemoryConfig().of("car").speed_spread
    assert config.of("anything").turns
    assert config.of("cyclist").standing_doubt > config.of("bicycle").standing_doubt == 0


def test_the_axes_of_the_dataset_s_world_do_not_matter():
    # poses in axes of a camera: y down, z ahead
    camera_axes = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    own, turned = [], []
    for t in range(6):
        detections = fused([car(30 - 1.0 * t, 2.0)], [0.9]) if t < 5 else fused([], [])
        own.append((frame(0.1 * t, moved(1.0 * t)), detections))
        turned.append((frame(0.1 * t, camera_axes @ moved(1.0 * t)), detections))
    for one, other in zip(play(own), play(turned), strict=True):
        assert one.detections.boxes == pytest.approx(other.detections.boxes, abs=1e-9)

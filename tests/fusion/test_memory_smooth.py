"""Memory both ways: what is seen later testifies too."""

import numpy as np
import pytest

from lcf3d.frame import Frame
from lcf3d.fusion.memory import remember_sequence
from lcf3d.fusion.memory_smooth import smooth_sequence

from .scenes import car
from .test_memory import drive, frame, fused


def test_a_gap_is_filled_between_the_sightings():
    # the car brakes to a stop while it is not seen: only the frames after tell
    xs = [15.0, 16.0, 17.0, 18.0, 18.7, 19.1, 19.3, 19.3, 19.3, 19.3]
    frames = [
        (frame(0.1 * t), fused(*(([], []) if t in (4, 5, 6) else ([car(x, 1.0)], [0.99])))) for t, x in enumerate(xs)
    ]
    causal, both = list(remember_sequence(frames)), smooth_sequence(frames)
    for t in (5, 6):
        assert both[t].tracks.predicted.all()
        error = abs(both[t].detections.boxes[0][0] - xs[t])
        assert error < abs(causal[t].detections.boxes[0][0] - xs[t])
        assert both[t].detections.scores[0] > causal[t].detections.scores[0]


def test_the_first_frame_gains_from_those_after_it():
    frames = drive(0.0, missing=set(), score=0.6)
    assert next(iter(remember_sequence(frames))).detections.scores[0] == 0.6
    assert smooth_sequence(frames)[0].detections.scores[0] > 0.6


def test_an_object_is_predicted_before_its_first_sighting():
    frames = drive(8.0, missing={0, 1})
    both = smooth_sequence(frames)
    assert both[1].tracks.predicted.tolist() == [True]
    assert both[1].detections.boxes[0][0] == pytest.approx(15.8, abs=0.1)
    assert both[1].detections.velocities[0] == pytest.approx([8, 0], abs=0.5)
    assert both[1].tracks.ids[0] == both[3].tracks.ids[0]


def test_tracks_are_unique_in_every_frame():
    rng = np.random.default_rng(3)
    frames = []
    for t in range(25):
        shown = [car(10 + 6 * k + 0.3 * t * (k % 2), 3.0 * (k % 3)) for k in range(6) if rng.random() < 0.6]
        frames.append((frame(0.1 * t), fused(shown, rng.uniform(0.3, 0.99, len(shown)))))
    for result in smooth_sequence(frames):
        assert len(set(result.tracks.ids.tolist())) == len(result)


def test_time_turned_round_gives_the_same():
    frames = drive(6.0, missing={3})
    mirrored = [
        (Frame(f.id, cameras=f.cameras, timestamp=0.7 - f.timestamp, world_from_lidar=f.world_from_lidar), d)
        for f, d in frames[::-1]
    ]
    both, turned = smooth_sequence(frames), smooth_sequence(mirrored)[::-1]
    for one, other in zip(both, turned, strict=True):
        assert one.detections.scores == pytest.approx(other.detections.scores)
        assert one.detections.boxes == pytest.approx(other.detections.boxes, abs=1e-6)
        assert one.detections.velocities == pytest.approx(-other.detections.velocities, abs=1e-6, nan_ok=True)


def test_without_time_frames_are_judged_alone():
    once = fused([car(20)], [0.6])
    assert smooth_sequence([(Frame("a"), once)]) == [once]

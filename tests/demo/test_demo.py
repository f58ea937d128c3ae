import json

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.demo.detectors import CAR, camera_detections, ground_truth, labelled, lidar_detections, points_on
from lcf3d.demo.drive import demo_frames, run_demo
from lcf3d.demo.shipped import read_drive


@pytest.fixture(scope="module")
def shipped():
    return read_drive(count=2)[1]


def test_ground_truth_has_returns_and_three_classes(shipped):
    truth = ground_truth(shipped)
    assert (points_on(shipped, truth.boxes) >= 5).all()
    assert set(truth.labels.tolist()) == {0, 1, 2}
    assert len(truth) <= len(labelled(shipped)[0])


def test_lidar_detector_misses_more_where_points_are_few(shipped):
    truth = ground_truth(shipped)
    points = points_on(shipped, truth.boxes)
    found = np.zeros(len(truth))
    for seed in range(40):
        centres = lidar_detections(shipped, np.random.default_rng(seed)).boxes[:, :2]
        apart = np.linalg.norm(centres[:, None] - truth.boxes[None, :, :2], axis=2)
        found += (apart < 1.0).any(axis=0)
    cars = truth.labels == CAR
    assert (found[cars & (points > 300)] >= 36).all()
    assert found[points < 20].mean() < 30


def test_lidar_detector_sees_people_in_poles(shipped):
    alarms = 0
    for seed in range(20):
        found = lidar_detections(shipped, np.random.default_rng(seed))
        apart = np.linalg.norm(found.boxes[:, None, :2] - shipped.distractors.boxes[None, :, :2], axis=2)
        objects = np.linalg.norm(found.boxes[:, None, :2] - shipped.objects.boxes[None, :, :2], axis=2)
        strange = (apart.min(axis=1) < 0.6) & (objects.min(axis=1) > 1.5)
        assert (found.labels[strange] != CAR).all()
        alarms += strange.any()
    assert alarms > 5


def test_camera_detector_misses_what_is_almost_hidden(shipped):
    hidden = shipped.objects.boxes2d[shipped.objects.occluded == 3]
    limits = [shipped.camera.width, shipped.camera.height] * 2
    for seed in range(10):
        found = camera_detections(shipped, np.random.default_rng(seed)).boxes
        assert (found >= 0).all()
        assert (found <= limits).all()
        assert len(found) <= len(shipped.objects.tracks) - len(hidden) + 4


def test_the_same_seed_gives_the_same_bytes():
    one, two = (next(demo_frames(1, seed=7)) for _ in range(2))
    assert one.frame.points.tobytes() == two.frame.points.tobytes()
    assert one.frame.images["left"].tobytes() == two.frame.images["left"].tobytes()
    assert one.lidar.boxes.tobytes() == two.lidar.boxes.tobytes()
    assert one.camera["left"].boxes.tobytes() == two.camera["left"].boxes.tobytes()
    other = next(demo_frames(1, seed=8))
    assert other.lidar.boxes.tobytes() != one.lidar.boxes.tobytes()


def test_fusion_beats_the_lidar_alone():
    result = run_demo(list(demo_frames(6)))
    alone, full = result.metrics["LiDAR alone"], result.metrics["kitti: matching + recovery"]
    assert full.mean_ap > alone.mean_ap
    stages = np.concatenate([fused.stages for fused in result.fused])
    assert set(stages.tolist()) >= {0, 1}  # matched and recovered
    assert any(len(fused.dropped_lidar) for fused in result.fused)


def test_command(tmp_path):
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "d"), "--frames", "2", "--json"])
    assert result.exit_code == 0, result.output
    assert set(json.loads(result.stdout)["variants"]) == {
        "LiDAR alone",
        *(f"{preset}: {parts}" for preset in ("paper", "kitti") for parts in ("matching", "matching + recovery")),
    }
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["000000.png", "000001.png", "drive.gif"]

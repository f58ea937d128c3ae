import json
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.datasets.drive import beam_numbers, every_beam, read_drive
from lcf3d.demo.drive import (
    FULL,
    LIDAR_ALONE,
    LIDARS,
    VARIANTS,
    Detectors,
    drive,
    ground_truth,
    measure,
    shipped_detectors,
)
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.reasons import Outcome
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D


@pytest.fixture(scope="module")
def driven():
    moments = list(drive(shipped_detectors(), 8))
    return {name: [moment[name] for moment in moments] for name in LIDARS}


def test_ground_truth_has_returns_and_three_classes():
    shipped = read_drive(count=2)[1]
    truth = ground_truth(shipped)
    assert (points_in_boxes(shipped.points, truth.boxes).sum(axis=1) >= 5).all()
    assert set(truth.labels.tolist()) == {0, 1, 2}
    assert len(truth) <= len(shipped.objects.tracks)


def test_a_quarter_of_the_beams_is_a_quarter_of_the_scan():
    points = read_drive(count=1)[0].points
    numbers = beam_numbers(points)
    assert numbers.max() == 63
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    means = np.bincount(numbers, elevation) / np.bincount(numbers)
    assert np.abs(np.diff(means)).max() < 0.06
    assert means[0] == means.max()
    np.testing.assert_array_equal(every_beam(points, 4), points[np.isin(numbers, range(0, 64, 4))])
    assert every_beam(points, 1) is points


@pytest.mark.parametrize("lidar", LIDARS)
def test_both_networks_find_things_and_every_stage_takes_part(driven, lidar):
    assert all(len(item.lidar) > 0 and len(item.camera["left"]) > 0 for item in driven[lidar])
    outcomes = np.concatenate([item.fused.outcomes for item in driven[lidar]])
    assert Outcome.MATCHED in outcomes
    # the dense LiDAR's network need not miss anything in these frames
    assert Outcome.RECOVERED in outcomes or lidar == "64 beams"
    assert all(set(item.milliseconds) == set(driven[lidar][0].milliseconds) for item in driven[lidar])


def test_networks_begin_with_the_next_frame_while_this_one_is_fused():
    started, ended = [], []

    class Slow:
        def __init__(self, name, result):
            self.name, self.result = name, result

        def __call__(self, values):
            started.append((self.name, time.perf_counter()))
            time.sleep(0.05)
            ended.append((self.name, time.perf_counter()))
            return self.result

    nothing = Detections3D.empty(KITTI_CLASSES), [Detections2D.empty(KITTI_CLASSES)]
    moments = drive(Detectors(Slow("lidar", nothing[0]), Slow("camera", nothing[1])), 3)
    next(moments)
    time.sleep(0.05)  # somebody looks at the first moment; the first frame of the second is under way
    begun = len(started)
    rest = list(moments)
    # one frame to warm up, two of the first moment, one ahead; two networks each
    assert begun == 2 * 4
    assert len(started) == len(ended) == 2 * 7
    assert [sum(item.milliseconds["frame"] > 0 for item in moment.values()) for moment in rest] == [2, 2]


def test_both_lidars_see_the_same_moment(driven):
    for dense, sparse in zip(*driven.values(), strict=True):
        assert 0.2 < len(sparse.frame.points) / len(dense.frame.points) < 0.3
        np.testing.assert_array_equal(dense.frame.labels.boxes, sparse.frame.labels.boxes)
        np.testing.assert_array_equal(dense.camera["left"].boxes, sparse.camera["left"].boxes)


def test_the_same_drive_gives_the_same_boxes(driven):
    again = next(drive(shipped_detectors(), 1))
    for name, item in again.items():
        before = driven[name][0]
        np.testing.assert_array_equal(item.lidar.boxes, before.lidar.boxes)
        np.testing.assert_array_equal(item.camera["left"].boxes, before.camera["left"].boxes)
        np.testing.assert_array_equal(item.fused.detections.boxes, before.fused.detections.boxes)


@pytest.mark.parametrize("lidar", LIDARS)
def test_the_default_beats_the_lidar_alone_and_the_papers_filter(driven, lidar):
    result = measure(driven[lidar])
    assert list(result.metrics) == [LIDAR_ALONE, *VARIANTS]
    best = result.metrics[FULL].mean_ap
    assert all(metrics.mean_ap < best for name, metrics in result.metrics.items() if name != FULL)
    assert set(result.fusion_ms) == set(VARIANTS)
    assert result.frames_per_second > 0


def test_command(tmp_path):
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "d"), "--frames", "2", "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert list(figures) == list(LIDARS)
    for of_lidar in figures.values():
        assert list(of_lidar["variants"]) == [LIDAR_ALONE, *VARIANTS]
        assert {"LiDAR network", "camera network", "fusion", "frame"} <= set(of_lidar["stage_ms"])
    for folder in ("64-beams", "16-beams"):
        names = sorted(p.name for p in (tmp_path / "d" / folder).iterdir())
        assert names == ["000000.png", "000001.png", "drive.gif"]


def test_a_damaged_package_is_one_sentence(monkeypatch, tmp_path):
    from lcf3d.detectors.lidar import kinds

    monkeypatch.setattr(kinds, "MODELS", tmp_path)
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "d")])
    assert result.exit_code != 0
    assert "lcf3d ships no LiDAR network" in str(result.exception)
    assert not (tmp_path / "d").exists()


def test_view_opens_an_animation(monkeypatch, tmp_path):
    opened = []
    monkeypatch.setattr("typer.launch", opened.append)
    assert CliRunner().invoke(app, ["demo", "--out", str(tmp_path), "--frames", "2", "--view"]).exit_code == 0
    assert opened == [str(tmp_path / "16-beams" / "drive.gif")]

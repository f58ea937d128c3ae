import json

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.datasets.drive import read_drive
from lcf3d.demo.drive import FULL, LIDAR_ALONE, VARIANTS, drive, ground_truth, measure, shipped_detectors
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.provenance import Outcome


@pytest.fixture(scope="module")
def driven():
    return list(drive(shipped_detectors(), 8))


def test_ground_truth_has_returns_and_three_classes():
    shipped = read_drive(count=2)[1]
    truth = ground_truth(shipped)
    assert (points_in_boxes(shipped.points, truth.boxes).sum(axis=1) >= 5).all()
    assert set(truth.labels.tolist()) == {0, 1, 2}
    assert len(truth) <= len(shipped.objects.tracks)


def test_both_networks_find_things_and_every_stage_takes_part(driven):
    assert all(len(item.lidar) > 0 and len(item.camera["left"]) > 0 for item in driven)
    outcomes = np.concatenate([item.fused.outcomes for item in driven])
    assert {Outcome.MATCHED, Outcome.RECOVERED} <= set(outcomes.tolist())
    assert all(set(item.milliseconds) == set(driven[0].milliseconds) for item in driven)


def test_the_same_drive_gives_the_same_boxes(driven):
    again = next(drive(shipped_detectors(), 1))
    np.testing.assert_array_equal(again.lidar.boxes, driven[0].lidar.boxes)
    np.testing.assert_array_equal(again.camera["left"].boxes, driven[0].camera["left"].boxes)
    np.testing.assert_array_equal(again.fused.detections.boxes, driven[0].fused.detections.boxes)


def test_fusion_beats_the_lidar_alone(driven):
    result = measure(driven)
    assert list(result.metrics) == [LIDAR_ALONE, *VARIANTS]
    assert result.metrics[FULL].mean_ap > result.metrics[LIDAR_ALONE].mean_ap
    assert set(result.fusion_ms) == set(VARIANTS)
    assert result.frames_per_second > 0


def test_command(tmp_path):
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "d"), "--frames", "2", "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert list(figures["variants"]) == [LIDAR_ALONE, *VARIANTS]
    assert {"LiDAR network", "camera network", "fusion", "frame"} <= set(figures["stage_ms"])
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["000000.png", "000001.png", "drive.gif"]


def test_a_damaged_package_is_one_sentence(monkeypatch, tmp_path):
    from lcf3d.detectors.lidar import kinds

    monkeypatch.setattr(kinds, "MODELS", tmp_path)
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "d")])
    assert result.exit_code != 0
    assert "lcf3d ships no LiDAR network" in str(result.exception)
    assert not (tmp_path / "d").exists()

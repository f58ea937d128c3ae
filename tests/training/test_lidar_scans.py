"""Labels to learn from: which classes count, which are left out, what a bad sample does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import ConfigError, DatasetError
from lcf3d.structures import KITTI_CLASSES
from lcf3d.training.lidar_scans import IGNORED, ScanSource, dataset_scans, labelled_scan, simulated_scans
from lcf3d.training.samples import ScanSample

BOX = [10.0, 0, -1, 4, 2, 1.5, 0]


def sample(names, points_on=None, boxes=None):
    points = np.array([[10, 0, -1, 0.5], [np.nan, 0, 0, 0], [5, 5, -1.7, 0.1]], np.float32)
    n = len(names)
    counts = np.full(n, 9) if points_on is None else np.array(points_on)
    return ScanSample(
        points, np.array([BOX] * n if boxes is None else boxes, float).reshape(-1, 7), np.array(names, str), counts
    )


def test_classes_and_what_is_ignored():
    scan = labelled_scan(sample(["Car", "Van", "Truck", "Person_sitting", "Cyclist", "Misc"]), KITTI_CLASSES)
    # trucks and the like are background
    assert scan.labels.tolist() == [0, 0, IGNORED, 2]
    few = labelled_scan(sample(["Car", "Pedestrian"], [4, 5]), KITTI_CLASSES)
    assert few.labels.tolist() == [IGNORED, 1]
    other = labelled_scan(sample(["car", "pedestrian", "traffic_cone"]), KITTI_CLASSES)
    assert other.labels.tolist() == [0, 1]


def test_bad_samples():
    broken = labelled_scan(sample(["Car", "Car"], boxes=[BOX, [np.nan, *BOX[1:]]]), KITTI_CLASSES)
    assert len(broken.boxes) == 1
    assert np.isfinite(broken.points).all()
    assert len(broken.points) == 2
    nothing = labelled_scan(sample([]), KITTI_CLASSES)
    assert len(nothing.boxes) == len(nothing.labels) == 0
    with pytest.raises(ConfigError, match="no scan to train on"):
        ScanSource(lambda i: nothing, 0, 1.0)


def test_samples_are_read_when_asked_for(tmp_path):
    values = sample(["Car"])
    path = tmp_path / "000000.npz"
    np.savez(path, points=values.points, boxes=values.boxes, names=values.names, points_on=values.points_on)
    source = simulated_scans([path, tmp_path / "missing.npz"], KITTI_CLASSES)
    assert source.read(0).labels.tolist() == [0]
    assert source.part(1, 5).count == 1
    with pytest.raises(ValueError, match="missing"):
        source.part(1, 2).read(0)


@pytest.mark.real
def test_kitti_scans_show_what_the_camera_sees(shared: Path):
    source = dataset_scans(f"kitti:{shared / 'data' / 'kitti'}", "sensor_val", KITTI_CLASSES)
    assert source.turn < 1
    scan = source.read(0)
    assert 10_000 < len(scan.points) < 30_000
    assert (scan.labels >= 0).any()
    with pytest.raises(DatasetError, match="split"):
        dataset_scans(f"kitti:{shared / 'data' / 'kitti'}", "no_such", KITTI_CLASSES)

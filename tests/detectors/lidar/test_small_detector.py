"""The small network around the network: pillar statistics, odd clouds, names on the command line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.presets import COMPACT_KITTI
from lcf3d.detectors.lidar.statistics import FEATURES, OWN, QUARTERS, SLICES, pillar_statistics
from lcf3d.errors import ConfigError, DetectorError, ShapeError

AREA = (0.0, -10.24, -3.0, 20.48, 10.24, 1.0)
CONFIG = replace(COMPACT_KITTI, voxels=replace(COMPACT_KITTI.voxels, area=AREA))


def test_statistics_of_one_pillar():
    # the pillar from 0.32 to 0.64 along x and 0 to 0.32 along y; its centre is (0.48, 0.16)
    points = np.array([[0.40, 0.08, -1.0, 0.2], [0.56, 0.24, 0.0, 0.6], [0.56, 0.24, -2.0, 0.1]], np.float32)
    features, cells = pillar_statistics(points, CONFIG.voxels)
    assert features.shape == (1, FEATURES)
    assert cells.tolist() == [32 * 64 + 1]
    own = features[0, :OWN]
    np.testing.assert_allclose(own[0], np.log1p(3))
    np.testing.assert_allclose(own[1:3], [(-0.5 + 0.5 + 0.5) / 3] * 2, atol=1e-5)
    np.testing.assert_allclose(own[3:7], [0, -1, 1, np.sqrt(2 / 3)], atol=1e-5)
    np.testing.assert_allclose(own[7:9], [0.3, 0.6], atol=1e-6)
    np.testing.assert_allclose(own[9:12] * 70, [np.hypot(0.48, 0.16), 0.48, 0.16], atol=1e-4)
    np.testing.assert_allclose(own[12:14], [np.std([-0.5, 0.5, 0.5])] * 2, atol=1e-5)
    assert own[14] > 0.9
    quarters = features[0, OWN : OWN + 4 * QUARTERS].reshape(QUARTERS, 4)
    np.testing.assert_allclose(quarters[0], [np.log1p(1), 0, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(quarters[3], [np.log1p(2), 0, 1, 0.35], atol=1e-6)
    assert (quarters[1:3] == 0).all()
    slices = features[0, -SLICES:]
    np.testing.assert_allclose(slices[[2, 4, 6]], np.log1p(1))
    assert slices.sum() == pytest.approx(3 * np.log1p(1))


def test_order_of_points_does_not_matter():
    generator = np.random.default_rng(0)
    points = generator.uniform((0, -10, -3, 0), (20, 10, 1, 1), (500, 4)).astype(np.float32)
    features, cells = pillar_statistics(points, CONFIG.voxels)
    again, cells_again = pillar_statistics(points[::-1], CONFIG.voxels)
    assert len(np.unique(cells)) == len(cells)
    order, order_again = np.argsort(cells), np.argsort(cells_again)
    np.testing.assert_array_equal(cells[order], cells_again[order_again])
    np.testing.assert_allclose(features[order], again[order_again], atol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_points_that_are_no_points_are_left_out(bad):
    good = np.array([[5.0, 1, -1, 0.5]], np.float32)
    for column in range(4):
        if column == 3 and bad == 1e30:
            continue
        odd = good.copy()
        odd[0, column] = bad
        assert len(pillar_statistics(odd, CONFIG.voxels)[1]) == 0
        features, cells = pillar_statistics(np.concatenate([odd, good]), CONFIG.voxels)
        assert len(cells) == 1
        assert np.isfinite(features).all()


def test_shapes_and_types_of_clouds():
    assert pillar_statistics(np.zeros((0, 4), np.float32), CONFIG.voxels)[0].shape == (0, FEATURES)
    cloud = np.random.default_rng(1).uniform(0, 5, (20, 6))
    cloud[:, 2] = -1
    expected = pillar_statistics(cloud[:, :4].astype(np.float32), CONFIG.voxels)
    for points in (cloud, cloud.astype(np.float32), np.asfortranarray(cloud)):
        np.testing.assert_allclose(pillar_statistics(points, CONFIG.voxels)[0], expected[0], rtol=1e-5)
    with pytest.raises(ShapeError, match="4 or more"):
        pillar_statistics(cloud[:, :3], CONFIG.voxels)


def test_the_configuration_travels():
    assert LidarConfig.from_dict(CONFIG.to_dict()) == CONFIG
    assert not CONFIG.has_velocity
    # files written before these settings existed
    old = CONFIG.to_dict()
    del old["encoding"], old["centers"]["velocity"]
    assert LidarConfig.from_dict(old).encoding == "points"
    with pytest.raises(ConfigError, match="not a LiDAR network configuration"):
        LidarConfig.from_dict({"name": "x"})


def test_the_exported_network_is_the_same(tmp_path):
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from lcf3d.detectors.lidar import CompactPillars, OnnxLidarDetector, export_onnx
    from lcf3d.detectors.lidar.fusing import fuse_batch_norm

    torch.manual_seed(0)
    network = CompactPillars.build(CONFIG).eval()
    for module in network.modules():
        if isinstance(module, (torch.nn.BatchNorm1d, torch.nn.BatchNorm2d)):
            module.running_var.uniform_(0.5, 2)
    detector = CompactPillars(fuse_batch_norm(network), CONFIG, nms="off", score_threshold=0.0)
    export_onnx(detector, tmp_path / "network.onnx")
    exported = OnnxLidarDetector(tmp_path / "network.onnx", nms="off", score_threshold=0.0, threads=1)
    assert exported.config == CONFIG
    generator = np.random.default_rng(2)
    for count in (1, 700):
        points = generator.uniform((0, -10, -2, 0), (20, 10, 0.5, 1), (count, 4)).astype(np.float32)
        found, wanted = exported(points), detector(points)
        assert 0 < len(found) <= CONFIG.suppression.candidates
        np.testing.assert_allclose(np.sort(found.scores), np.sort(wanted.scores), atol=1e-5)
        assert found.velocities is None
    for nothing in (np.zeros((0, 4), np.float32), np.full((5, 4), 500, np.float32)):
        assert len(exported(nothing)) == len(detector(nothing)) == 0
    with pytest.raises(ConfigError, match="score_threshold"):
        OnnxLidarDetector(tmp_path / "network.onnx", score_threshold=2.0)


def test_names_of_shipped_networks():
    from lcf3d.detectors.lidar.kinds import shipped

    with pytest.raises(DetectorError, match="ships no LiDAR network 'mars'"):
        shipped("mars")

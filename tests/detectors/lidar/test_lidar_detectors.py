"""What a user can give a LiDAR detector: empty, distant, broken clouds; modes of suppression; sweeps."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.lidar import (  # noqa: E402
    PVRCNN,
    SECOND,
    SSN,
    CenterPoint,
    PartA2,
    PointPillars,
    Sweep,
    accumulate_sweeps,
)
from lcf3d.detectors.lidar.config import LidarConfig, VoxelSpec  # noqa: E402
from lcf3d.detectors.lidar.decoding import best, decode_residuals, turn_by_direction  # noqa: E402
from lcf3d.detectors.lidar.presets import PRESETS  # noqa: E402
from lcf3d.detectors.lidar.suppression import bev_nms, suppression_threshold  # noqa: E402
from lcf3d.detectors.lidar.voxelization import decorate, in_area, voxelize  # noqa: E402
from lcf3d.errors import ConfigError, ShapeError  # noqa: E402

ALL = {
    "pointpillars-kitti": PointPillars,
    "pointpillars-nuscenes": PointPillars,
    "ssn-regnet-nuscenes": SSN,
    "centerpoint-pillar02-nuscenes": CenterPoint,
    "centerpoint-voxel01-nuscenes": CenterPoint,
    "second-kitti": SECOND,
    "part-a2-kitti": PartA2,
    "pv-rcnn-kitti": PVRCNN,
}


@pytest.fixture(scope="module")
def small():
    """PointPillars on a small area, with random weights."""
    config = PRESETS["pointpillars-kitti"].to_dict()
    config["voxels"].update(area=(0.0, -5.12, -3.0, 10.24, 5.12, 1.0))
    config["anchors"].update(area=(0.0, -5.12, 10.24, 5.12))
    config["suppression"].update(candidates=300, max_boxes=900)
    torch.manual_seed(0)
    small_config = LidarConfig.from_dict(config)
    return PointPillars.build(small_config), small_config


@pytest.fixture
def points():
    return np.random.default_rng(1).uniform((0, -5, -2, 0), (10, 5, 0, 1), (300, 4)).astype(np.float32)


@pytest.mark.parametrize("preset", list(ALL))
def test_clouds_without_a_point_in_range_give_no_detections(preset):
    # no point reaches the network: it needs no weights
    with torch.device("meta"):
        detector = ALL[preset](ALL[preset].build(PRESETS[preset]).to_empty(device="cpu"), PRESETS[preset])
    clouds = [np.zeros((0, 4)), np.full((9, 5), np.nan), np.full((3, 4), 900.0), np.full((2, 6), np.inf)]
    for cloud in clouds:
        cloud[:, 4:] = 0
        found = detector(cloud.astype(np.float32))
        assert len(found) == 0
        assert (found.velocities is not None) == preset.endswith("nuscenes")


def test_too_few_columns(small):
    detector = PointPillars(*small)
    with pytest.raises(ShapeError, match=r"\(N, 4 or more\).*got \(5, 3\)"):
        detector(np.zeros((5, 3), np.float32))


def test_a_ring_index_is_not_taken_for_a_time(points):
    config = PRESETS["centerpoint-pillar02-nuscenes"]
    with torch.device("meta"):
        detector = CenterPoint(CenterPoint.build(config).to_empty(device="cpu"), config)
    rings = np.concatenate([points, np.full((len(points), 1), 31.0)], axis=1)
    with pytest.raises(ShapeError, match="time lag in seconds"):
        detector(rings)


def test_unknown_settings(small):
    with pytest.raises(ConfigError, match="nms must be one of off, low, keep"):
        PointPillars(*small, nms="none")
    with pytest.raises(ConfigError, match="score_threshold"):
        PointPillars(*small, score_threshold=1.5)


def test_nan_points_are_left_out(small, points):
    detector = PointPillars(*small, score_threshold=0.0)
    broken = np.concatenate([points, np.full((5, 4), np.nan, np.float32)])
    np.testing.assert_array_equal(detector(broken).boxes, detector(points).boxes)


def test_suppression_modes_are_ordered(small, points):
    counts = [len(PointPillars(*small, nms=mode, score_threshold=0.0)(points)) for mode in ("keep", "low", "off")]
    assert counts[0] < counts[1] <= counts[2]
    assert [suppression_threshold(mode, 0.2) for mode in ("keep", "low", "off")] == [0.2, 0.7, 1.0]


def test_more_candidates_on_request(small, points):
    few = PointPillars(*small, nms="off", score_threshold=0.0, candidates=5)(points)
    best = PointPillars(*small, nms="off", score_threshold=0.0)(points)
    assert few.scores.max() == best.scores.max()
    # each candidate may come out once a class
    assert len(few) == 15
    assert len({tuple(box[:3]) for box in few.boxes}) <= 5
    with pytest.raises(ConfigError, match="candidates must be at least 1"):
        PointPillars(*small, candidates=0)
    regions = PRESETS["pv-rcnn-kitti"].with_candidates(200)
    assert (regions.proposals.max_boxes, regions.proposals.candidates) == (200, 1024)
    assert PRESETS["centerpoint-voxel01-nuscenes"].with_candidates(700).centers.max_candidates == 700


def test_voxels_keep_the_first_points_and_the_first_voxels():
    spec = VoxelSpec((1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 4.0, 4.0, 1.0), max_points=2, max_voxels=2)
    points = np.array(
        [[3.5, 0.5, 0.5, 1], [0.5, 0.5, 0.5, 2], [3.1, 0.5, 0.5, 3], [1.5, 1.5, 0.5, 4], [3.2, 0.5, 0.5, 5]],
        np.float32,
    )
    voxels = voxelize(points, spec)
    assert voxels.coordinates.tolist() == [[0, 0, 3], [0, 0, 0]]
    assert voxels.points[:, 3].tolist() == [1, 3, 2]
    np.testing.assert_allclose(voxels.means()[:, 0], [3.3, 0.5], rtol=1e-6)
    decorated = decorate(voxels, spec, offsets_replace_position=False)
    np.testing.assert_allclose(decorated[0], [3.5, 0.5, 0.5, 1, 0.2, 0, 0, 0, 0, 0], atol=1e-6)
    replaced = decorate(voxels, spec, offsets_replace_position=True)
    np.testing.assert_allclose(replaced[1], [-0.4, 0, 0, 3, -0.2, 0, 0, -0.4, 0, 0], atol=1e-6)


def test_the_range_is_open():
    points = np.array([[0, 0, 0, 1], [1, 1, 1, 1], [0.5, 0.5, 0.5, 1]], np.float32)
    assert in_area(points, (0, 0, 0, 1, 1, 1)).tolist() == [[0.5, 0.5, 0.5, 1]]


def test_decoding_by_hand():
    anchors = np.array([[10.0, 5, -1, 3, 4, 2, 0]])
    residuals = np.array([[0.2, -0.1, 0.5, np.log(2), 0, np.log(1.5), 0.3]])
    # diagonal 5; centre z = -1 + 1 + 0.5 * 2 = 1; height 3, so the bottom is at -0.5
    np.testing.assert_allclose(decode_residuals(anchors, residuals)[0], [11, 4.5, -0.5, 6, 4, 3, 0.3])


@pytest.mark.parametrize(("bin", "expected"), [(0, 0.3), (1, 0.3 - np.pi)])
def test_direction_bins(bin, expected):
    # KITTI: bin 0 holds headings from -pi/2 to pi/2
    turned = turn_by_direction(np.array([0.3]), np.array([bin]), -np.pi / 2)
    assert np.cos(turned[0] - expected) == pytest.approx(1)


def test_best_takes_the_first_of_equal_values():
    assert best(np.array([1.0, 3, 2, 3, 2, 0]), 3).tolist() == [1, 3, 2]
    assert best(np.array([1.0, 2]), 5).tolist() == [1, 0]


def test_suppression_by_hand():
    boxes = np.array([[0.0, 0, 0, 4, 2, 1, 0], [1, 0, 0, 4, 2, 1, 0], [0, 0, 0, 4, 2, 1, np.pi / 2]])
    scores = np.array([0.5, 0.9, 0.7])
    # overlaps: 0-1 6/10, 0-2 4/12, 1-2 4/12
    assert bev_nms(boxes, scores, 0.5).tolist() == [1, 2]
    assert bev_nms(boxes, scores, 0.3).tolist() == [1]
    assert bev_nms(boxes, scores, 1.0).tolist() == [1, 2, 0]


def test_sweeps_are_moved_timed_and_cleared_of_the_vehicle(points):
    move = np.eye(4)
    move[:3, 3] = (10, 0, 1)
    sweep = Sweep(np.array([[5.0, 0, 0, 7, 3], [0.5, -0.5, 0, 7, 3]]), move, 0.05)
    joined = accumulate_sweeps(points, [sweep])
    assert joined.shape == (len(points) + 1, 5)
    np.testing.assert_allclose(joined[-1], [15, 0, 1, 7, 0.05])
    assert (joined[:-1, 4] == 0).all()
    with pytest.raises(ShapeError, match=r"\(4, 4\)"):
        accumulate_sweeps(points, [Sweep(points, np.eye(3), 0.1)])


def test_a_configuration_survives_json():
    import json

    for config in PRESETS.values():
        assert LidarConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    with pytest.raises(ConfigError, match="not a LiDAR network configuration"):
        LidarConfig.from_dict({"name": "x"})

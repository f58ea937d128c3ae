from itertools import pairwise

import numpy as np
import pytest

from lcf3d.errors import FormatError
from lcf3d.frame import Frame
from lcf3d.fusion.clocs import FARTHEST_M, WIDTHS, ClocsFusion, ClocsNetwork, Pairs, ScoreScale, find_pairs
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D
from tests.evaluation.drive import VIEW

SCALE = ScoreScale("identity", 1.0, 2.0)
# 3-4-5 triangle: 40 m and 30 m away is 50 m
BOXES = np.array([[20.0, 0, -0.9, 4, 1.7, 1.5, 0], [40.0, 30, -0.9, 4, 1.7, 1.5, 0], [20.0, 5, -0.9, 4, 1.7, 1.5, 0]])
LIDAR = Detections3D(BOXES, np.array([3.0, 1.0, -1.0]), [0, 0, 0], KITTI_CLASSES)
FRAME = Frame("0", cameras=(VIEW,))


def network(seed=0):
    rng = np.random.default_rng(seed)
    sizes = list(pairwise(WIDTHS))
    return ClocsNetwork(
        tuple(rng.normal(0, 0.5, size) for size in sizes), tuple(rng.normal(0, 0.5, size[1]) for size in sizes), SCALE
    )


def test_pairs_hold_overlap_both_scores_and_distance():
    projected, _ = project_boxes(BOXES[:1], VIEW)
    x1, y1, x2, y2 = projected[0]
    # the lower half of the car, and a pedestrian on the same spot, who is no partner of a car
    half = [x1, (y1 + y2) / 2, x2, y2]
    camera = Detections2D(np.array([half, projected[0]]), np.array([0.8, 0.9]), [0, 1], KITTI_CLASSES)
    pairs = find_pairs(FRAME, LIDAR, {"left": camera}, SCALE)
    order = np.argsort(pairs.candidate)
    assert pairs.candidate[order].tolist() == [0, 1, 2]
    np.testing.assert_allclose(
        pairs.features[order],
        [
            [0.5, 0.8, 1.0, 20 / FARTHEST_M],
            [-1, -1, 0.0, 50 / FARTHEST_M],
            [-1, -1, -1.0, np.hypot(20, 5) / FARTHEST_M],
        ],
        atol=1e-9,
    )


def test_without_a_camera_every_candidate_stands_alone():
    pairs = find_pairs(FRAME, LIDAR, {}, SCALE)
    assert pairs.candidate.tolist() == [0, 1, 2]
    assert (pairs.features[:, :2] == -1).all()
    assert len(find_pairs(FRAME, LIDAR[np.zeros(0, int)], {}, SCALE).candidate) == 0


def test_the_network_is_four_convolutions_and_the_highest_pair():
    one = network()
    rng = np.random.default_rng(1)
    pairs = Pairs(rng.normal(size=(5, 4)), np.array([0, 0, 1, 1, 1]))
    expected = []
    for features in pairs.features:
        x = features
        for layer in range(4):
            x = [
                sum(x[i] * one.weights[layer][i, o] for i in range(len(x))) + b for o, b in enumerate(one.biases[layer])
            ]
            x = x if layer == 3 else [max(0.0, v) for v in x]
        expected.append(x[0])
    np.testing.assert_allclose(one.outputs(pairs, 2), [max(expected[:2]), max(expected[2:])])
    np.testing.assert_allclose(one.scores(pairs, 2), 1 / (1 + np.exp(-one.outputs(pairs, 2))))


def test_boxes_and_labels_stay_and_classes_without_a_network_keep_their_scores():
    mixed = Detections3D(BOXES, np.array([3.0, 1.0, -1.0]), [0, 1, 0], KITTI_CLASSES)
    fused = ClocsFusion({"Car": network()})(FRAME, mixed, {})
    np.testing.assert_array_equal(fused.boxes, mixed.boxes)
    np.testing.assert_array_equal(fused.labels, mixed.labels)
    assert fused.scores[1] == 1.0
    assert ((fused.scores[[0, 2]] > 0) & (fused.scores[[0, 2]] < 1)).all()


def test_networks_are_written_and_read(tmp_path):
    fusion = ClocsFusion({"Car": network()})
    fusion.dump(tmp_path / "clocs.json")
    again = ClocsFusion.load(tmp_path / "clocs.json")
    np.testing.assert_array_equal(again(FRAME, LIDAR, {}).scores, fusion(FRAME, LIDAR, {}).scores)
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(FormatError, match="holds no CLOCs networks"):
        ClocsFusion.load(tmp_path / "other.json")
    text = (tmp_path / "clocs.json").read_text()
    (tmp_path / "clocs.json").write_text(text.replace('"biases"', '"bias"'))
    with pytest.raises(FormatError, match="damaged"):
        ClocsFusion.load(tmp_path / "clocs.json")

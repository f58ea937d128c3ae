from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.detectors.camera.tiling import merge_tiles, non_maximum_suppression, tile_spans, whole_in_tile
from lcf3d.errors import ConfigError
from lcf3d.structures import Detections2D, InstanceMask


def test_suppression_by_hand() -> None:
    # IoU of the first two is 80 / 120 = 2/3
    boxes = np.array([[0, 0, 10, 10], [2, 0, 12, 10], [2, 0, 12, 10], [50, 0, 60, 10]], dtype=float)
    scores, labels = np.array([0.8, 0.9, 0.7, 0.1]), np.array([0, 0, 1, 0])
    assert non_maximum_suppression(boxes, scores, labels, 0.6).tolist() == [1, 2, 3]
    assert non_maximum_suppression(boxes, scores, labels, 0.7).tolist() == [1, 0, 2, 3]
    assert non_maximum_suppression(boxes[:0], scores[:0], labels[:0], 0.6).tolist() == []


def test_suppression_agrees_with_torchvision() -> None:
    torch = pytest.importorskip("torch")
    ops = pytest.importorskip("torchvision.ops")
    rng = np.random.default_rng(4)
    for _ in range(20):
        corners = rng.uniform(0, 100, (200, 2))
        boxes = np.concatenate([corners, corners + rng.uniform(5, 60, (200, 2))], axis=1)
        scores, labels = rng.permutation(200) / 200, rng.integers(0, 3, 200)
        expected = ops.batched_nms(*map(torch.from_numpy, (boxes, scores, labels)), iou_threshold=0.5)
        assert non_maximum_suppression(boxes, scores, labels, 0.5).tolist() == expected.tolist()


@given(st.integers(1, 4000), st.integers(1, 8))
def test_tiles_cover_the_image(width: int, tiles: int) -> None:
    spans = tile_spans(width, tiles)
    assert len(spans) == tiles
    assert (spans[0][0], spans[-1][1]) == (0, width)
    assert len({stop - start for start, stop in spans}) == 1
    assert all(later[0] <= earlier[1] for earlier, later in pairwise(spans))


def test_two_tiles_of_a_kitti_image() -> None:
    # 1242 / 1.8 = 690: 138 columns, a fifth of a tile, are in both
    assert tile_spans(1242, 2) == [(0, 690), (552, 1242)]
    with pytest.raises(ConfigError, match="tiles must be 1 or more"):
        tile_spans(100, 0)


def test_boxes_at_an_inner_border_may_be_cut() -> None:
    boxes = np.array([[0, 0, 50, 9], [600, 0, 689, 9], [552, 0, 600, 9], [1200, 0, 1242, 9]], dtype=float)
    assert whole_in_tile(boxes, (0, 690), 1242).tolist() == [True, False, True, False]
    assert whole_in_tile(boxes, (552, 1242), 1242).tolist() == [False, True, False, True]


def test_merging_takes_the_whole_box_and_shifts_masks(detections_2d: Callable[..., Detections2D]) -> None:
    names = ("car",)
    whole = detections_2d([("car", 0.5, [540, 10, 720, 90])], names)
    left = detections_2d([("car", 0.9, [540, 10, 690, 90])], names)  # cut by the tile's right border
    mask = InstanceMask(10, 5, np.ones((3, 4), dtype=bool))
    found = detections_2d([("car", 0.8, [100, 10, 130, 30])], names)
    right = Detections2D(found.boxes, found.scores, found.labels, names, (mask,))
    merged = merge_tiles(whole, [left, right], [(0, 690), (552, 1242)], 1242, 0.6)
    assert merged.boxes.tolist() == [[652, 10, 682, 30], [540, 10, 720, 90]]
    assert merged.scores.tolist() == [0.8, 0.5]
    assert merged.masks is not None
    assert merged.masks[0] is not None
    assert (merged.masks[0].x, merged.masks[0].y) == (562, 5)
    assert merged.masks[1] is None

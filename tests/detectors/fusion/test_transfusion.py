"""The query head, by hand."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.fusion.transfusion import cell_centers, decode_queries, local_maxima, select  # noqa: E402


def test_local_maxima():
    heat = torch.full((1, 10, 5, 5), 0.1)
    heat[0, 0, 2, 2] = 0.9
    heat[0, 0, 2, 3] = 0.8
    heat[0, 0, 0, 0] = 0.95
    heat[0, 8, 0, 0] = 0.7
    peaks = local_maxima(heat)
    assert peaks[0, 0, 2, 2] == pytest.approx(0.9)
    # a lower neighbour goes, and so does the border
    assert peaks[0, 0, 2, 3] == 0
    assert peaks[0, 0, 0, 0] == 0
    # but all cells of pedestrians stay
    assert torch.equal(peaks[0, 8], heat[0, 8])


def test_selection_is_best_first_over_all_classes():
    peaks = torch.zeros(1, 10, 20, 20)
    peaks[0, 3, 5, 6] = 0.5
    peaks[0, 9, 0, 1] = 0.9
    chosen = select(peaks)
    assert len(chosen) == 200
    assert chosen[:2].tolist() == [9 * 400 + 1, 3 * 400 + 5 * 20 + 6]
    assert cell_centers(20, 20)[5 * 20 + 6].tolist() == [5.5, 6.5]


def test_boxes_by_hand():
    values = {
        "label": np.array([0, 8, 0, 0]),
        "score": np.array([0.5, 1.0, 0.5, 0.0]),
        "heatmap": np.zeros((4, 10)),
        # cells of 0.6 m from -54 m
        "center": np.array([[100.0, 80.0], [90.0, 90.0], [500.0, 0.0], [90.0, 90.0]]),
        "height": np.array([[1.0], [0.0], [0.0], [0.0]]),
        "dim": np.log(np.array([[4.0, 2.0, 1.5], [0.6, 0.6, 1.8], [1, 1, 1], [1, 1, 1]])),
        "rot": np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0]]),
        "vel": np.array([[3.0, -1.0], [0, 0], [0, 0], [0, 0]]),
    }
    values["heatmap"][1, 8] = np.log(3.0)
    boxes, scores, labels = decode_queries(values)
    # the third lies outside the area, the fourth has no peak
    np.testing.assert_allclose(
        boxes, [[6, -6, 0.25, 4, 2, 1.5, np.pi / 2, 3, -1], [0, 0, -0.9, 0.6, 0.6, 1.8, 0, 0, 0]], atol=1e-12
    )
    np.testing.assert_allclose(scores, [0.25, 0.75])
    assert labels.tolist() == [0, 8]
    assert len(decode_queries(values, 0.5)[0]) == 1

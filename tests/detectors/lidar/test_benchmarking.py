"""The cost table: every number is there and plausible, and operations are counted right."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from lcf3d.detectors.lidar import benchmark  # noqa: E402
from lcf3d.detectors.lidar.benchmarking import example_scan  # noqa: E402
from lcf3d.errors import ConfigError  # noqa: E402


def test_pointpillars_on_both_runtimes():
    scan = example_scan()
    costs = benchmark(["pointpillars-kitti"], scan, repeats=1)
    assert [cost.runtime for cost in costs] == ["torch", "onnxruntime"]
    for cost in costs:
        assert cost.milliseconds > 0
        assert cost.points < len(scan)
        # folding the normalization adds a bias to every layer; the published network has 4.84 million numbers
        assert cost.parameters == pytest.approx(4.83, abs=0.01)
        assert cost.to_dict()["device"] == "cpu"
    # by hand: 2 operations a product, over the maps of 248 x 216, 124 x 108 and 62 x 54 cells
    cells = 248 * 216
    blocks = (9 * 64 * 64 * 4) * cells + (9 * 64 * 128 + 9 * 128 * 128 * 5) * cells / 4
    blocks += (9 * 128 * 256 + 9 * 256 * 256 * 5) * cells / 16
    neck = (64 * 128 + 128 * 128 + 256 * 128) * cells
    head = 384 * (18 + 42 + 12) * cells
    points = 10 * 64 * (costs[0].points + 1)
    assert costs[0].gflops == pytest.approx(2e-9 * (blocks + neck + head + points), rel=0.01)


def test_bad_requests():
    with pytest.raises(ConfigError, match="unknown detector 'yolo'"):
        benchmark(["yolo"])
    with pytest.raises(ConfigError, match="no point in the range"):
        benchmark(["pointpillars-kitti"], np.full((3, 4), -500.0, np.float32))

"""Exported pillar networks against torch, with random weights on small areas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from lcf3d.detectors.lidar import SECOND, SSN, CenterPoint, OnnxLidarDetector, PointPillars, export_onnx  # noqa: E402
from lcf3d.detectors.lidar.detector import to_arrays  # noqa: E402
from lcf3d.detectors.lidar.fusing import fuse_batch_norm  # noqa: E402
from lcf3d.detectors.lidar.presets import PRESETS  # noqa: E402
from lcf3d.errors import DetectorError  # noqa: E402

CLASSES = {"pointpillars": PointPillars, "ssn": SSN, "centerpoint": CenterPoint}


def small(preset):
    """A detector of 64 x 64 pillars with random weights and lively normalizations."""
    config = PRESETS[preset]
    half = 32 * config.voxels.size[0]
    area = (-half, -half, config.voxels.area[2], half, half, config.voxels.area[5])
    anchors = config.anchors and replace(config.anchors, area=(-half, -half, half, half))
    config = replace(config, voxels=replace(config.voxels, area=area), anchors=anchors)
    torch.manual_seed(0)
    network = CLASSES[config.architecture].build(config).eval()
    for module in network.modules():
        if isinstance(module, (torch.nn.BatchNorm1d, torch.nn.BatchNorm2d)):
            module.running_var.uniform_(0.5, 2)
            module.running_mean.normal_()
    return CLASSES[config.architecture](fuse_batch_norm(network), config, score_threshold=0.2)


@pytest.mark.parametrize(
    "preset",
    [
        "pointpillars-kitti",
        "pointpillars-nuscenes",
        "ssn-nuscenes",
        "ssn-regnet-nuscenes",
        "centerpoint-pillar02-nuscenes",
    ],
)
def test_the_exported_network_is_the_same(preset, tmp_path):
    detector = small(preset)
    export_onnx(detector, tmp_path / "network.onnx")
    exported = OnnxLidarDetector(tmp_path / "network.onnx", score_threshold=0.2, threads=1)
    assert exported.config == detector.config
    generator = np.random.default_rng(2)
    for count in (40, 900):
        points = generator.uniform((-5, -5, -2, 0, 0), (5, 5, 0.5, 1, 0.4), (count, 5)).astype(np.float32)
        inputs = detector.inputs(points)
        with torch.inference_mode():
            expected = to_arrays(detector.network(**{k: torch.from_numpy(v) for k, v in inputs.items()}))
        for ours, theirs in zip(exported.maps(inputs), expected, strict=True):
            pairs = zip(ours, theirs, strict=True) if isinstance(ours, tuple) else [(ours[k], theirs[k]) for k in ours]
            for a, b in pairs:
                np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * np.abs(b).max())
        found, wanted = exported(points), detector(points)
        assert len(found) == len(wanted) > 0
    assert len(exported(np.zeros((0, 4), np.float32))) == 0


def test_sparse_convolutions_cannot_be_exported(tmp_path):
    with torch.device("meta"):
        network = SECOND.build(PRESETS["second-kitti"]).to_empty(device="cpu")
    with pytest.raises(DetectorError, match="sparse convolutions"):
        export_onnx(SECOND(network, PRESETS["second-kitti"]), tmp_path / "network.onnx")
    assert not list(tmp_path.iterdir())


def test_files_that_are_no_exported_network(tmp_path):
    with pytest.raises(DetectorError, match="does not exist"):
        OnnxLidarDetector(tmp_path / "nothing.onnx")
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(DetectorError, match="cannot be read as an ONNX file"):
        OnnxLidarDetector(tmp_path / "text.onnx")

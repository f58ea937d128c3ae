"""Sessions of networks are sent to other processes."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from lcf3d.detectors.named import load_detector
from lcf3d.errors import DetectorError
from lcf3d.networks.onnx import open_session
from lcf3d.structures import KITTI_CLASSES
from tests.fusion.scenes import car, surface_points


def test_a_detector_that_was_sent_finds_the_same() -> None:
    points = surface_points([car(12, 3), car(22, -4)])
    detector = load_detector("shipped:kitti", "lidar", KITTI_CLASSES)
    one, other = detector(points), pickle.loads(pickle.dumps(detector))(points)
    assert len(one)
    np.testing.assert_array_equal(one.boxes, other.boxes)
    np.testing.assert_array_equal(one.scores, other.scores)


def test_what_is_no_network(tmp_path: Path) -> None:
    (tmp_path / "x.onnx").write_bytes(b"nothing")
    with pytest.raises(DetectorError, match=r"x.onnx cannot be read as an ONNX file"):
        open_session(tmp_path / "x.onnx", 1, "a detector")
    with pytest.raises(DetectorError, match=r"y.onnx does not exist; expected the ONNX file of a detector"):
        open_session(tmp_path / "y.onnx", 1, "a detector")

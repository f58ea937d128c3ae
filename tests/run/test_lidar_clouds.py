"""A run gives a LiDAR detector the cloud it asks for, recovery the scan, and says where a frame lacks something."""

from types import SimpleNamespace

import numpy as np

from lcf3d.detectors.base import CloudRequest
from lcf3d.frame import Frame, Sweep
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.run.frames import FrameRunner
from lcf3d.run.sources import LidarOnScans
from lcf3d.structures import Detections3D

SCAN = np.array([[10.0, 0, 0, 1], [12, 1, 0, 1]], np.float32)


class Detector:
    cloud = CloudRequest(sweeps=2)

    def __call__(self, points):
        self.given = points
        return Detections3D.empty(FusionConfig().class_names or ("car",))


def run(frame):
    detector, written = Detector(), []
    folder = SimpleNamespace(write=lambda frame, fused: written.append((frame, fused)))
    dataset = SimpleNamespace(frame=lambda _: frame)
    runner = FrameRunner(dataset, LidarOnScans(detector), {}, LateCascadeFusion(FusionConfig()), folder)
    summary = runner(frame.id)
    return detector.given, summary.notes, written[0]


def test_sweeps_reach_the_detector_and_the_scan_stays():
    sweeps = [Sweep(SCAN, np.eye(4), 0.05), Sweep(SCAN, np.eye(4), 0.1)]
    given, notes, (frame, fused) = run(Frame("f", SCAN, sweeps=lambda count: sweeps[:count]))
    assert given.shape == (6, 5)
    np.testing.assert_allclose(given[:, 4], [0, 0, 0.05, 0.05, 0.1, 0.1])
    assert frame.points.shape == (2, 4)
    assert not any("sweeps" in note for note in (*notes, *fused.notes))


def test_missing_sweeps_are_noted_on_screen_and_in_the_provenance():
    given, notes, (_, fused) = run(Frame("f", SCAN))
    assert given.shape == (2, 5)
    said = "fewer earlier sweeps than the 2 that the LiDAR detector was trained with"
    assert said in notes
    assert said in fused.notes

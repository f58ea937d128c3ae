"""What stands where a LiDAR branch stands."""

from __future__ import annotations

import numpy as np

from lcf3d.frame import Frame
from lcf3d.run import sources
from lcf3d.structures import Detections3D

EMPTY = Detections3D.empty(("Car",))


class OnFrames:
    def detect_frame(self, frame: Frame) -> Detections3D:
        assert frame.id == "f"
        return EMPTY


def opened(monkeypatch, loaded):
    monkeypatch.setattr(sources, "load_detector", lambda *arguments: loaded)
    return sources.open_lidar("mine:x", None, ("Car",))


def test_a_detector_of_frames_gets_the_whole_frame(monkeypatch):
    source = opened(monkeypatch, OnFrames())
    assert isinstance(source, sources.DetectorOnFrames)
    assert source.detect(Frame("f")) is EMPTY


def test_a_detector_of_points_gets_the_scan(monkeypatch):
    source = opened(monkeypatch, lambda points: EMPTY if len(points) == 1 else None)
    assert isinstance(source, sources.LidarOnScans)
    assert source.detect(Frame("f", np.zeros((1, 4), np.float32))) is EMPTY

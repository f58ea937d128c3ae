"""A camera is believed only on classes that its detector can report."""

from __future__ import annotations

import numpy as np
import pytest

from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D
from tests.datasets.kitti_folder import LABELS, OBJECTS, left_camera


@pytest.mark.parametrize("preset", ["paper", "kitti"])
def test_what_a_detector_cannot_report_is_not_judged_by_it(preset: str) -> None:
    frame = Frame("f", None, [left_camera()])
    lidar = Detections3D(np.array(OBJECTS), np.full(3, 0.73), np.array(LABELS), KITTI_CLASSES)
    nothing = {"left": Detections2D.empty(KITTI_CLASSES)}
    config = FusionConfig.preset(preset).updated(recovery=False)
    judged = LateCascadeFusion(config)(frame, lidar, nothing)
    fused = LateCascadeFusion(config, reports={"left": ("Car",)})(frame, lidar, nothing)
    # the pedestrian, which it cannot report
    assert fused.lidar.reason[2] == Reason.CLASS_NOT_DETECTED
    assert fused.lidar.outcome[2] == Outcome.KEPT
    assert fused.lidar.score[2] == pytest.approx(0.73)
    # the cars, which it can: as if nothing had been said
    assert fused.lidar.reason[:2].tolist() == judged.lidar.reason[:2].tolist()
    assert judged.lidar.reason[2] != Reason.CLASS_NOT_DETECTED


def test_cameras_that_are_not_named_report_all() -> None:
    frame = Frame("f", None, [left_camera()])
    lidar = Detections3D(np.array(OBJECTS), np.full(3, 0.73), np.array(LABELS), KITTI_CLASSES)
    nothing = {"left": Detections2D.empty(KITTI_CLASSES)}
    config = FusionConfig.preset("kitti").updated(recovery=False)
    plain, other = (LateCascadeFusion(config, reports=r)(frame, lidar, nothing) for r in (None, {"right": ()}))
    np.testing.assert_array_equal(plain.lidar.score, other.lidar.score)

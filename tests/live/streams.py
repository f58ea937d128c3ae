"""A street as a stream: a camera and a LiDAR with exact detections, tiny and made up here."""

import numpy as np

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.geometry.camera import project_boxes
from lcf3d.live.fuser import Fuser
from lcf3d.live.messages import CameraBoxes, EgoPose, LidarBoxes
from lcf3d.live.settings import LiveSettings
from lcf3d.live.synchronizer import SyncSettings
from lcf3d.structures import Detections2D, Detections3D
from tests.fusion.scenes import camera

NAMES = ("Car", "Pedestrian", "Cyclist")


def street(i, boxes=4):
    """3D boxes of frame ``i``: cars ahead that come nearer."""
    return np.array([[12 + 8 * k - 0.05 * i, (-1) ** k * (2 + k), -0.8, 4.0, 1.8, 1.6, 0.1 * k] for k in range(boxes)])


def boxes3d(boxes, velocities=None):
    return Detections3D(boxes, np.linspace(0.9, 0.6, len(boxes)), np.zeros(len(boxes), int), NAMES, velocities)


def boxes2d(view, boxes):
    projected, visible = project_boxes(boxes, view)
    return Detections2D(projected[visible], np.full(visible.sum(), 0.8), np.zeros(visible.sum(), int), NAMES)


def stream(frames=10, views=None, period=0.1, delay=0.01, start=0.0):
    """Messages in order of time: for each frame the LiDAR boxes, then those of each camera a little later."""
    for i in range(frames):
        time, boxes = start + i * period, street(i)
        yield LidarBoxes(time, boxes3d(boxes))
        for view in views or [camera()]:
            yield CameraBoxes(time + delay, view.name, boxes2d(view, boxes))


def fusion(**changes):
    return LateCascadeFusion(FusionConfig(recovery=False, **changes))


def fuser(
    views=None, realtime=False, on_result=None, detectors=None, lidar_detector=None, correct=False, watch=None, **sync
):
    values = {"tolerance": 0.04, "deadline": 0.25, "scans": False, **sync}
    settings = LiveSettings(SyncSettings(**values), realtime=realtime, watch=watch, correct=correct)
    return Fuser(
        fusion(),
        [camera()] if views is None else views,
        settings=settings,
        on_result=on_result,
        camera_detectors=detectors,
        lidar_detector=lidar_detector,
    )


def run(target, messages):
    results = [result for message in messages for result in target.push(message)]
    return results + target.flush()


def fingerprint(results):
    """Bytes of everything that must be the same from run to run."""
    return b"".join(
        r.fused.detections.boxes.tobytes()
        + r.fused.detections.scores.tobytes()
        + repr((r.time, r.fused.notes)).encode()
        for r in results
    )


def pose(time, x=0.0):
    transform = np.eye(4)
    transform[0, 3] = x
    return EgoPose(time, transform)

"""Stereo rigs for the fusion tests."""

from dataclasses import replace

import numpy as np

from lcf3d.structures import KITTI_CLASSES, Detections2D
from tests.fusion.scenes import camera

BASELINE = 0.5


def moved(view, right=0.0, down=0.0, name=None):
    """The camera moved by metres along its own axes."""
    transform = np.array(view.camera_from_lidar)
    transform[0, 3] -= right
    transform[1, 3] -= down
    return replace(view, name=name or view.name, camera_from_lidar=transform)


def rig(left="left", right="right", yaw=0.0):
    """A rectified pair, half a metre apart, focal length 500: 250 px of disparity at 1 m."""
    return [camera(left, yaw), moved(camera(left, yaw), right=BASELINE, name=right)]


def boxes2d(boxes, scores=None, labels=None):
    """2D detections of given pixel boxes; scores 0.9 and cars if not given."""
    boxes = np.array(boxes, dtype=float).reshape(-1, 4)
    n = len(boxes)
    return Detections2D(boxes, [0.9] * n if scores is None else scores, labels or [0] * n, KITTI_CLASSES)


def widened(found, factor):
    """The detections with boxes of ``factor`` times the width about the same centre: IoU 1 / factor with before."""
    boxes = found.boxes.copy()
    centre, half = boxes[:, 0::2].mean(axis=1), (boxes[:, 2] - boxes[:, 0]) * factor / 2
    boxes[:, 0], boxes[:, 2] = centre - half, centre + half
    return Detections2D(boxes, found.scores, found.labels, found.class_names)

"""Tiny scenes for the fusion tests: a camera at the LiDAR's origin and boxes whose projections are known."""

import numpy as np

from lcf3d.frame import Frame
from lcf3d.geometry.boxes import box_corners
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D

CAR, PEDESTRIAN, CYCLIST = range(3)

# the method's plain form, in which single steps are easiest to follow: hard filter, probabilistic ensemble
PLAIN = {
    "camera_score_threshold": 0.5,
    "decisive_score": 0.0,
    "lidar_score_threshold": 0.1,
    "class_aware": False,
    "assignment": "gated",
    "unmatched": "drop",
    "ensemble": "probabilistic",
}


def camera(name="left", yaw=0.0, width=1000, height=400, focal=500.0):
    """A camera at the origin, looking along LiDAR x turned by ``yaw``."""
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    transform = np.eye(4)
    transform[:3, :3] = axes @ turn
    projection = np.array([[focal, 0, width / 2, 0], [0, focal, height / 2, 0], [0, 0, 1, 0]])
    return Camera(name, projection, transform, width, height)


def car(x, y=0.0, yaw=0.0, z=-0.8):
    return [x, y, z, 4.0, 1.8, 1.6, yaw]


def pedestrian(x, y=0.0):
    return [x, y, -0.7, 0.6, 0.6, 1.8, 0.0]


def lidar(boxes, scores, labels=None):
    labels = [CAR] * len(boxes) if labels is None else labels
    return Detections3D(np.array(boxes, dtype=float).reshape(-1, 7), scores, labels, KITTI_CLASSES)


def seen(view, boxes, scores, labels=None):
    """2D detections that are exactly the projections of 3D boxes."""
    labels = [CAR] * len(boxes) if labels is None else labels
    projected, visible = project_boxes(np.array(boxes, dtype=float).reshape(-1, 7), view)
    assert visible.all()
    return Detections2D(projected, scores, labels, KITTI_CLASSES)


def surface_points(boxes, per_box=400, seed=0):
    """Points inside each box, as if the object were transparent."""
    rng = np.random.default_rng(seed)
    clouds = []
    for corners in box_corners(np.array(boxes, dtype=float).reshape(-1, 7)):
        t = rng.uniform(0.02, 0.98, (per_box, 3))
        clouds.append(corners[0] + t @ (corners[[1, 3, 4]] - corners[0]))
    xyz = np.concatenate(clouds)
    return np.column_stack([xyz, np.full(len(xyz), 0.5)]).astype(np.float32)


class TrueLocalizer:
    """Knows the objects; gives each proposal the one that most of its points lie in."""

    def __init__(self, boxes):
        self.boxes = np.array(boxes, dtype=float).reshape(-1, 7)
        self.calls = 0

    def __call__(self, proposals):
        from lcf3d.geometry.boxes import points_in_boxes

        self.calls += 1
        chosen = np.empty((len(proposals), 7))
        for k in range(len(proposals)):
            cos, sin = np.cos(proposals.axis_yaw[k]), np.sin(proposals.axis_yaw[k])
            points = proposals.points[proposals.part(k)].astype(float)
            xy = points[:, :2] @ np.array([[cos, sin], [-sin, cos]])
            inside = points_in_boxes(np.column_stack([xy, points[:, 2]]), self.boxes)
            chosen[k] = self.boxes[inside.sum(axis=1).argmax()]
        return proposals.frustum_from_lidar(chosen), np.ones(len(proposals))


def frame(cameras, points=None):
    return Frame("test", points=points, cameras=cameras)

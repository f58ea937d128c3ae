"""Ray-cast scenes with known boxes for the tests of localizers."""

import numpy as np

from lcf3d.fusion.frustum import FrustumProposals, extract_frustums
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D

SENSOR_HEIGHT = 1.73
AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def camera(yaw=0.0):
    """A KITTI-like camera in the LiDAR's place, turned by ``yaw`` about the vertical axis."""
    projection = np.array([[720.0, 0, 620, 0], [0, 720, 187, 0], [0, 0, 1, 0]])
    return Camera("left", projection, AXES @ turn(-yaw), 1240, 375)


def turn(yaw):
    """(4, 4) rotation about the vertical axis."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def standing(x, y, length, width, height, yaw, slope=0.0):
    """(7,) box that stands on the ground, which rises by ``slope`` metres a metre along x."""
    return np.array([x, y, -SENSOR_HEIGHT + slope * x + height / 2, length, width, height, yaw])


def scan(boxes, slope=0.0, noise=0.02, seed=0, keep=1.0):
    """(N, 4) float32 first returns of 64 beams from boxes and ground; ``keep`` is the share of rays that return."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-45, 45, 0.2)), np.radians(np.linspace(-24, 2, 64)))
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    rays = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    with np.errstate(divide="ignore"):
        ground = -SENSOR_HEIGHT / (rays[:, 2] - slope * rays[:, 0])
    nearest = np.where(ground > 0, ground, np.inf)
    for box in boxes:
        nearest = np.minimum(nearest, hit_distance(rays, box))
    returned = (nearest < 90) & (rng.uniform(size=len(rays)) < keep)
    points = rays[returned] * (nearest[returned] + rng.normal(0, noise, returned.sum()))[:, None]
    return np.column_stack([points, np.full(len(points), 0.3)]).astype(np.float32)


def hit_distance(rays, box):
    """(N,) distance at which rays from the origin enter a box, inf where they miss."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    to_box = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    origin, directions = to_box @ -box[:3], rays @ to_box.T
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-box[3:6] / 2 - origin) / directions, (box[3:6] / 2 - origin) / directions
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def propose(points, boxes, labels, view=None, class_names=KITTI_CLASSES, min_points=10, **options) -> FrustumProposals:
    """Frustums of the boxes' exact projections."""
    view = camera() if view is None else view
    projected, visible = project_boxes(np.array(boxes), view)
    assert visible.all()
    found = Detections2D(projected, np.full(len(boxes), 0.9), np.array(labels), class_names, options.pop("masks", None))
    return extract_frustums(points, [view], [found], [np.arange(len(boxes))], min_points=min_points, **options)


def turned_scene(points, boxes, yaw):
    """The points and boxes turned about the vertical axis."""
    turned = points.copy()
    turned[:, :3] = points[:, :3] @ turn(yaw)[:3, :3].T
    return turned, transform_boxes(np.array(boxes), turn(yaw))


def street_proposals(**options):
    """A car, a pedestrian and a cyclist ahead, as proposals."""
    boxes = [standing(15, 2, 4, 1.6, 1.5, 0.3), standing(9, -2.5, 0.8, 0.6, 1.75, 0), standing(12, 6, 1.8, 0.6, 1.7, 1)]
    return propose(scan(boxes), boxes, [0, 1, 2], **options)

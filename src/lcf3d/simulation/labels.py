"""What is labelled in a frame, and how much of it each camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.formats.kitti import KittiObjects
from lcf3d.geometry.boxes import box_corners, kitti_from_lidar, observation_angle, wrap_angle
from lcf3d.geometry.camera import pixels_in_field, project_boxes, project_points
from lcf3d.geometry.lens import NEAR, edges_through_lens
from lcf3d.simulation.actors import KITTI_CLASS, Actor
from lcf3d.simulation.camera import camera_rays
from lcf3d.simulation.presets import KITTI_FOCAL
from lcf3d.simulation.rays import RayTracer
from lcf3d.structures import Camera, FloatArray, IntArray

OCCLUSION_LIMITS: Final = (0.12, 0.50, 0.90)
"""Hidden share of the part inside the image from which an object is partly (1), largely (2), almost (3) hidden."""
MIN_HEIGHT_PX: Final = {"Pedestrian": 26.0, "Person_sitting": 26.0, "Cyclist": 24.0}
"""Objects of a class that are lower than this in the image (others: `MIN_VEHICLE_HEIGHT_PX`) become DontCare."""
MIN_VEHICLE_HEIGHT_PX: Final = 15.5
MIN_LABELLED_PIXELS: Final = 15
MIN_IGNORED_HEIGHT_PX: Final = 10.0
"""What is lower in the image, or has fewer visible pixels than the next number, is not mentioned at all."""
MIN_IGNORED_PIXELS: Final = 40
MAX_HIDDEN: Final = 0.97
"""Objects of which less than this share is hidden are labelled; others become DontCare."""
MAX_DISTANCE_M: Final = 80.0
"""Objects farther away become DontCare."""
NARROW: Final = ("pedestrian",)
"""Kinds whose 2D box KITTI draws narrower than the projected 3D box (0.68 of its width in the median)."""
_RAYS = 1200


@dataclass(frozen=True, eq=False)
class Sightings:
    """How one camera sees A actors.

    Attributes:
        boxes2d: (A, 4) x1, y1, x2, y2 that bound the visible pixels (pixel edges), zeros where none is visible.
        amodal: (A, 4) bounds of the whole object clipped to the image as KITTI draws them, zeros where it is outside:
            those of the projected 3D box, but for people on foot only as wide as their outline.
        pixels: (A,) visible pixels.
        hidden: (A,) share of the part inside the image that something else covers; 1 where nothing is visible.
        truncated: (A,) share of the object outside the image, or behind the camera; 1 where nothing is visible.
    """

    boxes2d: FloatArray
    amodal: FloatArray
    pixels: IntArray
    hidden: FloatArray
    truncated: FloatArray


def sight(
    camera: Camera,
    owner: NDArray[np.int32],
    actors: Sequence[Actor],
    corners: Sequence[NDArray[np.floating]],
    boxes: FloatArray,
    world_from_lidar: FloatArray,
) -> Sightings:
    """Sightings from the (H, W) ``owner`` image of a camera.

    Args:
        camera: which looks.
        owner: id of the actor in each pixel.
        actors: the A actors.
        corners: their (T, 3, 3) world triangles.
        boxes: (A, 7) their boxes in the LiDAR frame.
        world_from_lidar: (4, 4).
    """
    n = len(actors)
    visible = np.zeros((n, 4))
    pixels = np.zeros(n, dtype=np.int64)
    hidden, truncated = np.ones(n), np.ones(n)
    amodal, inside = project_boxes(boxes, camera)
    index = np.full(max([a.id for a in actors], default=0) + 1, -1)
    for k, actor in enumerate(actors):
        index[actor.id] = k
    for k in np.flatnonzero(inside & np.array([a.kind in NARROW for a in actors], dtype=bool)).tolist():
        amodal[k] = _narrowed(amodal[k], corners[k], camera, world_from_lidar)
    rows, columns = np.nonzero(owner)
    whose = index[owner[rows, columns]]
    pixels += np.bincount(whose, minlength=n)[:n]
    for k in np.flatnonzero(pixels).tolist():
        mine = whose == k
        v, u = rows[mine], columns[mine]
        visible[k] = u.min(), v.min(), u.max() + 1, v.max() + 1
    for k in np.flatnonzero(inside & (pixels > 0)).tolist():
        hidden[k], truncated[k] = _coverage(camera, owner, actors[k].id, corners[k], boxes[k], world_from_lidar)
    return Sightings(visible, amodal, pixels, hidden, truncated)


def _narrowed(
    bounds: FloatArray, corners: NDArray[np.floating], camera: Camera, world_from_lidar: FloatArray
) -> FloatArray:
    """``bounds`` (4,) as wide as the outline of (T, 3, 3) world triangles, if all of it is before the camera."""
    points = (corners.reshape(-1, 3) - world_from_lidar[:3, 3]) @ world_from_lidar[:3, :3]
    pixels, depth = project_points(points, camera)
    if (depth < NEAR * 5).any() or np.isnan(pixels).any():
        return bounds
    result = bounds.copy()
    result[[0, 2]] = np.clip([pixels[:, 0].min(), pixels[:, 0].max()], bounds[0], bounds[2])
    return result


def _coverage(
    camera: Camera,
    owner: NDArray[np.int32],
    id: int,
    corners: NDArray[np.floating],
    box: FloatArray,
    world_from_lidar: FloatArray,
) -> tuple[float, float]:
    """(hidden share of the part inside the image, share outside) of one object, by a raster of rays at it alone."""
    around = _unclipped_bounds(box, camera)
    u, v = _raster(around)
    shown = pixels_in_field(np.stack([u, v], axis=1), camera)
    u, v = u[shown], v[shown]
    origin, direction = camera_rays(camera, world_from_lidar, u, v)
    met = RayTracer(corners).first_hits(origin, direction).triangle >= 0
    if not met.any():
        return 1.0, 1.0
    u, v = u[met], v[met]
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    outside = 1.0 - float(inside.mean())
    if not inside.any():
        return 1.0, 1.0
    seen = owner[np.floor(v[inside]).astype(int), np.floor(u[inside]).astype(int)] == id
    return 1.0 - float(seen.mean()), outside


def _unclipped_bounds(box: FloatArray, camera: Camera) -> FloatArray:
    """Bounds of the projected box, at most two image sizes beyond the image."""
    corner = box_corners(box[None])[0]
    limit = np.array([-2.0 * camera.width, -2.0 * camera.height, 3.0 * camera.width, 3.0 * camera.height])
    if camera.distortion is not None:
        bent = edges_through_lens(box[None], camera).reshape(-1, 2)
        bent = bent[~np.isnan(bent[:, 0])]
        return np.concatenate([bent.min(axis=0), bent.max(axis=0)]) if len(bent) else limit
    points = corner @ camera.pixels_from_lidar[:, :3].T + camera.pixels_from_lidar[:, 3]
    if (points[:, 2] < NEAR * 5).any():
        return limit
    pixels = points[:, :2] / points[:, 2:]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    return np.array([max(low[0], limit[0]), max(low[1], limit[1]), min(high[0], limit[2]), min(high[1], limit[3])])


def _raster(bounds: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixel centres over ``bounds``, thinned evenly to about ``_RAYS``."""
    low, high = np.floor(bounds[:2]), np.ceil(bounds[2:])
    size = np.maximum(high - low, 1)
    step = max(1.0, float(np.ceil(np.sqrt(size[0] * size[1] / _RAYS))))
    u, v = np.meshgrid(np.arange(low[0], high[0], step) + 0.5, np.arange(low[1], high[1], step) + 0.5)
    return u.ravel(), v.ravel()


def occlusion_level(hidden: FloatArray) -> IntArray:
    """KITTI's occlusion levels (0 visible to 3 unknown) of hidden shares."""
    return np.digitize(hidden, OCCLUSION_LIMITS).astype(np.int64)


def kitti_objects(
    actors: Sequence[Actor], boxes: FloatArray, sightings: Sightings, points_on: IntArray, camera: Camera
) -> KittiObjects:
    """The label file of a frame, as seen by the left camera; 2D boxes bound the whole object, as KITTI's do.

    An object is labelled when some of it is visible, it is high enough in the image, and a beam met it or it is
    near; what is visible but far, tiny or nearly covered becomes DontCare.

    Args:
        actors: the A actors.
        boxes: (A, 7) their boxes in the LiDAR frame.
        sightings: by the left camera.
        points_on: (A,) LiDAR returns from each.
        camera: the left camera.
    """
    order, count = label_order(actors, boxes, sightings, points_on, camera)
    names = np.array([KITTI_CLASS[a.kind] or "" for a in actors], dtype=np.str_)
    total = len(order)
    locations, dimensions, rotation = (
        kitti_from_lidar(boxes[order], camera.camera_from_lidar)
        if total
        else (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    )
    alpha = wrap_angle(observation_angle(locations, rotation))
    is_ignored = np.arange(total) >= count
    truncated = np.where(is_ignored, -1.0, np.round(sightings.truncated[order], 2))
    occluded = np.where(is_ignored, -1, occlusion_level(sightings.hidden[order]))
    return KittiObjects(
        np.where(is_ignored, "DontCare", names[order]).astype(np.str_),
        truncated,
        occluded.astype(np.int64),
        np.where(is_ignored, -10.0, alpha),
        np.where(is_ignored[:, None], sightings.boxes2d[order], sightings.amodal[order]),
        np.where(is_ignored[:, None], -1.0, dimensions),
        np.where(is_ignored[:, None], -1000.0, locations),
        np.where(is_ignored, -10.0, rotation),
    )


def label_order(
    actors: Sequence[Actor], boxes: FloatArray, sightings: Sightings, points_on: IntArray, camera: Camera
) -> tuple[IntArray, int]:
    """Indices of the actors in a KITTI label file, and how many of them, from the first, are not DontCare.

    Pixel limits hold for KITTI's focal length and grow with that of the camera.
    """
    scale = float(camera.intrinsics[1, 1]) / KITTI_FOCAL
    known = np.array([KITTI_CLASS[a.kind] is not None for a in actors], dtype=bool)
    height = (sightings.boxes2d[:, 3] - sightings.boxes2d[:, 1]) / scale
    pixels = sightings.pixels / scale**2
    distance = np.linalg.norm(boxes[:, :2], axis=1)
    least = np.array([MIN_HEIGHT_PX.get(KITTI_CLASS[a.kind] or "", MIN_VEHICLE_HEIGHT_PX) for a in actors])
    labelled = known & (pixels >= MIN_LABELLED_PIXELS) & (height >= least) & (sightings.hidden < MAX_HIDDEN)
    labelled &= ((points_on > 0) | (distance < 60)) & (distance < MAX_DISTANCE_M)
    ignored = known & (pixels >= MIN_IGNORED_PIXELS) & (height >= MIN_IGNORED_HEIGHT_PX) & ~labelled
    return np.concatenate([np.flatnonzero(labelled), np.flatnonzero(ignored)]), int(labelled.sum())

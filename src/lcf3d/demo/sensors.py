"""A LiDAR and two cameras on that street, by casting rays at cuboids."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lcf3d.demo.street import GROUND_Z, Street
from lcf3d.geometry.boxes import box_corners
from lcf3d.structures import Camera, FloatArray

BEAMS, COLUMNS = 48, 1200
ELEVATION = np.radians(np.linspace(3.0, -22.0, BEAMS))
IMAGE_WIDTH, IMAGE_HEIGHT, FOCAL = 832, 352, 620.0
CAMERA_YAW = np.radians(25.0)  # the two cameras look half left and half right and overlap in the middle
SUN = np.array([0.35, -0.45, 0.82])
RANGE_NOISE_M = 0.015


def cameras() -> tuple[Camera, Camera]:
    """The cameras ``front_left`` and ``front_right``, beside the LiDAR and a little below it."""
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    found = []
    for name, yaw, y in (("front_left", CAMERA_YAW, 0.3), ("front_right", -CAMERA_YAW, -0.3)):
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        transform = np.eye(4)
        transform[:3, :3] = axes @ turn
        transform[:3, 3] = -transform[:3, :3] @ np.array([0.3, y, -0.2])
        projection = np.array(
            [[FOCAL, 0, IMAGE_WIDTH / 2, 0], [0, FOCAL, IMAGE_HEIGHT * 0.45, 0], [0, 0, 1, 0]], dtype=np.float64
        )
        found.append(Camera(name, projection, transform, IMAGE_WIDTH, IMAGE_HEIGHT))
    return found[0], found[1]


@njit(cache=True, nogil=True)
def cast(origin, directions, parts, windows):  # type: ignore[no-untyped-def]
    """First hits of a grid of rays (numba).

    Args:
        origin: (3,) where the rays begin.
        directions: (H, W, 3) their directions.
        parts: (M, 7) cuboids.
        windows: (M, 4) rows and columns (first, last) that each cuboid can cover.

    Returns:
        (H, W) distance in lengths of the direction (inf without a hit), cuboid (-1), and face: 0 to 2 for x, y, z.
    """
    height, width = directions.shape[:2]
    depth = np.full((height, width), np.inf)
    hit = np.full((height, width), -1, np.int64)
    face = np.zeros((height, width), np.int64)
    for m in range(len(parts)):
        cos, sin = np.cos(parts[m, 6]), np.sin(parts[m, 6])
        ox, oy, oz = origin[0] - parts[m, 0], origin[1] - parts[m, 1], origin[2] - parts[m, 2]
        lx, ly = cos * ox + sin * oy, cos * oy - sin * ox
        half = parts[m, 3:6] / 2
        for row in range(windows[m, 0], windows[m, 1] + 1):
            for column in range(windows[m, 2], windows[m, 3] + 1):
                d = directions[row, column % width]
                dx, dy, dz = cos * d[0] + sin * d[1], cos * d[1] - sin * d[0], d[2]
                near, far, side = 0.0, depth[row, column % width], -1
                for axis in range(3):
                    o = lx if axis == 0 else ly if axis == 1 else oz
                    v = dx if axis == 0 else dy if axis == 1 else dz
                    if v == 0.0:
                        if abs(o) > half[axis]:
                            far = -1.0
                        continue
                    a, b = (-half[axis] - o) / v, (half[axis] - o) / v
                    if a > b:
                        a, b = b, a
                    if a > near:
                        near, side = a, axis
                    far = min(far, b)
                if side >= 0 and near < far:
                    depth[row, column % width] = near
                    hit[row, column % width] = m
                    face[row, column % width] = side
    return depth, hit, face


def scan(street: Street, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """(N, 4) float32 points with intensity, and (N,) the thing that each point lies on (-1 for the ground)."""
    azimuth = np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False)
    cos_e, sin_e = np.cos(ELEVATION)[:, None], np.sin(ELEVATION)[:, None]
    directions = np.stack(
        [cos_e * np.cos(azimuth), cos_e * np.sin(azimuth), np.broadcast_to(sin_e, (BEAMS, COLUMNS))], axis=2
    )
    solid = np.flatnonzero(street.owner >= 0)
    parts = street.parts[solid]
    depth, hit, _ = cast(np.zeros(3), np.ascontiguousarray(directions), parts, _scan_windows(parts))
    ground = np.where(directions[..., 2] < 0, GROUND_Z / np.minimum(directions[..., 2], -1e-9), np.inf)
    on_ground = ground < depth
    depth = np.where(on_ground, ground, depth)
    owner = np.where(on_ground | (hit < 0), -1, street.owner[solid][np.maximum(hit, 0)])
    seen = (depth < 75) & (rng.uniform(size=depth.shape) > 0.06)
    distance = depth[seen] + rng.normal(0, RANGE_NOISE_M, int(seen.sum()))
    shade = np.where(owner[seen] < 0, 0.15, 0.2 + 0.5 * rng.uniform(size=len(distance)))
    points = np.column_stack([directions[seen] * distance[:, None], shade]).astype(np.float32)
    return points, owner[seen]


def _scan_windows(parts: FloatArray) -> NDArray[np.int64]:
    """Rows and columns of the scan that each cuboid can cover; columns may run over the seam at the back."""
    corners = box_corners(parts)
    flat = np.hypot(corners[..., 0], corners[..., 1])
    nearest = np.maximum(np.hypot(parts[:, 0], parts[:, 1]) - np.hypot(parts[:, 3], parts[:, 4]) / 2, 0.3)
    high = np.degrees(
        np.arctan2(corners[..., 2].max(axis=1), np.where(corners[..., 2].max(axis=1) > 0, nearest, flat.max(axis=1)))
    )
    low = np.degrees(
        np.arctan2(corners[..., 2].min(axis=1), np.where(corners[..., 2].min(axis=1) < 0, nearest, flat.max(axis=1)))
    )
    elevation = np.degrees(ELEVATION)
    first = np.searchsorted(-elevation, -high)
    last = np.searchsorted(-elevation, -low, side="right") - 1
    middle = np.arctan2(parts[:, 1], parts[:, 0])
    turned = np.angle(np.exp(1j * (np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None])))
    step = 2 * np.pi / COLUMNS
    left = np.floor((middle + turned.min(axis=1) + np.pi) / step).astype(np.int64)
    right = np.ceil((middle + turned.max(axis=1) + np.pi) / step).astype(np.int64)
    return np.stack([first, last, left + COLUMNS, right + COLUMNS], axis=1).astype(np.int64)


def photograph(street: Street, camera: Camera, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """(H, W, 3) RGB image of the street, and (H, W) the thing seen in each pixel (-1 for none)."""
    lidar_from_camera = np.linalg.inv(camera.camera_from_lidar)
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=2) @ np.linalg.inv(camera.intrinsics).T
    directions = np.ascontiguousarray(rays @ lidar_from_camera[:3, :3].T)
    origin = np.ascontiguousarray(lidar_from_camera[:3, 3])
    depth, hit, face = cast(origin, directions, street.parts, _image_windows(street.parts, camera))
    ground = np.where(directions[..., 2] < 0, (GROUND_Z - origin[2]) / np.minimum(directions[..., 2], -1e-9), np.inf)
    first = np.minimum(depth, ground)
    at = origin + directions * np.where(np.isfinite(first), first, 0)[..., None]
    colour = _sky(directions)
    on_ground = np.isfinite(ground) & (ground <= depth)
    colour[on_ground] = _road(at[on_ground], rng)
    solid = np.isfinite(depth) & ~on_ground
    colour[solid] = _lit(street, hit[solid], face[solid], directions[solid], at[solid])
    haze = np.clip(np.where(np.isfinite(first), first, 0) / 160, 0, 0.6)[..., None]
    colour = colour * (1 - haze) + np.array([205, 214, 224]) * haze
    colour += rng.normal(0, 2.5, colour.shape)
    owner = np.where(solid, street.owner[np.maximum(hit, 0)], -1)
    return np.clip(colour, 0, 255).astype(np.uint8), owner


def _image_windows(parts: FloatArray, camera: Camera) -> NDArray[np.int64]:
    """Rows and columns of the image that each cuboid can cover; none (last before first) for those out of view."""
    from lcf3d.geometry.camera import project_boxes

    boxes, visible = project_boxes(parts, camera)
    windows = np.stack(
        [
            np.floor(boxes[:, 1]),
            np.minimum(np.ceil(boxes[:, 3]), camera.height - 1),
            np.floor(boxes[:, 0]),
            np.minimum(np.ceil(boxes[:, 2]), camera.width - 1),
        ],
        axis=1,
    ).astype(np.int64)
    windows[~visible] = [0, -1, 0, -1]
    return windows


def _sky(directions: FloatArray) -> FloatArray:
    height = directions[..., 2] / np.linalg.norm(directions, axis=2)
    blend = np.clip(height * 3.0, 0, 1)[..., None]
    return np.asarray(np.array([214.0, 222, 230]) * (1 - blend) + np.array([120.0, 164, 214]) * blend)


def _road(at: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Asphalt with a broken centre line, pavements and grass, at ground points of the LiDAR frame."""
    x, y = at[:, 0], at[:, 1]
    colour = np.tile([92.0, 92, 94], (len(at), 1))
    pavement = (y < -4.7) | (y > 8.3)
    colour[pavement] = [150, 146, 140]
    colour[(np.abs(y + 4.75) < 0.1) | (np.abs(y - 8.35) < 0.1)] = [176, 174, 168]
    colour[(y < -7.6) | (y > 10.4)] = [104, 124, 78]
    colour[(np.abs(y - 1.8) < 0.09) & (np.mod(x, 6.0) < 3.0)] = [226, 226, 220]
    colour[pavement & (np.mod(x, 1.6) < 0.05)] *= 0.88
    return np.asarray(colour * (1 + rng.normal(0, 0.03, (len(at), 1))))


def _lit(
    street: Street, hit: NDArray[np.int64], face: NDArray[np.int64], rays: FloatArray, at: FloatArray
) -> FloatArray:
    """Colours of hits: sunlight by the face's normal, windows on buildings."""
    yaw = street.parts[hit, 6]
    normal = np.zeros((len(hit), 3))
    cos, sin = np.cos(yaw), np.sin(yaw)
    normal[face == 0] = np.stack([cos, sin, np.zeros_like(cos)], axis=1)[face == 0]
    normal[face == 1] = np.stack([-sin, cos, np.zeros_like(cos)], axis=1)[face == 1]
    normal[face == 2] = [0, 0, 1]
    normal *= -np.sign((normal * rays).sum(axis=1))[:, None]
    light = 0.55 + 0.5 * np.clip(normal @ (SUN / np.linalg.norm(SUN)), 0, None)
    colour = street.colours[hit].copy()
    tall = street.parts[hit, 5] > 8
    pane = tall & (np.mod(at[:, 0], 2.4) < 1.3) & (np.mod(at[:, 2] - GROUND_Z, 3.0) > 1.1) & (face == 1)
    colour[pane] = [84, 100, 118]
    return np.asarray(colour * light[:, None])

"""Two-view geometry of calibrated cameras: fundamental matrix, epipolar lines, depth along them (paper section 4.2.3).

Everything comes from the full projections ``pixels_from_lidar``, so that it holds for any two cameras: turned against
each other, of different focal length, or with a translation column in ``projection`` as KITTI writes it. That of lines
is for pinhole cameras; through a lens they are curves (`curve_distances`).
"""

from __future__ import annotations

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.geometry.camera import pixel_rays, project_points
from lcf3d.structures import Camera, FloatArray

# cameras nearer to each other than this see no parallax worth the name, in metres
MIN_BASELINE = 1e-3


def camera_centre(camera: Camera) -> FloatArray:
    """(3,) where the camera stands, in the LiDAR frame.

    Raises:
        ConfigError: its projection has no centre (a singular left 3 x 3 part).
    """
    matrix = camera.pixels_from_lidar[:, :3]
    # the volume that the rows span, as a share of what rows at right angles would
    if abs(np.linalg.det(matrix)) <= 1e-9 * np.prod(np.linalg.norm(matrix, axis=1)):
        raise ConfigError(
            f"camera {camera.name!r} needs a projection whose left 3 x 3 part is invertible, got a singular one; "
            "check its calibration"
        )
    return np.asarray(-np.linalg.solve(matrix, camera.pixels_from_lidar[:, 3]), dtype=np.float64)


def baseline(left: Camera, right: Camera) -> FloatArray:
    """(3,) where ``right`` stands, in metres along the axes of ``left`` (x right, y down, z forward).

    Raises:
        ConfigError: both stand at the same place: there is no epipolar geometry then.
    """
    between = camera_centre(right) - camera_centre(left)
    length = float(np.linalg.norm(between))
    if length < MIN_BASELINE:
        raise ConfigError(
            f"cameras {left.name!r} and {right.name!r} must stand apart to form a stereo pair, but their calibrations "
            f"put them {length:.4f} m from each other; give each camera its own calibration"
        )
    offset: FloatArray = left.camera_from_lidar[:3, :3] @ between
    return offset


def cross_matrix(vector: FloatArray) -> FloatArray:
    """(3, 3) ``[v]x``, for which ``[v]x @ w`` is the cross product of (3,) ``v`` and ``w``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def infinite_homography(left: Camera, right: Camera) -> FloatArray:
    """(3, 3) map of homogeneous left pixels to the right pixels of the same directions, as of infinitely far points."""
    homography: FloatArray = right.pixels_from_lidar[:, :3] @ np.linalg.inv(left.pixels_from_lidar[:, :3])
    return homography


def epipole(left: Camera, right: Camera) -> FloatArray:
    """(3,) homogeneous right pixel of the left camera's centre."""
    image: FloatArray = right.pixels_from_lidar @ np.append(camera_centre(left), 1.0)
    return image


def fundamental_matrix(left: Camera, right: Camera) -> FloatArray:
    """(3, 3) ``F`` of unit norm with ``right_pixel^T F left_pixel = 0`` for the two images of any point.

    ``F @ left_pixel`` is the epipolar line in the right image. With ``P = K [I | 0]`` this is
    ``K_r^-T [t]x R K_l^-1``, (R, t) from left to right camera coordinates; the paper's equation 9 has the two cameras
    exchanged.

    Raises:
        ConfigError: both cameras stand at the same place, or one has no centre.
    """
    baseline(left, right)
    matrix = cross_matrix(epipole(left, right)) @ infinite_homography(left, right)
    unit: FloatArray = matrix / np.linalg.norm(matrix)
    return unit


def epipolar_lines(fundamental: FloatArray, points: FloatArray) -> FloatArray:
    """(N, 3) lines ``a u + b v + c = 0`` in the right image of (N, 2) left pixels, with ``a^2 + b^2 = 1``.

    NaN for the epipole itself, through which every line passes.
    """
    lines = points @ fundamental[:, :2].T + fundamental[:, 2]
    length = np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    # what rounding leaves of the zero that the epipole gives
    rounding = 1e-12 * np.linalg.norm(fundamental[:2]) * np.linalg.norm(points, axis=1, keepdims=True)
    unit: FloatArray = np.divide(lines, length, out=np.full_like(lines, np.nan), where=length > rounding)
    return unit


def line_distances(lines: FloatArray, points: FloatArray) -> FloatArray:
    """(N, M) pixel distances of (M, 2) pixels to (N, 3) lines whose normals are of unit length."""
    distances: FloatArray = np.abs(lines[:, :2] @ points.T + lines[:, 2:])
    return distances


def inverse_depths(left: Camera, right: Camera, left_points: FloatArray, right_points: FloatArray) -> FloatArray:
    """Inverse depth of N left pixels for each of M right pixels as their other image: disparity, for any pair.

    A point that comes nearer from infinity moves along its epipolar line from `infinite_homography` towards the
    epipole; how far it went gives its depth. Right pixels beside the line count as their foot on it. In a rectified
    pair this is ``(u_left - u_right) / (focal length * baseline)``.

    Args:
        left: camera of ``left_points``.
        right: camera of ``right_points``.
        left_points: (N, 2) pixels.
        right_points: (M, 2) pixels.

    Returns:
        (N, M) in 1 / metre, depth along the left camera's optical axis; 0 for infinity, negative where the rays part
        (the point would lie behind), NaN where the right camera cannot look in a left pixel's direction.
    """
    far = np.append(left_points, np.ones((len(left_points), 1)), axis=1) @ infinite_homography(left, right).T
    near = epipole(left, right)
    with np.errstate(divide="ignore", invalid="ignore"):
        start = far[:, :2] / far[:, 2:]
        motion = near[:2] - start * near[2]
        speed = np.linalg.norm(motion, axis=1)
        way = ((right_points[None] - start[:, None]) * (motion / speed[:, None])[:, None]).sum(axis=-1)
        # pixel(q) = (far + q near) / its third coordinate, solved for q
        inverse = way * far[:, 2:] / (speed[:, None] - way * near[2])
    result: FloatArray = np.where((far[:, 2:] > 0) & (speed[:, None] - way * near[2] > 0), inverse, np.nan)
    return result


def curve_distances(left: Camera, right: Camera, left_points: FloatArray, right_points: FloatArray) -> FloatArray:
    """(N, M) pixel distances of M right pixels to the epipolar curves of N left pixels, for cameras with any lens.

    The plane of a left ray and the baseline cuts the right camera's image in a curve. The foot of a right pixel on it
    is where the right ray's nearest direction in that plane is seen; of a pinhole camera this is as good as the
    distance to the line for pixels near to it.

    Args:
        left: camera of ``left_points``.
        right: camera of ``right_points``.
        left_points: (N, 2) pixels.
        right_points: (M, 2) pixels.

    Returns:
        NaN for a left pixel at the epipole, infinite where the foot lies outside of the right camera's field.
    """
    centre = camera_centre(right)
    along = centre - camera_centre(left)
    rays, others = pixel_rays(left_points, left), pixel_rays(right_points, right)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    others /= np.linalg.norm(others, axis=1, keepdims=True)
    normals = np.cross(rays, along / np.linalg.norm(along))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.full_like(normals, np.nan), where=length > 1e-9)
    off = normals @ others.T
    feet = others[None] - off[..., None] * normals[:, None]
    # as points far along the feet's directions: a metre is as good as any length, the camera's centre is given
    pixels, _ = project_points((centre + feet).reshape(-1, 3), right)
    distances = np.linalg.norm(pixels.reshape(*off.shape, 2) - right_points, axis=-1)
    result: FloatArray = np.where(np.isnan(off), np.nan, np.where(np.isnan(distances), np.inf, distances))
    return result

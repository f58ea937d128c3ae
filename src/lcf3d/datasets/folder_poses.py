"""Which of the likely mistakes explains a pose or axes that cannot be right: an inverse, other axes, another order.

Nothing here changes what is read; `lcf3d.datasets.folder_check` says what it found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.folder_sensors import CAMERA_AXES, CANONICAL_AXES, Sensors, canonical_from_axes
from lcf3d.geometry.boxes import points_in_boxes, transform_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.geometry.rotation import invert_rigid, quaternions_from_matrices, rotation_matrices
from lcf3d.structures import Camera, FloatArray

AXES = (
    CANONICAL_AXES, "right-forward-up", "left-back-up", "back-right-up", "forward-right-down", CAMERA_AXES,
    "back-left-down", "right-back-down",
)  # fmt: skip
"""Axes that sensors and labels come in."""

UPRIGHT = 0.5
"""Least share of a camera's image-up that points up, for cameras on vehicles."""

_NEAR_M = 30.0
_GROUND_BIN_M = 0.2
# ground lies in boxes wherever they stand, and strewn points do too
_LIFT_M, _HELD = 0.3, 3
_DIRECTIONS = ("forward", "left", "up")
_OPPOSITES = ("back", "right", "down")


class Guess(NamedTuple):
    """A pose that may have been meant.

    Attributes:
        words: what the mistake would be and what to write.
        camera_from_lidar: (4, 4) as it would then be.
    """

    words: str
    camera_from_lidar: FloatArray


def pose_guesses(sensors: Sensors, name: str) -> list[Guess]:
    """The likely mistakes in the pose of a camera, the simplest first."""
    setup = sensors.cameras[name]
    key = "ego_from_sensor" if setup.ego_from_sensor is not None else "camera_from_lidar"
    given = np.array(setup.ego_from_sensor if setup.camera_from_lidar is None else setup.camera_from_lidar)
    transposed = given.copy()
    transposed[:3, :3] = given[:3, :3].T
    w, x, y, z = quaternions_from_matrices(given[None, :3, :3])[0]
    reordered = given.copy()
    # the file's four numbers were taken for w, x, y, z
    reordered[:3, :3] = rotation_matrices(np.array([[z, w, x, y]]))[0]
    other = CANONICAL_AXES if setup.axes == CAMERA_AXES else CAMERA_AXES
    forms = [
        (f"{key} is inverted: give the inverse", invert_rigid(given), None),
        (f"its axes are {other}: write 'axes: {other}'", given, other),
        (f"{key} is inverted and its axes are {other}", invert_rigid(given), other),
        (f"the rotation of {key} is transposed", transposed, None),
        ("the quaternion is in the order x, y, z, w: write w first", reordered, None),
    ]
    return [Guess(words, sensors.camera_from_lidar(name, pose, axes)) for words, pose, axes in forms]


def uprightness(camera_from_lidar: FloatArray) -> float:
    """Share of the camera's image-up direction that points up, -1 to 1."""
    return float(-camera_from_lidar[1, 2])


def agreement(
    camera: Camera, pose: FloatArray, boxes: Sequence[FloatArray], image_boxes: Sequence[FloatArray]
) -> float:
    """Mean over 2D boxes of the best image IoU with a projected 3D box of their frame; NaN without 2D boxes.

    Args:
        camera: lens and image.
        pose: (4, 4) ``camera_from_lidar`` to try.
        boxes: (N, 7) 3D boxes of each frame, LiDAR frame.
        image_boxes: (M, 4) 2D boxes of each frame.
    """
    tried = replace(camera, camera_from_lidar=pose)
    best: list[float] = []
    for found, seen in zip(boxes, image_boxes, strict=True):
        if not len(seen) or not len(found):
            continue
        projected, visible = project_boxes(found, tried)
        overlaps = image_iou(seen, projected[visible]) if visible.any() else np.zeros((len(seen), 1))
        best += overlaps.max(axis=1).tolist()
    return float(np.mean(best)) if best else float("nan")


def filled_share(points: Sequence[NDArray[np.float32]], boxes: Sequence[FloatArray]) -> float:
    """Share of near boxes that hold some points of their frame's scan above the ground; NaN without near boxes."""
    held: list[float] = []
    for cloud, found in zip(points, boxes, strict=True):
        near = found[np.hypot(found[:, 0], found[:, 1]) < _NEAR_M]
        if len(near):
            lifted = near + np.array([0, 0, _LIFT_M / 2, 0, 0, -_LIFT_M, 0])
            counts = points_in_boxes(cloud, lifted).sum(axis=1)
            held.extend((counts >= _HELD).astype(np.float64))
    return float(np.mean(held)) if held else float("nan")


def moved_labels(boxes: FloatArray, axes: str) -> FloatArray:
    """(N, 7) boxes in forward-left-up axes from boxes whose numbers are meant in the named axes."""
    turn = np.eye(4)
    turn[:3, :3] = canonical_from_axes(axes)
    return transform_boxes(boxes, turn)


def label_axes_shares(points: Sequence[NDArray[np.float32]], boxes: Sequence[FloatArray]) -> Mapping[str, float]:
    """`filled_share` for each of `AXES`, the boxes' numbers (in no axes yet) taken in them."""
    return {axes: filled_share(points, [moved_labels(found, axes) for found in boxes]) for axes in AXES}


def axes_of(matrix: FloatArray) -> str:
    """Name of axes from (3, 3) forward-left-up coordinates from theirs; the inverse of `canonical_from_axes`."""
    words = []
    for column in matrix.T:
        k = int(np.argmax(np.abs(column)))
        words.append((_DIRECTIONS if column[k] > 0 else _OPPOSITES)[k])
    return "-".join(words)


def ground_of(points: NDArray[np.float32]) -> tuple[int, float] | None:
    """Axis and place of the thinnest dense layer of a scan: the ground; None if no layer stands out.

    Args:
        points: (N, 3 or more), in any axes.

    Returns:
        Index of the axis at right angles to the ground, and the ground's place along it in metres.
    """
    near = points[np.linalg.norm(points[:, :3], axis=1) < _NEAR_M, :3]
    # what lies on the scanner itself is no ground
    near = near[np.linalg.norm(near, axis=1) > 2.5]
    if len(near) < 500:
        return None
    shares, places = [], []
    for axis in range(3):
        bins = np.floor(near[:, axis] / _GROUND_BIN_M).astype(np.int64)
        values, counts = np.unique(bins, return_counts=True)
        pairs = counts + np.where(np.isin(values + 1, values), np.roll(counts, -1), 0)
        best = int(np.argmax(pairs))
        shares.append(pairs[best] / len(near))
        places.append((values[best] + 1) * _GROUND_BIN_M)
    order = np.argsort(shares)[::-1]
    if shares[order[0]] < 1.5 * shares[order[1]]:
        return None
    return int(order[0]), float(places[order[0]])

"""How a camera stands against the LiDAR, from matched boxes alone (METHOD "Calibration watch"; beyond the paper).

A LiDAR box and the 2D detection of the same object should have the same edges in the image. The small rotation of the
camera, its displacement and its time offset are those that make them agree best: Gauss-Newton with Cauchy weights.

State, in this order: rotation vector (3, radians, axes of the camera: x right = pitch, y down = yaw, z forward = roll),
displacement (3, metres, the same axes), shrinkage of 2D boxes against projected ones (2, share of width and height),
time offset (seconds; positive when the camera looked later than its time stamp says).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lcf3d.geometry.boxes import box_corners
from lcf3d.geometry.camera import cut_by_field
from lcf3d.geometry.lens import local_projection
from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, Camera, FloatArray, IntArray

STATE = 9
ROTATION, DISPLACEMENT, SHRINKAGE, TIME = slice(0, 3), slice(3, 6), slice(6, 8), 8

# what is believed before anything is seen (one standard deviation of each part of the state)
PRIOR = np.array([0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.05, 0.05, 0.2])
# bias of detectors that distance does not tell from a rotation, and scatter beyond that of the pairs: measured on two
# real sets, where windows of 20 frames differ by up to twice what the pairs alone would say
SYSTEMATIC = np.array([np.deg2rad(0.05), np.deg2rad(0.05), np.deg2rad(0.1), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
SCATTER = 1.5
# nothing nearer than this takes part: one metre off is too many pixels there
NEAREST = 3.0
# an edge of a 2D box this near to the border of the image is cut by it, not seen
BORDER_PX = 4.0
# spread of an edge: pixels of the detector, share of the 2D box's side, metres of the 3D box
EDGE_PX, EDGE_SHARE, EDGE_M = 1.0, 0.02, 0.1
# what a detector believes to move more slowly than this is taken to stand; spread of the velocity of what moves (m/s)
STANDING, MOVING_SPREAD = 1.5, 0.5
# residuals of this many standard deviations have half their weight
CAUCHY = 2.0
ITERATIONS = 12


@dataclass(frozen=True, eq=False)
class BoxPairs:
    """LiDAR boxes and the 2D detections of the same objects in one camera, one row a pair.

    Attributes:
        corners: (N, 8, 3) corners of the 3D boxes, metres from the camera's centre, in its nominal axes.
        velocities: (N, 3) m/s of the objects as seen from the camera, in its axes; zero where not known.
        unsure: (N,) m/s that their velocities may be off by (a standard deviation), 0 for what stands.
        matrices: (N, 3, 3) homogeneous pixels from such corners.
        edges: (N, 4) 2D boxes.
        free: (N, 4) which of their edges are the object's own and not the image's border.
        groups: (N,) pairs of equal number are not independent (one moment, or a few that follow each other).
    """

    corners: FloatArray
    velocities: FloatArray
    unsure: FloatArray
    matrices: FloatArray
    edges: FloatArray
    free: BoolArray
    groups: IntArray

    def __len__(self) -> int:
        return len(self.corners)

    @classmethod
    def of(
        cls,
        boxes: FloatArray,
        boxes2d: FloatArray,
        camera: Camera,
        velocities: FloatArray | None = None,
        group: int = 0,
        unsure: FloatArray | None = None,
    ) -> BoxPairs:
        """Pairs of one frame: (N, 7) LiDAR boxes, (N, 4) 2D boxes, (N, 3) m/s in the LiDAR frame relative to it.

        ``unsure`` as in `BoxPairs`; zero without it.
        """
        rotation, origin = camera.camera_from_lidar[:3, :3], centre_offset(camera)
        corners = box_corners(boxes) @ rotation.T + camera.camera_from_lidar[:3, 3] + origin
        moving = np.zeros((len(boxes), 3)) if velocities is None else np.nan_to_num(velocities)
        limits = np.array([camera.width, camera.height], dtype=np.float64)
        free = np.concatenate([boxes2d[:, :2] > BORDER_PX, boxes2d[:, 2:] < limits - BORDER_PX], axis=1)
        near = corners[..., 2].min(axis=1) < NEAREST if len(boxes) else np.zeros(0, dtype=bool)
        free &= ~near[:, None]
        free &= ~cut_by_field(boxes2d, camera)[:, None]
        return cls(
            corners,
            moving @ rotation.T,
            np.zeros(len(boxes)) if unsure is None else unsure,
            _matrices(boxes2d, camera),
            np.asarray(boxes2d, dtype=np.float64),
            free,
            np.full(len(boxes), group, dtype=np.int64),
        )

    @classmethod
    def concatenate(cls, parts: list[BoxPairs]) -> BoxPairs:
        """All pairs of ``parts`` (at least one)."""
        names = cls.__dataclass_fields__
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class Alignment:
    """An estimate of a camera's stand against the LiDAR.

    Attributes:
        state: (9,) see the module.
        covariance: (9, 9) of it.
        pairs: how many pairs it rests on.
        spread: robust standard deviation of the edges, in units of what is expected.
    """

    state: FloatArray
    covariance: FloatArray
    pairs: int = 0
    spread: float = 1.0

    @classmethod
    def nominal(cls) -> Alignment:
        """As the calibration says, known as badly as before anything is seen."""
        return cls(np.zeros(STATE), np.diag(PRIOR**2))

    @property
    def rotation(self) -> FloatArray:
        """(3,) rotation vector in radians: pitch, yaw, roll in the camera's axes."""
        return self.state[ROTATION]

    @property
    def deviation(self) -> FloatArray:
        """(9,) standard deviations of the state."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def time_offset(self) -> float:
        """Seconds by which the camera looked later than its time stamp says."""
        return float(self.state[TIME])

    def surely_beyond(self, sure: float, reference: Alignment | None = None) -> float:
        """Radians that the rotation (from that of ``reference``) surely has: length less ``sure`` deviations along it.

        Negative where even no rotation would be likely.
        """
        rotation, covariance = self.rotation, self.covariance[ROTATION, ROTATION]
        if reference is not None:
            rotation = rotation - reference.rotation
            covariance = covariance + reference.covariance[ROTATION, ROTATION]
        angle = float(np.linalg.norm(rotation))
        axis = rotation / angle if angle > 1e-12 else np.array([0.0, 1.0, 0.0])
        return angle - sure * float(np.sqrt(axis @ covariance @ axis))


def centre_offset(camera: Camera) -> FloatArray:
    """(3,) what to add to camera coordinates to count them from the camera's centre (``projection = K [I | t]``)."""
    return np.asarray(np.linalg.solve(camera.intrinsics, camera.projection[:, 3]), dtype=np.float64)


def _matrices(boxes2d: FloatArray, camera: Camera) -> FloatArray:
    """(N, 3, 3) pixels from points counted from the camera's centre, around each (N, 4) pixel box of a lens."""
    if camera.distortion is None:
        return np.broadcast_to(camera.intrinsics, (len(boxes2d), 3, 3))
    turn = camera.camera_from_lidar[:3, :3].T
    return np.array([local_projection(camera, box)[:, :3] @ turn for box in boxes2d]).reshape(-1, 3, 3)


def rotation_of(vector: FloatArray) -> FloatArray:
    """(3, 3) rotation about (3,) ``vector`` by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-8:
        return np.asarray(np.eye(3) + cross)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross)


def vector_of(rotation: FloatArray) -> FloatArray:
    """(3,) rotation vector of a (3, 3) rotation by less than half a turn."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sine = float(np.linalg.norm(axis)) / 2
    angle = float(np.arctan2(sine, (np.trace(rotation) - 1) / 2))
    return np.asarray(axis / 2 if sine < 1e-8 else axis / (2 * sine) * angle)


def realigned(camera: Camera, rotation: FloatArray, displacement: FloatArray | None = None) -> Camera:
    """The camera turned about its own centre by a (3,) rotation vector, then moved: its ``camera_from_lidar`` changes.

    The projection is left alone, so that lenses stay as they are.
    """
    turn, offset = rotation_of(rotation), centre_offset(camera)
    step = np.eye(4)
    step[:3, :3] = turn
    step[:3, 3] = turn @ offset - offset + (0 if displacement is None else displacement)
    return replace(camera, camera_from_lidar=step @ camera.camera_from_lidar)


def fit_alignment(
    pairs: BoxPairs,
    start: Alignment,
    *,
    time: bool = False,
    displacement: bool = True,
    pause: Callable[[], None] = lambda: None,
) -> Alignment:
    """The state that makes the edges of projected boxes and 2D boxes agree.

    Args:
        pairs: matched boxes.
        start: where the iteration begins.
        time: also estimate the time offset, which needs velocities.
        displacement: also estimate the displacement; what cannot be told from a rotation stays near zero.
        pause: called before each step.

    Returns:
        The estimate with its covariance: of independent pairs, and what the gradients of `BoxPairs.groups` scatter
        beyond that (sandwich), added; then `SCATTER` and `SYSTEMATIC`.
    """
    prior = PRIOR.copy()
    if not time:
        prior[TIME] = 1e-6
    if not displacement:
        prior[DISPLACEMENT] = 1e-6
    state: FloatArray = start.state.copy()
    if not time:
        state[TIME] = 0
    information = np.diag(1 / prior**2)
    if not pairs.free.any():
        return Alignment(np.zeros(STATE), np.diag(prior**2))
    scale = 1.0
    for _ in range(ITERATIONS):
        pause()
        residuals, jacobian = _edges(pairs, state)
        used = pairs.free & np.isfinite(residuals)
        r, j = residuals[used], jacobian[used]
        scale = max(float(1.4826 * np.median(np.abs(r))), 0.5) if len(r) else 1.0
        weight = 1 / (scale**2 * (1 + (r / (CAUCHY * scale)) ** 2))
        normal = j.T @ (weight[:, None] * j) + information
        step = np.asarray(np.linalg.solve(normal, j.T @ (weight * r) - information @ state), dtype=np.float64)
        turned = vector_of(rotation_of(step[ROTATION]) @ rotation_of(state[ROTATION]))
        state = np.asarray(state + step, dtype=np.float64)
        state[ROTATION] = turned
        if np.abs(step[ROTATION]).max() < 1e-5 and np.abs(step[DISPLACEMENT]).max() < 1e-4:
            break
    inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    gradients = (weight * r)[:, None] * j
    groups, index = np.unique(np.broadcast_to(pairs.groups[:, None], used.shape)[used], return_inverse=True)
    sums = np.zeros((len(groups), STATE))
    np.add.at(sums, index, gradients)
    # a handful of groups scatter less than they should
    share = len(groups) / max(len(groups) - 1, 1)
    covariance = SCATTER**2 * (inverse + share * inverse @ (sums.T @ sums) @ inverse) + np.diag(SYSTEMATIC**2)
    return Alignment(state, covariance, int(used.any(axis=1).sum()), scale)


def _edges(pairs: BoxPairs, state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normalised residuals (N, 4) of ``x1 y1 x2 y2`` and the derivative (N, 4, 9) of the predicted edges."""
    residuals = np.full((len(pairs), 4), np.nan)
    jacobian = np.zeros((len(pairs), 4, STATE))
    focal = np.linalg.norm(np.cross(pairs.matrices[:, :2], pairs.matrices[:, 2:3]), axis=2)
    spread = np.array([EDGE_PX, EDGE_SHARE, EDGE_M])
    turn = rotation_of(state[ROTATION])
    _fill_edges(
        pairs.corners,
        pairs.velocities,
        np.asarray(pairs.unsure, dtype=np.float64),
        np.array(pairs.matrices),
        pairs.edges,
        focal,
        spread,
        turn,
        state,
        residuals,
        jacobian,
    )
    return residuals, jacobian


@kernel
def _fill_edges(  # type: ignore[no-untyped-def]
    corners, velocities, unsure, matrices, edges, focal, spread, turn, state, residuals, jacobian
):
    """Fill ``residuals`` and ``jacobian``; a box that comes nearer than half a metre keeps NaN.

    Both sides of a pair have errors. Derivatives are taken where the edge most likely is, between what is predicted and
    what was seen: taken at the prediction, its error would be in both factors of the normal equations and pull the time
    offset. An unsure velocity widens the spread with the offset, whose derivative counts that (Deming's regression):
    without it every offset would come out too small.
    """
    turned, homogeneous, moving = np.empty((8, 3)), np.empty((8, 3)), np.empty(3)
    shown, slope = np.empty((2, 8)), np.empty(3)
    for n in range(len(corners)):
        safe = True
        _multiply(turn, velocities[n], moving)
        for c in range(8):
            _multiply(turn, corners[n, c], turned[c])
            for i in range(3):
                turned[c, i] += state[8] * moving[i]
                slope[i] = turned[c, i] + state[3 + i]
            _multiply(matrices[n], slope, homogeneous[c])
            safe &= homogeneous[c, 2] > 0.5
            shown[0, c], shown[1, c] = homogeneous[c, 0] / homogeneous[c, 2], homogeneous[c, 1] / homogeneous[c, 2]
        if not safe:
            continue
        for e in range(4):
            a, sign = e % 2, 1.0 if e < 2 else -1.0
            inward = (shown[a].max() - shown[a].min()) / 2 * sign
            c = (sign * shown[a]).argmin()
            z, edge = homogeneous[c, 2], shown[a, c]
            side = edges[n, a + 2] - edges[n, a]
            drift = (unsure[n] * focal[n, a] / z) ** 2
            predicted = (spread[2] * focal[n, a] / z) ** 2 + state[8] ** 2 * drift
            sigma = np.sqrt(spread[0] ** 2 + (spread[1] * side) ** 2 + predicted)
            off = edges[n, e] - edge - inward * state[6 + a]
            residuals[n, e] = off / sigma
            jacobian[n, e, 8] = residuals[n, e] * state[8] * drift / sigma**2
            likely = edge + off * predicted / sigma**2
            for i in range(3):
                slope[i] = (matrices[n, a, i] - likely * matrices[n, 2, i]) / (z * sigma)
                jacobian[n, e, 3 + i] = slope[i]
                jacobian[n, e, 8] += slope[i] * moving[i]
            x, y, w = turned[c, 0], turned[c, 1], turned[c, 2]
            jacobian[n, e, 0] = y * slope[2] - w * slope[1]
            jacobian[n, e, 1] = w * slope[0] - x * slope[2]
            jacobian[n, e, 2] = x * slope[1] - y * slope[0]
            jacobian[n, e, 6 + a] = inward / sigma


@kernel
def _multiply(matrix, vector, result):  # type: ignore[no-untyped-def]
    """``result`` (3,) = (3, 3) ``matrix`` times (3,) ``vector``."""
    for i in range(3):
        result[i] = matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1] + matrix[i, 2] * vector[2]

"""How the sensor moved since the last frame: by the dataset's poses, by the objects themselves where it has none.

Most objects stand still, and tracks say where the others went: the planar motion that brings this frame's boxes onto
the tracks is the sensor's. It is solved by least squares with weights that fall with the residual, so that what moves
unforeseen or is no object at all counts little.

Poses have a scale of their own: wheels wear, and odometry from a stereo pair is as long as its baseline is well known.
A step 3 % too long makes a parked car creep by 0.3 m a second at 10 m/s, which is enough to lose it. So the scale is
learned from the objects that seem to creep along with the sensor.
"""

from __future__ import annotations

import numpy as np

from lcf3d.fusion.memory_motion import position_noise
from lcf3d.fusion.memory_state import COV_RATE, HITS, SEEN, VELOCITY_X, VELOCITY_Y, Odometry, Tracks
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, IntArray

# pairs farther apart than this at first, and in the end, are none, metres
REACH_M = (3.0, 2.0, 1.0, 1.0)
# residual at which a pair counts half, metres
SOFTNESS_M = 0.3
MIN_PAIRS = 3
# speeds tried where it is not known, m/s
TRIAL_SPEEDS = np.arange(-2.0, 40.0, 0.5)
TRIAL_REACH_M = 0.5
# of poses nothing more is known at first: standard deviation of their scale, and how far it strays in a second
FIRST_ODOMETRY = Odometry(1.0, 0.03**2)
SCALE_DRIFT = 0.005
MAX_SCALE_ERROR = 0.1
# objects slower than this share of the sensor may stand; a sensor slower than this, m/s, tells nothing
CREEP = 0.1
MIN_SPEED = 2.0
# a track's velocity is believed from so many sightings on; frames closer in time than this say the same twice
MIN_HITS = 5
VELOCITY_MEMORY_S = 0.1


def stretched(pose: FloatArray, before: FloatArray, scale: float) -> FloatArray:
    """(4, 4) a pose whose way from the one ``before`` is made longer or shorter."""
    result = pose.copy()
    result[:3, 3] = before[:3, 3] + scale * (pose[:3, 3] - before[:3, 3])
    return result


def learned_odometry(known: Odometry, tracks: Tracks, step: FloatArray, time_s: float, elapsed_s: float) -> Odometry:
    """The scale of the poses after a frame: objects that creep along with the sensor say that its steps are too long.

    A Kalman filter of one number. It is corrected by the median speed, along the sensor's way and as a share of its
    speed, of what is seen now and is so slow that it may stand.

    Args:
        known: before.
        tracks: after the frame.
        step: (2,) how the sensor moved in the world since the frame before, with the known scale.
        time_s: of the frame.
        elapsed_s: since the one before.
    """
    speed = float(np.hypot(step[0], step[1])) / elapsed_s
    if speed < MIN_SPEED:
        return known
    way = step / (speed * elapsed_s)
    creep, noise, count = _creeping(tracks.numbers, tracks.values, way, time_s, CREEP * speed)
    if not count:
        return known
    # a median is a little less sure than a mean
    own = np.pi / 2 * noise / count / speed**2 * max(VELOCITY_MEMORY_S / elapsed_s, 1.0)
    variance = known.variance + SCALE_DRIFT**2 * elapsed_s
    gain = variance / (variance + own)
    scale = known.scale * (1 - gain * creep / speed)
    bounded = min(max(scale, 1 - MAX_SCALE_ERROR), 1 + MAX_SCALE_ERROR)
    return Odometry(float(bounded), float((1 - gain) * variance))


@kernel
def _creeping(numbers, values, way, time, slow):  # type: ignore[no-untyped-def]
    """Median speed along ``way`` of what is seen now and slow, mean variance of these speeds, and how many they are."""
    speeds = np.empty(len(values))
    count, noise = 0, 0.0
    for i in range(len(values)):
        x, y = values[i, VELOCITY_X], values[i, VELOCITY_Y]
        if numbers[i, HITS] >= MIN_HITS and values[i, SEEN] == time and x * x + y * y < slow * slow:
            speeds[count] = x * way[0] + y * way[1]
            noise += values[i, COV_RATE]
            count += 1
    if count == 0:
        return 0.0, 0.0, 0
    return np.median(speeds[:count]), noise / count, count


def estimate_pose(
    tracks: Tracks,
    boxes: FloatArray,
    labels: IntArray,
    world_from_lidar: FloatArray,
    velocity: FloatArray | None,
    elapsed_s: float,
) -> tuple[FloatArray, FloatArray]:
    """(4, 4) ``world_from_lidar`` of a frame, and (3,) the sensor's velocity: ahead and left, m/s, and yaw rate, rad/s.

    Without enough pairs the sensor is taken to move on as before (without a ``velocity``: to stand).

    Args:
        tracks: predicted to the frame's time.
        boxes: (N, 7) of the frame in its LiDAR frame.
        labels: (N,) their classes.
        world_from_lidar: (4, 4) of the frame before.
        velocity: (3,) of the frame before, or None where it is not known.
        elapsed_s: since then.
    """
    first = velocity is None
    speed = np.zeros(3) if velocity is None else velocity
    if first and len(tracks) >= MIN_PAIRS and len(boxes) >= MIN_PAIRS:
        speed = _trial(tracks, boxes, labels, world_from_lidar, elapsed_s)
    step = speed * elapsed_s
    for reach in REACH_M:
        step, pairs = _refined(tracks, boxes, labels, world_from_lidar, step, reach)
        if pairs < MIN_PAIRS:
            return world_from_lidar @ _planar(speed * elapsed_s), speed
    return world_from_lidar @ _planar(step), step / elapsed_s


def _refined(
    tracks: Tracks, boxes: FloatArray, labels: IntArray, world_from_lidar: FloatArray, step: FloatArray, reach: float
) -> tuple[FloatArray, int]:
    """(3,) the step that fits the pairs within reach better, and how many pairs there are."""
    moved = transform_boxes(boxes, world_from_lidar @ _planar(step))
    distance = _distances(tracks, moved, labels)
    if not distance.size:
        return step, 0
    nearest = distance.argmin(axis=1)
    rows = np.flatnonzero(distance.min(axis=1) < reach)
    if len(rows) < MIN_PAIRS:
        return step, len(rows)
    own = nearest[rows]
    # in the LiDAR frame before the step, where the step is applied
    inverse = np.linalg.inv(world_from_lidar)
    target = tracks.positions[own] @ inverse[:2, :2].T + inverse[:2, 3]
    noise = tracks.position_variances[own] + position_noise(np.hypot(boxes[rows, 0], boxes[rows, 1])) ** 2
    weights = 1 / (noise * (1 + (distance[rows, own] / SOFTNESS_M) ** 2))
    weights = weights / weights.sum()
    source = boxes[rows, :2]
    a, b = weights @ source, weights @ target
    cross = ((source - a) * weights[:, None]).T @ (target - b)
    angle = float(np.arctan2(cross[0, 1] - cross[1, 0], cross[0, 0] + cross[1, 1]))
    cos, sin = np.cos(angle), np.sin(angle)
    shift = b - np.array([cos * a[0] - sin * a[1], sin * a[0] + cos * a[1]])
    return np.array([shift[0], shift[1], angle]), len(rows)


def _trial(
    tracks: Tracks, boxes: FloatArray, labels: IntArray, world_from_lidar: FloatArray, elapsed_s: float
) -> FloatArray:
    """(3,) the speed straight ahead that brings most boxes onto tracks; the lowest of equals."""
    best, found = np.zeros(3), -1
    for speed in sorted(TRIAL_SPEEDS, key=abs):
        step = np.array([speed * elapsed_s, 0.0, 0.0])
        distance = _distances(tracks, transform_boxes(boxes, world_from_lidar @ _planar(step)), labels)
        pairs = int((distance.min(axis=1) < TRIAL_REACH_M).sum())
        if pairs > found:
            best, found = step / elapsed_s, pairs
    return best


def _distances(tracks: Tracks, boxes: FloatArray, labels: IntArray) -> FloatArray:
    """(N, T) metres between boxes in the world and tracks, infinite between classes."""
    apart = np.linalg.norm(boxes[:, None, :2] - tracks.positions[None], axis=2)
    distances: FloatArray = np.where(labels[:, None] == tracks.labels[None], apart, np.inf)
    return distances


def _planar(step: FloatArray) -> FloatArray:
    """(4, 4) previous-LiDAR-from-LiDAR of a step (ahead, left, yaw)."""
    transform = np.eye(4)
    cos, sin = np.cos(step[2]), np.sin(step[2])
    transform[:2, :2] = [[cos, -sin], [sin, cos]]
    transform[:2, 3] = step[:2]
    return transform

"""How tracked objects move: constant velocity and turn rate, with Kalman filters in closed form.

Position noise is taken as equal along both axes, so that one 2 x 2 covariance (three numbers) serves x and y, and a
step is a handful of operations on whole columns. Yaw and yaw rate have a filter of the same form. What turns (cars,
riders) has its velocity turned along and drawn towards its heading; people walk where they like.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcf3d.fusion.memory_config import Motion
from lcf3d.fusion.memory_state import Tracks
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.structures import FloatArray, IntArray

# standard deviation of a measured position: metres, and metres per metre of distance
POSITION_NOISE = 0.1
POSITION_NOISE_BY_DISTANCE = 0.005
# standard deviation of a measured yaw at the sensor; doubled at the distance
YAW_NOISE = 0.03
YAW_NOISE_DISTANCE = 20.0
# of a new track's yaw rate, and how fast yaw rates change (rad/s^2); they fade within the time constant
YAW_RATE_SPREAD = 0.3
YAW_ACCELERATION = 0.5
YAW_RATE_MEMORY_S = 1.0
MAX_YAW_RATE = 1.0
# share by which an update draws the velocity of what turns towards its heading
HEADING_SHARE = 0.5


def position_noise(distances: FloatArray) -> FloatArray:
    """(N,) standard deviation of measured positions, metres, at (N,) distances from the sensor."""
    return POSITION_NOISE + POSITION_NOISE_BY_DISTANCE * distances


def yaw_noise(distances: FloatArray) -> FloatArray:
    """(N,) standard deviation of measured yaws, radians, at (N,) distances from the sensor."""
    return YAW_NOISE * (1 + distances / YAW_NOISE_DISTANCE)


def predict(tracks: Tracks, elapsed_s: float, motion: Motion) -> Tracks:
    """The tracks ``elapsed_s`` later, less certain."""
    turns = motion.turns[tracks.labels]
    turned = np.where(turns, tracks.yaw_rates * elapsed_s, 0.0)
    # half of the turn before the way and half after it
    halfway = _rotated(tracks.velocities, turned / 2)
    return replace(
        tracks,
        positions=tracks.positions + halfway * elapsed_s,
        velocities=_rotated(halfway, turned / 2),
        position_cov=_predicted_cov(tracks.position_cov, elapsed_s, motion.acceleration[tracks.labels]),
        yaws=wrap_angle(tracks.yaws + turned),
        yaw_rates=tracks.yaw_rates * np.exp(-elapsed_s / YAW_RATE_MEMORY_S),
        yaw_cov=_predicted_cov(tracks.yaw_cov, elapsed_s, np.full(len(tracks), YAW_ACCELERATION)),
    )


def measured(tracks: Tracks, boxes: FloatArray, distances: FloatArray, motion: Motion) -> Tracks:
    """The tracks with position, velocity and yaw corrected by measured boxes.

    Args:
        tracks: T tracks, predicted to the time of the measurement.
        boxes: (T, 7) measured boxes in the world frame.
        distances: (T,) from the sensor, metres.
        motion: of the classes.
    """
    noise = position_noise(distances)
    gain, rate_gain, position_cov = _gains(tracks.position_cov, noise**2)
    off = boxes[:, :2] - tracks.positions
    positions = tracks.positions + gain[:, None] * off
    velocities = tracks.velocities + rate_gain[:, None] * off
    # a detector may take the front for the rear; the track's own front stays where it is
    turned = wrap_angle(boxes[:, 6] - tracks.yaws)
    turned = np.where(np.abs(turned) > np.pi / 2, wrap_angle(turned + np.pi), turned)
    gain, rate_gain, yaw_cov = _gains(tracks.yaw_cov, yaw_noise(distances) ** 2)
    yaws = wrap_angle(tracks.yaws + gain * turned)
    heading = np.stack([np.cos(yaws), np.sin(yaws)], axis=1)
    along = (velocities * heading).sum(axis=1, keepdims=True) * heading
    share = np.where(motion.turns[tracks.labels], HEADING_SHARE, 0.0)[:, None]
    return replace(
        tracks,
        positions=positions,
        velocities=velocities + share * (along - velocities),
        position_cov=position_cov,
        yaws=yaws,
        yaw_rates=np.clip(tracks.yaw_rates + rate_gain * turned, -MAX_YAW_RATE, MAX_YAW_RATE),
        yaw_cov=yaw_cov,
    )


def first_position_cov(distances: FloatArray, labels: IntArray, motion: Motion) -> FloatArray:
    """(N, 3) covariance of position and velocity of objects seen once."""
    return np.stack([position_noise(distances) ** 2, np.zeros(len(labels)), motion.speed_spread[labels] ** 2], axis=1)


def first_yaw_cov(distances: FloatArray) -> FloatArray:
    """(N, 3) covariance of yaw and yaw rate of objects seen once."""
    n = len(distances)
    return np.stack([yaw_noise(distances) ** 2, np.zeros(n), np.full(n, YAW_RATE_SPREAD**2)], axis=1)


def _rotated(vectors: FloatArray, angles: FloatArray) -> FloatArray:
    """(N, 2) vectors turned by (N,) angles."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([cos * vectors[:, 0] - sin * vectors[:, 1], sin * vectors[:, 0] + cos * vectors[:, 1]], axis=1)


def _predicted_cov(cov: FloatArray, elapsed_s: float, acceleration: FloatArray) -> FloatArray:
    """(N, 3) covariance of value and rate a while later, under white accelerations of that deviation."""
    value, both, rate = cov.T
    t, power = elapsed_s, acceleration**2
    return np.stack(
        [
            value + 2 * t * both + t * t * rate + power * t**4 / 4,
            both + t * rate + power * t**3 / 2,
            rate + power * t * t,
        ],
        axis=1,
    )


def _gains(cov: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Kalman gains (N,) of value and rate for a measured value, and (N, 3) the covariance after it."""
    value, both, rate = cov.T
    gain, rate_gain = value / (value + noise), both / (value + noise)
    return gain, rate_gain, np.stack([(1 - gain) * value, (1 - gain) * both, rate - rate_gain * both], axis=1)

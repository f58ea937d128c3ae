"""How tracked objects move: constant velocity and turn rate, with Kalman filters in closed form.

Position noise is taken as equal along both axes, so that one 2 x 2 covariance (three numbers) serves x and y, and a
step is a handful of operations on whole columns. Yaw and yaw rate have a filter of the same form. What turns (cars,
riders) has its velocity turned along and drawn towards its heading; people walk where they like.

Beside that filter runs one for objects that stand, and both are weighed by how well they foretold each measurement (a
pair of models, autonomous but that what moves may stop). Most cars are parked: one that nothing sees for two seconds is
where it was, while a filter that lets it move loses it by half a metre.

The loops are compiled. Numbers that numpy's own functions give (exponentials, powers) are handed to them.
"""

from __future__ import annotations

import numpy as np

from lcf3d.fusion.memory_config import Motion
from lcf3d.fusion.memory_evidence import fading
from lcf3d.fusion.memory_state import (
    COV,
    COV_BOTH,
    COV_RATE,
    HEADING,
    LABEL,
    LAST_SUPPORT,
    POSITION_X,
    POSITION_Y,
    STANDING,
    STANDING_COV,
    STANDING_X,
    STANDING_Y,
    SUPPORT,
    VELOCITY_X,
    VELOCITY_Y,
    YAW_COV,
    YAW_COV_BOTH,
    YAW_COV_RATE,
    YAW_RATE,
    Tracks,
)
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray

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
# times within which what stands starts and what moves stops, and how far what stands seems to stray, m in a second
STARTS_S, STOPS_S = 20.0, 60.0
STANDING_DRIFT = 0.1
# neither is ever quite sure
LEAST_STANDING = 1e-3
# share by which an update draws the velocity of what turns towards its heading
HEADING_SHARE = 0.5


def position_noise(distances: FloatArray) -> FloatArray:
    """(N,) standard deviation of measured positions, metres, at (N,) distances from the sensor."""
    return POSITION_NOISE + POSITION_NOISE_BY_DISTANCE * distances


def predict(tracks: Tracks, elapsed_s: float, motion: Motion) -> Tracks:
    """The tracks ``elapsed_s`` later: moved on, less certain, their support faded."""
    values = np.empty_like(tracks.values)
    t = float(elapsed_s)
    powers = (t, t * t, t**3, t**4)
    shares = (float(np.exp(-t / YAW_RATE_MEMORY_S)), float(-np.expm1(-t / STARTS_S)), float(-np.expm1(-t / STOPS_S)))
    _predict(tracks.values, tracks.numbers, motion.turns, motion.acceleration, powers, shares, fading(t), values)
    return Tracks(tracks.numbers, values)


@kernel
def _predict(old, numbers, turns, acceleration, powers, shares, support, new):  # type: ignore[no-untyped-def]
    """Fill ``new`` with the tracks of ``old`` a while later; ``support`` are the units and the share that stays."""
    t = powers[0]
    yaw_rate_share, starts, stops = shares
    for i in range(len(old)):
        new[i] = old[i]
        _stand(new[i], starts, stops, STANDING_DRIFT * STANDING_DRIFT * t)
        label = numbers[i, LABEL]
        turned = old[i, YAW_RATE] * t if turns[label] else 0.0
        # half of the turn before the way and half after it
        cos, sin = np.cos(turned / 2), np.sin(turned / 2)
        x = cos * old[i, VELOCITY_X] - sin * old[i, VELOCITY_Y]
        y = sin * old[i, VELOCITY_X] + cos * old[i, VELOCITY_Y]
        new[i, POSITION_X] = old[i, POSITION_X] + x * t
        new[i, POSITION_Y] = old[i, POSITION_Y] + y * t
        new[i, VELOCITY_X] = cos * x - sin * y
        new[i, VELOCITY_Y] = sin * x + cos * y
        spread_later(new[i, COV : COV_RATE + 1], powers, acceleration[label])
        new[i, HEADING] = wrapped(old[i, HEADING] + turned)
        new[i, YAW_RATE] = old[i, YAW_RATE] * yaw_rate_share
        spread_later(new[i, YAW_COV : YAW_COV_RATE + 1], powers, YAW_ACCELERATION)
        new[i, SUPPORT] = (old[i, SUPPORT] + old[i, LAST_SUPPORT] * support[0]) * support[1]
        new[i, LAST_SUPPORT] = 0.0


@kernel(inline="always")
def _stand(track, starts, stops, spread):  # type: ignore[no-untyped-def]
    """The model that stands, a while later: a share of what moved has stopped where it was (numba)."""
    p = track[STANDING]
    stays, stopped = p * (1 - starts), (1 - p) * stops
    share = stopped / (stays + stopped)
    x, y = track[POSITION_X] - track[STANDING_X], track[POSITION_Y] - track[STANDING_Y]
    track[STANDING_X] += share * x
    track[STANDING_Y] += share * y
    between = share * (1 - share) * (x * x + y * y) / 2
    track[STANDING_COV] = (1 - share) * track[STANDING_COV] + share * track[COV] + between + spread
    track[STANDING] = stays + stopped


@kernel(inline="always")
def place(track):  # type: ignore[no-untyped-def]
    """Position of a track and its variance, of both models by how probable each is (numba)."""
    p = track[STANDING]
    x, y = track[STANDING_X] - track[POSITION_X], track[STANDING_Y] - track[POSITION_Y]
    variance = track[COV] + p * (track[STANDING_COV] - track[COV]) + p * (1 - p) * (x * x + y * y) / 2
    return track[POSITION_X] + p * x, track[POSITION_Y] + p * y, variance


@kernel(inline="always")
def spread_later(cov, powers, acceleration):  # type: ignore[no-untyped-def]
    """Covariance (3,) of value and rate a while later, under white accelerations of that deviation (numba)."""
    value, both, rate, power = cov[0], cov[1], cov[2], acceleration * acceleration
    t = powers[0]
    cov[0] = value + 2 * t * both + powers[1] * rate + power * powers[3] / 4
    cov[1] = both + t * rate + power * powers[2] / 2
    cov[2] = rate + power * t * t


@kernel(inline="always")
def wrapped(angle):  # type: ignore[no-untyped-def]
    """An angle brought into [-pi, pi), as `lcf3d.geometry.boxes.wrap_angle` does (numba)."""
    result = (angle + np.pi) % (2 * np.pi) - np.pi
    return -np.pi if result >= np.pi else result


@kernel(inline="always")
def yaw_noise(distance):  # type: ignore[no-untyped-def]
    """Standard deviation of a measured yaw, radians, at a distance from the sensor (numba)."""
    return YAW_NOISE * (1 + distance / YAW_NOISE_DISTANCE)


@kernel(inline="always")
def corrected(cov, noise):  # type: ignore[no-untyped-def]
    """Kalman gains of value and rate for a value measured with that variance; ``cov`` (3,) is then that after it."""
    value, both = cov[0], cov[1]
    gain, rate_gain = value / (value + noise), both / (value + noise)
    cov[0], cov[1], cov[2] = (1 - gain) * value, (1 - gain) * both, cov[2] - rate_gain * both
    return gain, rate_gain


@kernel
def measure(track, box, distance, turns):  # type: ignore[no-untyped-def]
    """Correct position, velocity and yaw of one track by a measured box (numba).

    Args:
        track: (25,) row of `Tracks.values`, predicted to the time of the measurement; changed in place.
        box: (7,) in the world frame.
        distance: of the box from the sensor, metres.
        turns: whether the object moves along its heading.
    """
    noise = POSITION_NOISE + POSITION_NOISE_BY_DISTANCE * distance
    off_x, off_y = box[0] - track[POSITION_X], box[1] - track[POSITION_Y]
    _measure_standing(track, box, noise * noise, off_x * off_x + off_y * off_y)
    gain, rate_gain = corrected(track[COV : COV_RATE + 1], noise * noise)
    track[POSITION_X] += gain * off_x
    track[POSITION_Y] += gain * off_y
    x, y = track[VELOCITY_X] + rate_gain * off_x, track[VELOCITY_Y] + rate_gain * off_y
    # a detector may take the front for the rear; the track's own front stays where it is
    turned = wrapped(box[6] - track[HEADING])
    if abs(turned) > np.pi / 2:
        turned = wrapped(turned + np.pi)
    noise = yaw_noise(distance)
    gain, rate_gain = corrected(track[YAW_COV : YAW_COV_RATE + 1], noise * noise)
    track[HEADING] = wrapped(track[HEADING] + gain * turned)
    cos, sin = np.cos(track[HEADING]), np.sin(track[HEADING])
    along = x * cos + y * sin
    share = HEADING_SHARE if turns else 0.0
    track[VELOCITY_X] = x + share * (along * cos - x)
    track[VELOCITY_Y] = y + share * (along * sin - y)
    track[YAW_RATE] = min(max(track[YAW_RATE] + rate_gain * turned, -MAX_YAW_RATE), MAX_YAW_RATE)


@kernel(inline="always")
def _measure_standing(track, box, noise, moving_off):  # type: ignore[no-untyped-def]
    """Correct the model that stands, and say which of both foretold the box better (numba).

    Args:
        track: before the model that moves is corrected; changed in place.
        box: (7,) in the world frame.
        noise: variance of its position.
        moving_off: squared distance from where the moving model expects it.
    """
    x, y = box[0] - track[STANDING_X], box[1] - track[STANDING_Y]
    standing, moving = track[STANDING_COV] + noise, track[COV] + noise
    exponent = moving_off / (2 * moving) - (x * x + y * y) / (2 * standing)
    odds = moving / standing * np.exp(min(max(exponent, -30.0), 30.0))
    p = track[STANDING]
    track[STANDING] = min(max(p * odds / (p * odds + 1 - p), LEAST_STANDING), 1 - LEAST_STANDING)
    gain = track[STANDING_COV] / standing
    track[STANDING_X] += gain * x
    track[STANDING_Y] += gain * y
    track[STANDING_COV] *= 1 - gain


@kernel
def begin(track, box, distance, speed_spread):  # type: ignore[no-untyped-def]
    """Position, velocity and yaw of a track that begins with a box, and their covariances (numba); see `measure`."""
    track[POSITION_X], track[POSITION_Y] = box[0], box[1]
    track[VELOCITY_X] = track[VELOCITY_Y] = track[YAW_RATE] = 0.0
    noise = POSITION_NOISE + POSITION_NOISE_BY_DISTANCE * distance
    track[COV], track[COV_BOTH], track[COV_RATE] = noise * noise, 0.0, speed_spread * speed_spread
    track[STANDING_X], track[STANDING_Y], track[STANDING_COV], track[STANDING] = box[0], box[1], noise * noise, 0.5
    track[HEADING] = box[6]
    noise = yaw_noise(distance)
    track[YAW_COV], track[YAW_COV_BOTH], track[YAW_COV_RATE] = noise * noise, 0.0, YAW_RATE_SPREAD * YAW_RATE_SPREAD

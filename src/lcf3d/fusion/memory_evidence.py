"""What the past of an object is worth: log-odds that add to those of `lcf3d.fusion.evidence`.

A frame that gave an object the log-odds ``l`` supports it with ``max(l + OFFSET, 0)``: false alarms flicker, so that
being there again says something even where each frame is unsure. Support is summed over the past with a memory of
about half a second, in units of a tenth of a second, so that it means the same at any frame rate. Then

    seen now:           log-odds = l + weight * (support - reference)      (l where nobody looked a frame ago)
    seen a moment ago:  log-odds = weight * support + HIDDEN * hidden + CAMERA * camera - REFUTED * free - base

No weight is negative, so that more support in the past never lowers a score.
"""

from __future__ import annotations

import numpy as np

from lcf3d.structures import BoolArray, FloatArray

# log-odds from which on a frame's opinion of an object counts for it
OFFSET = 4.0
# support of an object that is as likely real as not, just after a frame; it fades as support does
REFERENCE = 6.0
# support fades to 1 / e within this time
MEMORY_S = 0.45
# support counts frames in units of this time, and no frame for more than so many of them
UNIT_S, MAX_UNITS = 0.1, 2.0
# log-odds of a box nobody sees: where another hides it, where a camera detection shows it, where light passes through
HIDDEN = 1.5
CAMERA = 3.0
REFUTED = 3.0


def frame_support(log_odds: FloatArray) -> FloatArray:
    """(N,) what a frame that gave objects these log-odds says for them."""
    return np.maximum(log_odds + OFFSET, 0.0)


def fading(elapsed_s: float) -> tuple[float, float]:
    """In how many units the last frame joins the support of those before it, and what share of all stays.

    After ``elapsed_s`` since the last frame, support is ``(support + last * units) * share``, where ``last`` is the
    `frame_support` of the last frame, 0 where it saw nothing.
    """
    return min(elapsed_s / UNIT_S, MAX_UNITS), float(np.exp(-elapsed_s / MEMORY_S))


def seen_log_odds(
    log_odds: FloatArray, support: FloatArray, looked: BoolArray, weights: FloatArray, elapsed_s: float
) -> FloatArray:
    """(N,) log-odds of detections with what the past says.

    Args:
        log_odds: (N,) of the frame itself.
        support: (N,) of the past; 0 for what has none.
        looked: (N,) whether a frame ago somebody looked where the object was; without that, no past says nothing.
        weights: (N,) of the classes.
        elapsed_s: time since the last frame.
    """
    reference = REFERENCE * np.exp(-elapsed_s / MEMORY_S)
    return log_odds + np.where(looked | (support > 0), weights * (support - reference), 0.0)


def missed_log_odds(
    support: FloatArray,
    hidden: FloatArray,
    camera: FloatArray,
    free: FloatArray,
    weights: FloatArray,
    bases: FloatArray,
) -> FloatArray:
    """(N,) log-odds of boxes where a track says that an object is and no detection is.

    Args:
        support: (N,) of the past.
        hidden: (N,) share of the box that nearer boxes hide, 0 to 1: a reason for not being detected.
        camera: (N,) score of a 2D detection there that no other box explains, 0 without one.
        free: (N,) share of the laser beams towards the box that went through it, 0 where none is known.
        weights: (N,) of the classes.
        bases: (N,) of the classes.
    """
    return np.asarray(weights * support + HIDDEN * hidden + CAMERA * camera - REFUTED * free - bases)


def motion_log_odds(standing: FloatArray, doubt: FloatArray) -> FloatArray:
    """(N,) log-odds that the way an object moves adds: 0 while nothing is known of it.

    Of objects half stand, of false alarms ``(1 + doubt) / 2``: poles and bushes that are taken for people stand still.

    Args:
        standing: (N,) probability that it stands.
        doubt: (N,) of the classes, 0 to 1; 0 where false alarms move as objects do.
    """
    return np.asarray(-np.log1p(doubt * (2 * standing - 1)))

"""How sure a metric is: frames drawn again with replacement, and the spread of the metric over such draws.

Whole frames are drawn, because detections of one frame share its scene. Frames of one drive resemble each other too;
intervals over frames of few drives are therefore narrower than they should be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.evaluation.curves import Sampling, ScoreEvents, average_precision, resampled_curves
from lcf3d.structures import FloatArray, IntArray

DEFAULT_SAMPLES = 1000


@dataclass(frozen=True)
class Interval:
    """A value and the percentile interval of its resamples.

    Attributes:
        value: on the data set as it is.
        low: lower end, 2.5 % of the resamples lie below.
        high: upper end, 2.5 % lie above.
    """

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, samples: FloatArray, level: float = 0.95) -> Interval:
        """The central interval that holds the share ``level`` of ``samples``; those of NaN are left out."""
        low, high = np.nanquantile(samples, [(1 - level) / 2, (1 + level) / 2])
        return cls(float(value), float(low), float(high))


def frame_weights(n_frames: int, samples: int = DEFAULT_SAMPLES, seed: int = 0) -> IntArray:
    """(samples, n_frames) how often each frame is drawn when ``n_frames`` frames are drawn with replacement.

    Raises:
        ConfigError: fewer than one frame or sample.
    """
    if n_frames < 1 or samples < 1:
        raise ConfigError(f"resampling needs at least one frame and one sample, got {n_frames} and {samples}")
    drawn = np.random.default_rng(seed).integers(0, n_frames, (samples, n_frames))
    drawn += np.arange(samples)[:, None] * n_frames
    return np.bincount(drawn.ravel(), minlength=samples * n_frames).reshape(samples, n_frames).astype(np.int64)


def resampled_ap(events: ScoreEvents, weights: IntArray, sampling: Sampling = "R40") -> tuple[FloatArray, FloatArray]:
    """(B,) average precision and (B,) average orientation similarity, in percent, of each resampled data set.

    Thresholds are sampled anew for each resample, as if the official program ran on those frames.
    """
    precision, similarity = resampled_curves(events, weights)
    return average_precision(precision, sampling), average_precision(similarity, sampling)

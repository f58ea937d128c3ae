"""How much each branch is believed: log-odds that add up, one small set of readable numbers a class.

The paper's ensemble multiplies scores as if detectors were calibrated and independent, and its filter deletes what the
camera misses. Measured on real detectors this helps where the LiDAR branch is poor and hurts where it is good
(docs/when-fusion-helps.md). Here the log-odds of a LiDAR box are

    base + trust * logit(s3d) + s2d * support(IoU) - miss * exposure - off_ground * slope - competing * p_other

where ``s2d`` and the image IoU are those of the matched 2D detection (zero without one). No weight is negative and
``support`` does not fall, so that more camera support never lowers a score.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray

Weight = Annotated[float, Field(ge=0)]

# image IoU at which `Evidence.support` is given; it is 0 at IoU 0 and linear in between
SUPPORT_IOU = (0.5, 0.7, 0.85, 1.0)
# exposure of an unmatched box: 0 at the first projected height and below, 1 at the second and above
EXPOSURE_HEIGHTS_PX = (25.0, 150.0)
# a box this much above or below the ground, as a share of its distance, counts as fully off it
FULL_SLOPE = 0.05
# log-odds of scores are kept within these bounds
MAX_LOG_ODDS = 30.0


class Evidence(BaseModel):
    """The weights of one class. The defaults are those of cars, measured on three pairs of real detectors.

    Attributes:
        base: log-odds added to every box.
        trust: weight of the LiDAR score's log-odds; below 1 because the two branches err on the same objects.
        support: log-odds that a certain 2D detection (score 1) adds at the IoUs of ``SUPPORT_IOU``.
        miss: log-odds lost when no camera detection matches a box that is large in the image and not cut by its edge.
        off_ground: log-odds lost by a box that floats or sinks by 5 % of its distance or more.
        recovered: probability that a box recovered from a certain 2D detection, with image IoU 1, is right; recovered
            scores are multiplied with it. Not fitted: it takes scans. Without it a recovered box, which the LiDAR
            detector has missed, would rank above most confirmed ones.
        competing: log-odds lost to a certain (score 1) LiDAR box of another class, of higher score, in its cluster.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    base: float = -0.6
    trust: Weight = 0.8
    support: tuple[Weight, Weight, Weight, Weight] = (0.1, 0.5, 1.3, 3.0)
    miss: Weight = 0.1
    off_ground: Weight = 2.0
    competing: Weight = 0.0
    recovered: Annotated[float, Field(ge=0, le=1)] = 0.4

    @model_validator(mode="before")
    @classmethod
    def _read_old_name(cls, values: Any) -> Any:
        """Files of lcf3d 0.1 call ``competing`` by the name ``rival``."""
        if isinstance(values, dict) and "rival" in values and "competing" not in values:
            values = {("competing" if name == "rival" else name): value for name, value in values.items()}
        return values

    @model_validator(mode="after")
    def _check_support(self) -> Evidence:
        if any(b < a for a, b in zip(self.support[:-1], self.support[1:], strict=True)):
            raise ValueError(f"support must not fall with IoU, got {self.support}")
        return self

    @classmethod
    def lidar_alone(cls) -> Evidence:
        """The LiDAR score as it is."""
        return cls(base=0, trust=1, support=(0, 0, 0, 0), miss=0, off_ground=0, competing=0)

    @classmethod
    def from_weights(cls, weights: FloatArray, recovered: float = 0.4) -> Evidence:
        """The inverse of `weights`; ``recovered`` is not among them."""
        trust, competing, off_ground, miss, *steps, base = (float(w) for w in weights)
        support = np.cumsum(steps)
        return cls(
            base=base,
            trust=trust,
            support=(float(support[0]), float(support[1]), float(support[2]), float(support[3])),
            miss=miss,
            off_ground=off_ground,
            competing=competing,
            recovered=recovered,
        )

    def with_camera_share(self, share: float) -> Evidence:
        """The same with only a share of what the camera's finding and missing of a box weighs."""
        support = tuple(value * share for value in self.support)
        return self.model_copy(update={"support": support, "miss": self.miss * share})

    @property
    def weights(self) -> FloatArray:
        """(9,) weights of the columns of `evidence_table`; all but the last, the constant, must not be negative."""
        steps = np.diff((0.0, *self.support))
        return np.array([self.trust, self.competing, self.off_ground, self.miss, *steps, self.base])


_PERSON = Evidence(base=-1.0, trust=1.0, support=(2.5, 4.5, 6.0, 6.0), miss=0.3, off_ground=0.0, recovered=0.7)
ROLE_EVIDENCE: dict[str, Evidence] = {
    "vehicle": Evidence(),
    "pedestrian": _PERSON.model_copy(update={"competing": 3.0}),
    # as for pedestrians but for the competing class, which cost cyclists more than it brought
    "rider": _PERSON,
    "other": _PERSON,
}
"""Weights by role (`lcf3d.fusion.roles`), measured on real detectors: docs/when-fusion-helps.md."""


def evidence_table(
    log_odds: FloatArray,
    competing: FloatArray,
    slope: FloatArray,
    exposure: FloatArray,
    camera_scores: FloatArray,
    iou: FloatArray,
) -> FloatArray:
    """(N, 9) one column a weight; the log-odds of the boxes are ``table @ evidence.weights``.

    Args:
        log_odds: (N,) of the LiDAR scores.
        competing: (N,) score of the best LiDAR box of another class in the same cluster, 0 where that is not higher.
        slope: (N,) see `ground_slope`.
        exposure: (N,) see `miss_exposure`; used where no 2D detection is matched.
        camera_scores: (N,) score of the matched 2D detection, 0 without one.
        iou: (N,) image IoU with it, 0 without one.
    """
    table = np.ones((len(iou), 9))
    table[:, 0], table[:, 1], table[:, 2], table[:, 3], table[:, 4], table[:, 5] = (
        log_odds,
        competing,
        slope,
        exposure,
        camera_scores,
        iou,
    )
    _weigh(table)
    return table


@kernel
def _weigh(table):  # type: ignore[no-untyped-def]
    """Turn the six inputs of `evidence_table`, in the first columns, into its columns, in place."""
    for n in range(len(table)):
        score, iou = table[n, 4], table[n, 5]
        table[n, 1], table[n, 2] = -table[n, 1], -table[n, 2]
        table[n, 3] = 0.0 if iou > 0 else -table[n, 3]
        low = 0.0
        for k in range(len(SUPPORT_IOU)):
            share = (iou - low) / (SUPPORT_IOU[k] - low)
            table[n, 4 + k] = score * min(max(share, 0.0), 1.0)
            low = SUPPORT_IOU[k]


def miss_exposure(projected: FloatArray, width: int, height: int) -> FloatArray:
    """(N,) how plainly a camera should see each box, 0 to 1.

    Grows with the logarithm of the projected height (cameras miss the far and tiny); 0 for boxes that the edge of the
    image cuts, which are truncated there.

    Args:
        projected: (N, 4) projections, pixels, clipped to the image.
        width: image width in pixels.
        height: image height in pixels.
    """
    # a copy in C order, so that one compiled version serves all
    exposure: FloatArray = _exposure(np.array(projected, dtype=np.float64, order="C"), width, height)
    return exposure


@kernel
def _exposure(projected, width, height):  # type: ignore[no-untyped-def]
    """See `miss_exposure`."""
    exposure = np.zeros(len(projected))
    low, high = EXPOSURE_HEIGHTS_PX
    for n in range(len(projected)):
        if projected[n, 0] > 1 and projected[n, 2] < width - 2 and projected[n, 3] < height - 2:
            tall = math.log(max(projected[n, 3] - projected[n, 1], 1.0) / low) / math.log(high / low)
            exposure[n] = min(max(tall, 0.0), 1.0)
    return exposure


def ground_slope(boxes: FloatArray, ground_z: float | None) -> FloatArray:
    """(N,) how far each box floats above or sinks below the ground, as a share of ``FULL_SLOPE``, 0 to 1.

    Height of the bottom over ``ground_z`` by distance: the slope that the road would need to have. 0 where the ground
    is not known.

    Args:
        boxes: (N, 7) in the LiDAR frame.
        ground_z: height of the ground under the sensor in the LiDAR frame, metres, or None.
    """
    if ground_z is None:
        return np.zeros(len(boxes))
    height = np.abs(boxes[:, 2] - boxes[:, 5] / 2 - ground_z)
    distance = np.maximum(np.hypot(boxes[:, 0], boxes[:, 1]), 1.0)
    return np.minimum(height / distance / FULL_SLOPE, 1.0)


def to_log_odds(scores: FloatArray) -> FloatArray:
    """Log-odds of probabilities, within ``MAX_LOG_ODDS``."""
    with np.errstate(divide="ignore"):
        return _within(np.log(scores) - np.log1p(-scores), -MAX_LOG_ODDS, MAX_LOG_ODDS)


def to_probability(log_odds: FloatArray) -> FloatArray:
    """The inverse of `to_log_odds`."""
    return np.asarray(1.0 / (1.0 + np.exp(-_within(log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS))))


def _within(values: FloatArray, low: float, high: float) -> FloatArray:
    """As `numpy.clip`, which takes ten times as long for the few values of a frame."""
    bounded: FloatArray = np.minimum(np.maximum(values, low), high)
    return bounded

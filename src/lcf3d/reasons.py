"""What became of an input or output of the fusion, and why: codes and their words.

Beside arrays stands the plain number, ``Outcome.KEPT.value``: numpy takes five times as long for the member itself.
"""

from __future__ import annotations

from enum import IntEnum


class Outcome(IntEnum):
    """What became of an input, or why an output is there."""

    MATCHED = 0
    RECOVERED = 1
    KEPT = 2
    DROPPED = 3
    PREDICTED = 4


class Reason(IntEnum):
    """Why; the sentence for people is `REASON_TEXT`."""

    CONFIRMED = 0
    IN_CLUSTER = 1
    UNCONFIRMED = 2
    DOWNWEIGHTED = 3
    OUT_OF_VIEW = 4
    LOW_SCORE = 5
    OTHER_CLASS = 6
    TOO_MANY = 7
    SUPPRESSED = 8
    REPLACED = 9
    LOCALIZED = 10
    FEW_POINTS = 11
    NOT_LOCALIZED = 12
    DISAGREES = 13
    DUPLICATE = 14
    SEEN_ELSEWHERE = 15
    NO_RECOVERY = 16
    NO_SCAN = 17
    OTHER_VIEW = 18
    INVALID = 19
    CLASS_NOT_DETECTED = 20
    SECOND_VIEW = 21
    UNPAIRED = 22
    POOR_FIT = 23


OUTCOMES = tuple(outcome.name.lower() for outcome in Outcome)
REASONS = tuple(reason.name.lower() for reason in Reason)
"""Words of the codes, by code."""

REASON_TEXT = {
    Reason.CONFIRMED: "a camera detection confirms the cluster",
    Reason.IN_CLUSTER: "a box of higher score represents its cluster",
    Reason.UNCONFIRMED: "it is in view of a camera and no camera detection confirms it",
    Reason.DOWNWEIGHTED: "no camera detection confirms it, its score is lowered by the camera's miss likelihood",
    Reason.OUT_OF_VIEW: "no camera that was used looks at it",
    Reason.LOW_SCORE: "its score is not above the threshold",
    Reason.OTHER_CLASS: "its class is not among the classes to detect",
    Reason.TOO_MANY: "the frame has more boxes of higher score than max_boxes",
    Reason.SUPPRESSED: "non-maximum suppression: it overlaps a box of higher score",
    Reason.REPLACED: "a box of higher score, recovered from a camera detection, stands in its place",
    Reason.LOCALIZED: "the frustum localizer found the object that the LiDAR detector missed",
    Reason.FEW_POINTS: "its frustum holds too few LiDAR points",
    Reason.POOR_FIT: "the localized box fits the points in its frustum poorly",
    Reason.NOT_LOCALIZED: "the localizer found no object in its frustum",
    Reason.DISAGREES: "the localized box, projected, does not overlap it enough",
    Reason.DUPLICATE: "the localized box overlaps a confirmed one, or a kept one of higher score",
    Reason.SEEN_ELSEWHERE: "its object is already confirmed through another camera",
    Reason.NO_RECOVERY: "no LiDAR box matches it and recovery is off",
    Reason.NO_SCAN: "no LiDAR box matches it and there is no scan to recover it from",
    Reason.OTHER_VIEW: "its object is matched better in another camera",
    Reason.CLASS_NOT_DETECTED: "the camera detector does not detect its class",
    Reason.INVALID: "its box is not finite or has no size",
    Reason.SECOND_VIEW: "it confirms the cluster beside the more confident view of its stereo pair",
    Reason.UNPAIRED: "no LiDAR box matches it, and no detection of its stereo pair's other view shows the same object",
}

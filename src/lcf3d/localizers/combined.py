"""The geometric localizer and a network together: where they agree their boxes are averaged, their doubts add up.

The fit is exact where it has found the object, the network knows what objects look like; they err independently. Two
boxes that agree are better on average than either, and a frustum of nothing seldom deceives both.
"""

from __future__ import annotations

import numpy as np

from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.fusion.localizer import Localizer
from lcf3d.geometry.boxes import YAW, wrap_angle
from lcf3d.geometry.iou import iou_3d
from lcf3d.localizers.geometric import GeometricLocalizer
from lcf3d.localizers.named import ShippedLocalizer
from lcf3d.localizers.shapes import SHAPES
from lcf3d.structures import FloatArray

AGREE_IOU = 0.3
"""3D IoU above which two boxes are of the same object and are averaged."""
SHARE_SOLID, SHARE_OPEN = 0.25, 0.5
"""The network's share of the average: of vehicles, whose sides the fit measures, and of persons and two-wheelers."""
SURE = 0.5
"""Where the two disagree, the network's box is taken if it expects more than this IoU of it."""
FAINT = 0.1
"""Quality of the fit where it finds nothing: it gives no box below."""


class CombinedLocalizer:
    """A box from the geometric fit and one from a network, made one; a `Localizer`.

    The heading's axis comes from both, which end is the front from the network. The quality is the geometric mean of
    the two.

    Args:
        geometric: the fit.
        network: the network; those that come with lcf3d unless given.
    """

    def __init__(self, geometric: Localizer | None = None, network: Localizer | None = None) -> None:
        self.geometric: Localizer = geometric or GeometricLocalizer()
        self.network: Localizer = network or ShippedLocalizer()

    def __call__(self, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 7) in the frustum frames, NaN where neither finds one, and qualities (K,) in [0, 1]."""
        fitted, fit_quality = self.geometric(proposals)
        learned, net_quality = self.network(proposals)
        solid = np.array([_is_solid(name) for name in proposals.class_names], dtype=bool)[proposals.labels]
        return combine(fitted, fit_quality, learned, net_quality, np.where(solid, SHARE_SOLID, SHARE_OPEN))


def combine(
    fitted: FloatArray, fit_quality: FloatArray, learned: FloatArray, net_quality: FloatArray, share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One box and quality for each pair.

    Args:
        fitted: (K, 7) boxes of the geometric fit, NaN where there is none.
        fit_quality: (K,) their qualities.
        learned: (K, 7) boxes of the network, NaN for classes that it does not know; those keep the fit's box.
        net_quality: (K,) their qualities.
        share: (K,) weight of the network's box in the average.
    """
    boxes, quality = np.array(fitted, dtype=np.float64), np.array(fit_quality, dtype=np.float64)
    for k in np.flatnonzero(np.isfinite(learned).all(axis=1)):
        found = bool(np.isfinite(fitted[k]).all())
        quality[k] = np.sqrt(max(fit_quality[k], FAINT) * net_quality[k])
        if found and iou_3d(fitted[k : k + 1], learned[k : k + 1])[0, 0] > AGREE_IOU:
            boxes[k] = _average(fitted[k], learned[k], float(share[k]))
        elif not found or net_quality[k] > SURE:
            boxes[k] = learned[k]
    return boxes, quality


def _average(fitted: FloatArray, learned: FloatArray, share: float) -> FloatArray:
    """The weighted mean of two boxes, facing the way of the learned one."""
    box = (1 - share) * fitted + share * learned
    # a fit's yaw is known up to half a turn: bring it to the network's side first
    turned = learned[YAW] + wrap_angle(np.array([2 * (fitted[YAW] - learned[YAW])]))[0] / 2
    box[YAW] = wrap_angle(np.array([(1 - share) * turned + share * learned[YAW]]))[0]
    result: FloatArray = box
    return result


def _is_solid(name: str) -> bool:
    return name not in SHAPES or SHAPES[name].solid

"""What the fusion expects of a frustum localizer."""

from __future__ import annotations

from typing import Protocol

from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.structures import FloatArray


class Localizer(Protocol):
    """Puts one 3D box into each frustum (paper section 4.1.4)."""

    def __call__(self, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
        """Boxes and qualities of all proposals of a frame.

        Args:
            proposals: K proposals, points in their frustum frames.

        Returns:
            (K, 7) boxes ``x y z length width height yaw`` in the frustum frames, NaN where none could be found; and
            (K,) how good each fit is believed to be, in [0, 1].
        """
        ...

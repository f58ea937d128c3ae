"""The frames that networks were trained in, and the way from canonical points into them and of boxes back.

nuScenes' raw LIDAR_TOP frame is x right, y forward, z up: ``(x, y)_raw = (-y, x)_canonical``, a quarter turn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.structures import FloatArray

FRAMES = ("canonical", "lidar_top")


def turned_points(points: NDArray[np.float32], frame: str) -> NDArray[np.float32]:
    """(N, 3 or more) points in ``frame``, of canonical ones; only signs and places change, so nothing is rounded.

    Raises:
        ConfigError: an unknown frame.
    """
    if frame not in FRAMES:
        raise ConfigError(f"a network's frame must be one of {', '.join(FRAMES)}, got {frame!r}")
    if frame == "canonical":
        return points
    turned = points.copy()
    turned[:, 0], turned[:, 1] = -points[:, 1], points[:, 0]
    return turned


def canonical_boxes(boxes: FloatArray, frame: str) -> FloatArray:
    """(N, 7 or 9) boxes ``x y z l w h yaw [vx vy]`` in the canonical frame, of those in ``frame``."""
    if frame == "canonical":
        return boxes
    turned = boxes.copy()
    turned[:, 0], turned[:, 1] = boxes[:, 1], -boxes[:, 0]
    turned[:, 6] -= np.pi / 2
    if boxes.shape[1] == 9:
        turned[:, 7], turned[:, 8] = boxes[:, 8], -boxes[:, 7]
    return turned

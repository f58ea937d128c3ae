"""What the rest of lcf3d expects of a detector: two protocols, no base classes to inherit from.

Any callable with the right signature is a detector; see ``docs/detectors-camera.md`` for one in five lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lcf3d.structures import Detections2D, Detections3D

Image = NDArray[np.uint8]


class CameraDetector(Protocol):
    """The camera branch of the cascade (paper section 4.1.1): images in, 2D detections out."""

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detect objects in images.

        Args:
            images: (H, W, 3) uint8 RGB images, of equal or different sizes.

        Returns:
            One `Detections2D` an image, boxes in pixels of that image, all with the same class list.
        """
        ...


class LidarDetector(Protocol):
    """The LiDAR branch of the cascade (paper section 4.1.1): a scan in, 3D detections out."""

    def __call__(self, points: NDArray[np.float32]) -> Detections3D:
        """Detect objects in one scan.

        Args:
            points: (N, 4 or more) float32 ``x, y, z, intensity, ...`` in the LiDAR frame.

        Returns:
            3D boxes in the LiDAR frame.
        """
        ...

"""What the rest of lcf3d expects of a detector: two protocols, no base classes to inherit from.

Any callable with the right signature is a detector; see ``docs/detectors-camera.md`` for one in five lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lcf3d.frame import Frame
from lcf3d.structures import Detections2D, Detections3D

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class CloudRequest:
    """The cloud that a LiDAR detector was trained on and wants to be given; a detector's attribute ``cloud``.

    A detector without that attribute is given the scan as it is.

    Attributes:
        sweeps: earlier sweeps joined to the scan, which then has the time lag in seconds as fifth column.
        remove_close: points of an earlier sweep within a metre of the sensor along both x and y are left out.
        repeat_scan: where no earlier sweep is there, the scan itself takes the place of each, without lag.
        view: name of the camera whose field of view the cloud is cut to; "" for the whole cloud.
    """

    sweeps: int = 0
    remove_close: bool = False
    repeat_scan: bool = False
    view: str = ""


SCAN = CloudRequest()
"""The scan as it is."""


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


class FrameDetector(Protocol):
    """A detector of points and images together, which may stand where the LiDAR branch stands."""

    def detect_frame(self, frame: Frame) -> Detections3D:
        """Detect objects in one frame.

        Args:
            frame: with a scan, images and calibrated cameras.

        Returns:
            3D boxes in the LiDAR frame.
        """
        ...


def cloud_request(detector: LidarDetector | FrameDetector) -> CloudRequest:
    """What cloud a detector asks for: its attribute ``cloud``, or the plain scan."""
    request = getattr(detector, "cloud", None)
    return request if isinstance(request, CloudRequest) else SCAN

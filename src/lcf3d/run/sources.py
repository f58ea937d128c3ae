"""Where a run's detections come from, frame by frame: files of another tool, or a detector on the sensor data."""

from __future__ import annotations

from typing import Protocol

from lcf3d.detectors.base import CameraDetector, LidarDetector
from lcf3d.errors import DatasetError
from lcf3d.structures import Detections2D, Detections3D, Frame


class LidarSource(Protocol):
    """The LiDAR branch of a run."""

    def detect(self, frame: Frame) -> Detections3D:
        """3D detections of one frame in its LiDAR frame."""
        ...


class CameraSource(Protocol):
    """The camera branch of a run."""

    def sees(self, frame: Frame, camera: str) -> bool:
        """Whether there is anything to detect from: a camera without it is not used in that frame."""
        ...

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """2D detections of one camera of one frame."""
        ...


class LidarOnScans:
    """A LiDAR detector, run on the frames' scans."""

    def __init__(self, detector: LidarDetector) -> None:
        self.detector = detector

    def detect(self, frame: Frame) -> Detections3D:
        """Run the detector.

        Raises:
            DatasetError: the frame has no scan.
        """
        if frame.points is None:
            raise DatasetError(f"frame {frame.id} has no scan for the LiDAR detector; pass results:PATH instead")
        return self.detector(frame.points)


class CameraOnImages:
    """A camera detector, run on the frames' images."""

    def __init__(self, detector: CameraDetector) -> None:
        self.detector = detector

    def sees(self, frame: Frame, camera: str) -> bool:
        """Whether there is an image."""
        return camera in frame.images

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """Run the detector."""
        return self.detector([frame.images[camera]])[0]

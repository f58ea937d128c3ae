"""Where a run's detections come from, frame by frame: files of another tool, or a detector on the sensor data."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.detectors.base import CameraDetector, FrameDetector, LidarDetector, cloud_request
from lcf3d.detectors.lidar.sweeps import cloud_of, missing_of
from lcf3d.detectors.named import load_detector
from lcf3d.frame import Frame
from lcf3d.structures import Detections2D, Detections3D

log = logging.getLogger(__name__)

MODELS = Path(__file__).parents[1] / "models"
SIMULATED = "simulation.json"
"""The file that `lcf3d simulate` leaves in the folder of a data set."""
ON_REAL_DATA = "On real data:"
"""How the line of a model card begins that says what its network is worth there."""


class LidarOnScans:
    """A LiDAR detector, run on the clouds of the frames that it asks for (see `CloudRequest`)."""

    def __init__(self, detector: LidarDetector) -> None:
        self.detector = detector

    def detect(self, frame: Frame) -> Detections3D:
        """Run the detector; its boxes are in the frame's LiDAR coordinates.

        Raises:
            DatasetError: the frame has no scan.
        """
        return self.detector(cloud_of(frame, cloud_request(self.detector)))

    def notes(self, frame: Frame) -> tuple[str, ...]:
        """What the frame lacks of the cloud that the detector was trained on."""
        return missing_of(frame, cloud_request(self.detector))


class DetectorOnFrames:
    """A detector of points and images together, run on whole frames where a LiDAR branch stands."""

    def __init__(self, detector: FrameDetector) -> None:
        self.detector = detector

    def detect(self, frame: Frame) -> Detections3D:
        """Run the detector.

        Raises:
            DatasetError: the frame lacks a scan or images.
        """
        return self.detector.detect_frame(frame)

    def notes(self, frame: Frame) -> tuple[str, ...]:
        """What the frame lacks of the cloud that the detector was trained on."""
        return missing_of(frame, cloud_request(self.detector))


class CameraOnImages:
    """A camera detector, run on the frames' images.

    Attributes:
        detector: the detector.
        reports: the classes that it can report, None where it does not say.
    """

    def __init__(self, detector: CameraDetector) -> None:
        self.detector = detector
        self.reports: tuple[str, ...] | None = getattr(detector, "reports", None)

    def sees(self, frame: Frame, camera: str) -> bool:
        """Whether there is an image."""
        return camera in frame.images

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """Run the detector."""
        return self.detector([frame.images[camera]])[0]


def open_lidar(text: str, dataset: Dataset, class_names: Sequence[str], missing: str = "error") -> LidarSource:
    """The LiDAR branch that a string names: a detector to run on the scans, or ``results:PATH``.

    Raises:
        Lcf3dError: there is no such detector, or it cannot be loaded.
    """
    _warn_of_real_data(text, "lidar", dataset)
    loaded: Any = load_detector(text, "lidar", class_names, {"missing": missing}, dataset)
    if hasattr(loaded, "detect_frame"):
        return DetectorOnFrames(loaded)
    return loaded if hasattr(loaded, "detect") else LidarOnScans(loaded)


def open_cameras(
    texts: Mapping[str, str], dataset: Dataset, class_names: Sequence[str], missing: str = "error", tiles: int = 1
) -> dict[str, CameraSource]:
    """The camera branch of each camera; a detector that is named twice is loaded once.

    Args:
        texts: what the detector of each camera is called, by camera name.
        dataset: whose images they are to see.
        class_names: classes of the detections.
        missing: what to do about absent result files.
        tiles: overlapping tiles across wide images, for detectors that know them.

    Raises:
        Lcf3dError: there is no such detector, or it cannot be loaded.
    """
    defaults: dict[str, Any] = {"missing": missing, **({"tiles": tiles} if tiles > 1 else {})}
    by_text: dict[str, CameraSource] = {}
    for text in texts.values():
        if text not in by_text:
            _warn_of_real_data(text, "camera", dataset)
            loaded: Any = load_detector(text, "camera", class_names, defaults, dataset)
            by_text[text] = loaded if hasattr(loaded, "detect") else CameraOnImages(loaded)
    return {name: by_text[text] for name, text in texts.items()}


def _warn_of_real_data(text: str, sensor: str, dataset: Dataset) -> None:
    """Say once what a network costs that has seen simulation only, if the dataset is not a simulated one."""
    kind, _, rest = text.partition(":")
    root = getattr(dataset, "root", None)
    if kind == "shipped" and not (root is not None and (Path(root) / SIMULATED).is_file()):
        _warn_once(sensor, rest.partition("?")[0])


@lru_cache(maxsize=16)
def _warn_once(sensor: str, name: str) -> None:
    card = MODELS / f"{sensor}_{name}.md"
    figures = real_data_note(card.read_text(encoding="utf-8")) if card.is_file() else ""
    if figures:
        log.warning("the %s network shipped:%s has seen simulation only. %s", sensor, name, figures)


def real_data_note(card: str) -> str:
    """The line of a model card that begins with `ON_REAL_DATA`; empty if there is none."""
    return next((line.strip() for line in card.splitlines() if line.startswith(ON_REAL_DATA)), "")


def in_files(cameras: Mapping[str, CameraSource]) -> bool:
    """Whether the detections of all cameras are there already: no detector has to be run on images."""
    return not any(isinstance(source, CameraOnImages) for source in cameras.values())

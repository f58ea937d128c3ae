"""LiDAR detectors as the command line names them: ``pointpillars:CHECKPOINT``, ``onnx-lidar:FILE`` and so on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import CloudRequest, LidarDetector, cloud_request
from lcf3d.detectors.classes import class_mapping
from lcf3d.detectors.downloads import is_published, local_path
from lcf3d.detectors.lidar.suppression import NmsMode
from lcf3d.errors import DetectorError
from lcf3d.structures import Detections3D

MODELS = Path(__file__).parents[2] / "models"
"""Where the networks lie that come with the package."""


@dataclass(frozen=True)
class InClasses:
    """A LiDAR detector whose detections are given in another class list; classes without a counterpart are dropped."""

    detector: LidarDetector
    class_names: tuple[str, ...]

    @property
    def cloud(self) -> CloudRequest:
        """The cloud that the detector asks for."""
        return cloud_request(self.detector)

    def __call__(self, points: NDArray[np.float32]) -> Detections3D:
        """Detections of (N, 4 or more) points."""
        found = self.detector(points)
        return found.with_classes(self.class_names, class_mapping(found.class_names, self.class_names))


def load(
    path: str,
    class_names: Sequence[str] | None = None,
    nms: NmsMode = "off",
    score_threshold: float | None = None,
    device: str = "cpu",
    preset: str | None = None,
    candidates: int | None = None,
    first_stage_nms: NmsMode = "keep",
    architecture: str | None = None,
) -> LidarDetector:
    """A LiDAR detector from a checkpoint of any of the known architectures.

    Args:
        path: checkpoint file, or the name of a published one (`lcf3d.detectors.published`), downloaded at first use.
        class_names: classes of the detections; the network's own without it.
        nms: ``off`` as in the paper, ``low`` or ``keep``.
        score_threshold: boxes need a higher score; the network's own without it.
        device: torch device.
        preset: name of the configuration; found from the parameters without it.
        candidates: best boxes considered before suppression; the network's own number without it.
        first_stage_nms: ``keep``, ``low`` or ``off`` for the proposals of Part-A2 and PV-RCNN.
        architecture: what the network must be, if anything.

    Raises:
        DetectorError: the file cannot be read, or holds another network.
    """
    from lcf3d.detectors.lidar.loading import detector_class, read_lidar_checkpoint, require_architecture

    if preset is None and is_published(path, "lidar"):
        preset = path
    # before a file of another network is downloaded
    require_architecture(preset, architecture)
    state, config = read_lidar_checkpoint(local_path(path, "lidar"), preset, architecture)
    options = {
        "nms": nms,
        "score_threshold": score_threshold,
        "device": device,
        "candidates": candidates,
        "first_stage_nms": first_stage_nms,
    }
    detector: LidarDetector = detector_class(config.architecture).from_state_dict(state, config, **options)
    return detector if class_names is None else InClasses(detector, tuple(class_names))


# one name a kind: a checkpoint of another network is refused
pointpillars = partial(load, architecture="pointpillars")
second = partial(load, architecture="second")
ssn = partial(load, architecture="ssn")
centerpoint = partial(load, architecture="centerpoint")
part_a2 = partial(load, architecture="part-a2")
pv_rcnn = partial(load, architecture="pv-rcnn")


def onnx_lidar(
    path: str,
    class_names: Sequence[str] | None = None,
    nms: NmsMode = "off",
    score_threshold: float | None = None,
    threads: int = 0,
    candidates: int | None = None,
) -> LidarDetector:
    """An exported network; see `lcf3d.detectors.lidar.onnx.OnnxLidarDetector`."""
    from lcf3d.detectors.lidar.onnx import OnnxLidarDetector

    detector = OnnxLidarDetector(path, nms=nms, score_threshold=score_threshold, threads=threads, candidates=candidates)
    return detector if class_names is None else InClasses(detector, tuple(class_names))


def shipped(
    name: str,
    class_names: Sequence[str] | None = None,
    nms: NmsMode = "off",
    score_threshold: float | None = None,
    threads: int = 0,
) -> LidarDetector:
    """A network that comes with lcf3d, run by onnxruntime: ``kitti`` finds cars, pedestrians and cyclists.

    Args:
        name: of the network.
        class_names: classes of the detections; the network's own without it.
        nms: ``off`` as in the paper, ``low`` or ``keep``.
        score_threshold: boxes need a higher score; the network's own without it.
        threads: threads of onnxruntime; 0 for one a core.

    Raises:
        DetectorError: there is no network of that name.
    """
    return onnx_lidar(str(shipped_path(name)), class_names, nms, score_threshold, threads)


def shipped_path(name: str) -> Path:
    """The file of a network that comes with lcf3d.

    Raises:
        DetectorError: there is no network of that name.
    """
    path = MODELS / f"lidar_{name}.onnx"
    if not path.is_file():
        known = ", ".join(sorted(p.stem.removeprefix("lidar_") for p in MODELS.glob("lidar_*.onnx"))) or "none"
        raise DetectorError(f"lcf3d ships no LiDAR network {name!r}; it has: {known}")
    return path

"""Frustum PointPillars (Paigwar, Sierra-Gonzalez, Erkent, Laugier, ICCV Workshops 2021).

2D boxes of a camera detector cut frustums out of the scan, and only points in a frustum reach the pillar network; each
carries how likely it belongs to the object, a Gaussian about the centre of the 2D box (section 3.2 of it; with the
width and height of the box as deviations, as in the LCF3D paper, section 4.1.4). Here the network is the compact pillar
network, the Gaussian takes the place of the class scores of `lcf3d.detectors.fusion.painting`, one a class, and a
point in several boxes of a class takes the highest. ``lcf3d train lidar --frustums`` trains it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import CameraDetector, Image
from lcf3d.detectors.fusion.painting import PaintedDetector, WithoutImage
from lcf3d.detectors.lidar.onnx import OnnxLidarDetector
from lcf3d.detectors.lidar.suppression import NmsMode
from lcf3d.detectors.named import load_detector
from lcf3d.errors import DetectorError
from lcf3d.fusion.frustum import gaussian_mask
from lcf3d.structures import FloatArray

ENLARGED = 0.05
"""2D boxes grow by this share of their sides, as proposals of the recovery do."""
LEAST_SCORE = 0.2
"""2D boxes below it cut no frustum."""


class FrustumPainter:
    """Points in 2D boxes take the Gaussian of the box, all others nothing; a `lcf3d.detectors.fusion.painters.Painter`.

    Args:
        detector: of the camera.
        class_names: classes of the values.
        score_threshold: boxes need a higher score.
    """

    def __init__(
        self, detector: CameraDetector, class_names: Sequence[str], score_threshold: float = LEAST_SCORE
    ) -> None:
        self.detector, self.class_names, self.score_threshold = detector, tuple(class_names), score_threshold

    def __call__(self, image: Image, pixels: FloatArray) -> NDArray[np.float32]:
        """(M, K) the highest Gaussian of the boxes of each class around each of the (M, 2) pixels."""
        found = self.detector([image])[0].with_classes(self.class_names)
        values = np.zeros((len(pixels), len(self.class_names)), np.float32)
        for box, label in zip(found.boxes, found.labels, strict=True):
            margin = np.tile(box[2:] - box[:2], 2) * (ENLARGED / 2) * (-1, -1, 1, 1)
            x1, y1, x2, y2 = box + margin
            inside = np.flatnonzero(
                (pixels[:, 0] >= x1) & (pixels[:, 0] <= x2) & (pixels[:, 1] >= y1) & (pixels[:, 1] <= y2)
            )
            values[inside, label] = np.maximum(values[inside, label], gaussian_mask(pixels[inside], box))
        return values


def frustum_painter(camera: str, class_names: Sequence[str]) -> FrustumPainter:
    """Frustums of the camera detector that a string names, for example ``shipped:kitti``.

    Raises:
        ConfigError: an unknown kind or setting.
        DetectorError: the detector cannot be loaded.
    """
    detector = load_detector(camera, "camera", class_names, {"score_threshold": LEAST_SCORE})
    return FrustumPainter(detector, class_names)


def frustum_pillars(
    path: str,
    class_names: Sequence[str] | None = None,
    nms: NmsMode = "off",
    score_threshold: float | None = None,
    frustums: str = "",
    camera: str = "left",
    without_image: WithoutImage = "error",
    threads: int = 0,
) -> PaintedDetector:
    """``frustum-pillars:FILE``: a network that ``lcf3d train lidar --frustums`` wrote.

    Args:
        path: the ONNX file.
        class_names: classes of the detections; the network's own without it.
        nms: ``off``, ``low`` or ``keep``.
        score_threshold: boxes need a higher score; the network's own without it.
        frustums: camera detector whose boxes cut the frustums; the one of the training without it.
        camera: name of the camera.
        without_image: ``error``, or ``unpainted``: without an image there is no frustum, and nothing is found.
        threads: of onnxruntime; 0 for one a core.

    Raises:
        DetectorError: the file is no such network, or the camera detector cannot be loaded.
    """
    network = OnnxLidarDetector(path, nms, score_threshold, threads)
    if not network.config.only_painted:
        raise DetectorError(
            f"{path} was not trained on frustums; train one with 'lcf3d train lidar --frustums', or run it as "
            f"{'painted' if network.config.painted else 'onnx-lidar'}:{path}"
        )
    painter = frustum_painter(frustums or network.config.painter, network.config.painted)
    return PaintedDetector(network, painter, class_names, camera, without_image)

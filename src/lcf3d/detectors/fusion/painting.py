"""PointPainting (Vora, Lang, Helou, Beijbom, "PointPainting: Sequential Fusion for 3D Object Detection", CVPR 2020).

Three steps (section 3 of it): an image network gives every pixel class scores; every point is projected into the image
and takes along the scores of its pixel; a LiDAR network, here the compact pillar network, learns from the painted
points. A pillar then has, beside the statistics of its points, mean and highest of each score
(`lcf3d.detectors.lidar.statistics.painted_statistics`). ``lcf3d train lidar --paint`` trains it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import SCAN, CloudRequest, Image
from lcf3d.detectors.classes import class_mapping
from lcf3d.detectors.fusion.images import image_of
from lcf3d.detectors.fusion.painters import Painter, load_painter
from lcf3d.detectors.lidar.onnx import OnnxLidarDetector
from lcf3d.detectors.lidar.suppression import NmsMode
from lcf3d.errors import ConfigError, DatasetError, DetectorError
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_points
from lcf3d.structures import Camera, Detections3D

WithoutImage = Literal["error", "unpainted"]


def painted_points(
    points: NDArray[np.floating], camera: Camera, image: Image | None, painter: Painter, classes: int
) -> NDArray[np.float32]:
    """(M, 4 + classes) ``x, y, z, intensity`` and class scores of the points that the camera sees.

    Args:
        points: (N, 4 or more) in the LiDAR frame.
        camera: that sees them.
        image: of it; None paints nothing: all scores are 0.
        painter: gives the scores.
        classes: their number.
    """
    pixels, _ = project_points(points, camera)
    # pixels of points behind the camera are NaN, of which comparisons are false
    seen = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    scores = np.zeros((int(seen.sum()), classes), np.float32) if image is None else painter(image, pixels[seen])
    return np.concatenate([points[seen, :4].astype(np.float32), scores], axis=1)


class PaintedDetector:
    """A pillar network on painted points; stands where a LiDAR branch stands, with whole frames.

    Args:
        network: as exported by ``lcf3d train lidar --paint``.
        painter: gives points their scores.
        class_names: classes of the detections; the network's own without it.
        camera: name of the camera whose image paints; only what it sees is looked at.
        without_image: ``error``, or ``unpainted`` to go on with scores of 0.

    Raises:
        DetectorError: the network takes no painted points.
        ConfigError: ``without_image`` is neither.
    """

    cloud: CloudRequest = SCAN

    def __init__(
        self,
        network: OnnxLidarDetector,
        painter: Painter,
        class_names: Sequence[str] | None = None,
        camera: str = "left",
        without_image: WithoutImage = "error",
    ) -> None:
        if not network.config.painted:
            raise DetectorError(
                f"the network {network.config.name} takes plain points; run it as onnx-lidar:FILE, or train one on "
                "painted points with 'lcf3d train lidar --paint'"
            )
        if without_image not in ("error", "unpainted"):
            raise ConfigError(f"without_image takes error or unpainted, got {without_image!r}")
        self.network, self.painter, self.camera, self.without_image = network, painter, camera, without_image
        self.class_names = network.class_names if class_names is None else tuple(class_names)

    def detect_frame(self, frame: Frame) -> Detections3D:
        """Detections in a frame, in its LiDAR frame.

        Raises:
            DatasetError: the frame has no scan, or no image of the camera.
            ConfigError: the frame has no such camera.
        """
        if frame.points is None:
            raise DatasetError(f"frame {frame.id} has no scan, whose points are to be painted")
        camera = frame.camera(self.camera)
        absent = self.without_image == "unpainted" and camera.name not in frame.images
        image = None if absent else image_of(frame, camera)
        points = painted_points(frame.points, camera, image, self.painter, len(self.network.config.painted))
        found = self.network(points, frame.points)
        return found.with_classes(self.class_names, class_mapping(found.class_names, self.class_names))


def painted(
    path: str,
    class_names: Sequence[str] | None = None,
    nms: NmsMode = "off",
    score_threshold: float | None = None,
    paint: str = "",
    camera: str = "left",
    without_image: WithoutImage = "error",
    threads: int = 0,
) -> PaintedDetector:
    """``painted:FILE``: PointPainting with a network that ``lcf3d train lidar --paint`` wrote.

    Args:
        path: the ONNX file.
        class_names: classes of the detections; the network's own without it.
        nms: ``off`` as in the paper, ``low`` or ``keep``.
        score_threshold: boxes need a higher score; the network's own without it.
        paint: what paints (see `lcf3d.detectors.fusion.painters.load_painter`); what it was trained with without it.
        camera: see `PaintedDetector`.
        without_image: see `PaintedDetector`.
        threads: of onnxruntime; 0 for one a core.

    Raises:
        DetectorError: the file is no such network, or the painter cannot be loaded.
    """
    network = OnnxLidarDetector(path, nms, score_threshold, threads)
    if network.config.only_painted:
        raise DetectorError(f"{path} was trained on frustums only; run it as frustum-pillars:{path}")
    text = paint or network.config.painter
    painter = load_painter(text, network.config.painted) if network.config.painted else _nothing
    return PaintedDetector(network, painter, class_names, camera, without_image)


def _nothing(image: Image, pixels: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.zeros((len(pixels), 0), np.float32)

"""The small camera detectors that come with the package, run by onnxruntime; no torch, no download."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcf3d.detectors.camera.onnx import OnnxDetector
from lcf3d.errors import ConfigError
from lcf3d.structures import KITTI_CLASSES

INPUT_SIZE = (384, 1248)
"""(height, width) of the network's input: KITTI's images as they are. At two thirds of it fewer people are found."""
MODELS = Path(__file__).parents[2] / "models"
SHIPPED = {"kitti": "camera_kitti.onnx"}
"""File of each shipped detector, beside its model card of the same name in ``lcf3d/models``."""


def shipped(
    name: str,
    class_names: Sequence[str] = KITTI_CLASSES,
    tiles: int = 1,
    score_threshold: float = 0.1,
    iou_threshold: float = 0.6,
    size: int | str | None = None,
    threads: int = 0,
) -> OnnxDetector:
    """A detector with masks that comes with the package, trained on simulated images: ``shipped:kitti``.

    Args:
        name: a key of `SHIPPED`; ``kitti`` finds Car, Pedestrian and Cyclist.
        class_names: classes the detections shall have; the network's own are mapped by name.
        tiles: see `OnnxDetector`.
        score_threshold: see there; scores are shares of such detections that are right.
        iou_threshold: see there.
        size: ``HEIGHTxWIDTH`` of the network's input in multiples of 32 pixels, 384x1248 unless given; 256x832 takes
            half the time; images of other proportions than KITTI's want others, for example 544x960 for nuScenes.
        threads: of onnxruntime; 0 takes all cores.

    Raises:
        ConfigError: there is no detector of that name, or a setting makes no sense.
        DetectorError: its file is missing or damaged.
    """
    path = shipped_path(name)
    return OnnxDetector(path, class_names, tiles, score_threshold, iou_threshold, "auto", size, threads=threads)


def shipped_path(name: str) -> Path:
    """The file of a detector that comes with the package.

    Raises:
        ConfigError: there is no detector of that name.
    """
    if name not in SHIPPED:
        raise ConfigError(f"no camera detector {name!r} comes with lcf3d; it ships: {', '.join(SHIPPED)}")
    return MODELS / SHIPPED[name]

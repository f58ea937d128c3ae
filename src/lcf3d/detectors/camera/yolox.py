"""Megvii's YOLOX (Ge et al., 2021) by its size: official ONNX files under Apache-2.0, downloaded at first use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lcf3d.detectors.camera.onnx import OnnxDetector
from lcf3d.detectors.classes import COCO_CLASSES
from lcf3d.detectors.downloads import download
from lcf3d.detectors.published import find_model
from lcf3d.errors import ConfigError
from lcf3d.structures import KITTI_CLASSES

SIZES = ("nano", "tiny", "s", "m", "l", "x")


def yolox(
    size: str,
    class_names: Sequence[str] = KITTI_CLASSES,
    tiles: int = 1,
    score_threshold: float = 0.1,
    iou_threshold: float = 0.6,
    mapping: Mapping[str, str] | None = None,
    threads: int = 0,
) -> OnnxDetector:
    """A detector of COCO's 80 classes: ``yolox:nano``, ``tiny``, ``s``, ``m``, ``l`` or ``x``.

    Args:
        size: which of `SIZES`.
        class_names: classes the detections shall have, mapped by name.
        tiles: see `OnnxDetector`.
        score_threshold: see there.
        iou_threshold: see there.
        mapping: see there.
        threads: of onnxruntime; 0 takes all cores.

    Raises:
        ConfigError: there is no such size, or a setting makes no sense.
        DetectorError: the file cannot be had; the message says what to put where.
    """
    if size not in SIZES:
        raise ConfigError(
            f"YOLOX comes in sizes {', '.join(SIZES)}, got {size!r}; a file of your own is onnx:FILE?layout=yolox"
        )
    path = download(find_model(f"yolox-{size}"))
    return OnnxDetector(
        path,
        class_names,
        tiles,
        score_threshold,
        iou_threshold,
        "yolox",
        names=COCO_CLASSES,
        mapping=mapping,
        threads=threads,
    )

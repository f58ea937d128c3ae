"""LiDAR detectors: the networks of the paper with their published weights, and what they share.

>>> from lcf3d.detectors.lidar import PointPillars
>>> detector = PointPillars.from_checkpoint("pointpillars.pth", nms="off", score_threshold=0.1)
>>> detections = detector(points)

The detectors need torch (``pip install 'lcf3d[train]'``); `OnnxLidarDetector` and `accumulate_sweeps` do not.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = {
    "CompactPillars": "compact",
    "PointPillars": "pointpillars",
    "SECOND": "second",
    "SSN": "ssn",
    "CenterPoint": "centerpoint",
    "PartA2": "part_a2",
    "PVRCNN": "pv_rcnn",
    "OnnxLidarDetector": "onnx",
    "export_onnx": "export",
    "accumulate_sweeps": "sweeps",
    "Sweep": "sweeps",
    "benchmark": "benchmarking",
    "load": "kinds",
}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    """Public names, imported when they are first used."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)

"""lcf3d: late-cascade fusion of camera and LiDAR detections for 3D object detection."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lcf3d.errors import Lcf3dError
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES, Camera, Detections2D, Detections3D, Frame, InstanceMask

if TYPE_CHECKING:
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.fusion.pipeline import LateCascadeFusion
    from lcf3d.provenance import FusedDetections

__version__ = "0.1.0"

__all__ = [
    "KITTI_CLASSES",
    "NUSCENES_CLASSES",
    "Camera",
    "Detections2D",
    "Detections3D",
    "Frame",
    "FusedDetections",
    "FusionConfig",
    "InstanceMask",
    "LateCascadeFusion",
    "Lcf3dError",
]

# scipy, numba and pydantic are imported when first needed, so that ``import lcf3d`` stays quick
_LAZY = {
    "LateCascadeFusion": "lcf3d.fusion.pipeline",
    "FusionConfig": "lcf3d.fusion.config",
    "FusedDetections": "lcf3d.provenance",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'lcf3d' has no attribute {name!r}")

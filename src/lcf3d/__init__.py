"""lcf3d: late-cascade fusion of camera and LiDAR detections for 3D object detection."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from lcf3d.distortion import Distortion
from lcf3d.errors import Lcf3dError
from lcf3d.frame import Frame
from lcf3d.structures import (
    ARGOVERSE_CLASSES,
    KITTI_CLASSES,
    NUSCENES_CLASSES,
    Camera,
    Detections2D,
    Detections3D,
    InstanceMask,
)

if TYPE_CHECKING:
    from lcf3d.api import draw, evaluate, evaluate_tracking, read_run, run
    from lcf3d.datasets.bag_export import write_bag
    from lcf3d.datasets.base import BaseDataset, Dataset
    from lcf3d.datasets.convert import write_kitti, write_nuscenes
    from lcf3d.datasets.folder_export import write_folder
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.datasets.nuscenes import NuscenesDataset
    from lcf3d.datasets.opening import open_dataset
    from lcf3d.demo.drive import demo_frames
    from lcf3d.detectors.classes import to_classes
    from lcf3d.detectors.lidar.export import export_onnx
    from lcf3d.detectors.named import load_detector
    from lcf3d.evaluation.domain_shift import DOMAINS, adapt_points
    from lcf3d.evaluation.generalization import evaluate_generalization
    from lcf3d.formats.coco import read_camera_detections, read_coco_index, read_coco_results
    from lcf3d.formats.plain import read_detections_2d, read_detections_3d, write_detections_2d, write_detections_3d
    from lcf3d.fusion.alignment_watch import AlignmentWatch, WatchSettings
    from lcf3d.fusion.calibration import Calibration
    from lcf3d.fusion.clocs import ClocsFusion
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.fusion.evidence import Evidence
    from lcf3d.fusion.memory import remember_sequence
    from lcf3d.fusion.pipeline import LateCascadeFusion
    from lcf3d.fusion.self_calibration import self_calibrate
    from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
    from lcf3d.live.fuser import Fuser
    from lcf3d.live.messages import CameraBoxes, CameraModel, EgoPose, Image, LidarBoxes, Scan
    from lcf3d.live.settings import LiveSettings
    from lcf3d.live.synchronizer import SyncSettings
    from lcf3d.localizers.geometric import GeometricLocalizer
    from lcf3d.localizers.named import load_localizer
    from lcf3d.localizers.shapes import SHAPES, ObjectShape
    from lcf3d.provenance import FusedDetections
    from lcf3d.reasons import Outcome, Reason
    from lcf3d.simulation.frames import simulate_drive, simulate_frame

try:
    __version__ = version("lcf3d")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0+unknown"

# name -> module; scipy, numba and pydantic are imported when first needed, so that ``import lcf3d`` stays quick
_LAZY = {
    "AlignmentWatch": "fusion.alignment_watch",
    "CameraBoxes": "live.messages",
    "CameraModel": "live.messages",
    "EgoPose": "live.messages",
    "Fuser": "live.fuser",
    "Image": "live.messages",
    "LidarBoxes": "live.messages",
    "LiveSettings": "live.settings",
    "Scan": "live.messages",
    "SyncSettings": "live.synchronizer",
    "WatchSettings": "fusion.alignment_watch",
    "BaseDataset": "datasets.base",
    "Calibration": "fusion.calibration",
    "ClocsFusion": "fusion.clocs",
    "Dataset": "datasets.base",
    "Evidence": "fusion.evidence",
    "FusedDetections": "provenance",
    "FusionConfig": "fusion.config",
    "KittiDataset": "datasets.kitti",
    "LateCascadeFusion": "fusion.pipeline",
    "NuscenesDataset": "datasets.nuscenes",
    "Outcome": "reasons",
    "Reason": "reasons",
    "StereoConfig": "fusion.stereo",
    "StereoLateCascadeFusion": "fusion.stereo",
    "DOMAINS": "evaluation.domain_shift",
    "GeometricLocalizer": "localizers.geometric",
    "ObjectShape": "localizers.shapes",
    "SHAPES": "localizers.shapes",
    "adapt_points": "evaluation.domain_shift",
    "demo_frames": "demo.drive",
    "draw": "api",
    "evaluate_generalization": "evaluation.generalization",
    "evaluate": "api",
    "evaluate_tracking": "api",
    "export_onnx": "detectors.lidar.export",
    "load_detector": "detectors.named",
    "load_localizer": "localizers.named",
    "open_dataset": "datasets.opening",
    "read_camera_detections": "formats.coco",
    "read_coco_index": "formats.coco",
    "read_coco_results": "formats.coco",
    "read_detections_2d": "formats.plain",
    "read_detections_3d": "formats.plain",
    "read_run": "api",
    "remember_sequence": "fusion.memory",
    "run": "api",
    "self_calibrate": "fusion.self_calibration",
    "simulate_drive": "simulation.frames",
    "simulate_frame": "simulation.frames",
    "to_classes": "detectors.classes",
    "write_detections_2d": "formats.plain",
    "write_detections_3d": "formats.plain",
    "write_bag": "datasets.bag_export",
    "write_folder": "datasets.folder_export",
    "write_kitti": "datasets.convert",
    "write_nuscenes": "datasets.convert",
}

__all__ = [
    "ARGOVERSE_CLASSES",
    "DOMAINS",
    "KITTI_CLASSES",
    "NUSCENES_CLASSES",
    "SHAPES",
    "AlignmentWatch",
    "BaseDataset",
    "Calibration",
    "Camera",
    "CameraBoxes",
    "CameraModel",
    "ClocsFusion",
    "Dataset",
    "Detections2D",
    "Detections3D",
    "Distortion",
    "EgoPose",
    "Evidence",
    "Frame",
    "FusedDetections",
    "Fuser",
    "FusionConfig",
    "GeometricLocalizer",
    "Image",
    "InstanceMask",
    "KittiDataset",
    "LateCascadeFusion",
    "Lcf3dError",
    "LidarBoxes",
    "LiveSettings",
    "NuscenesDataset",
    "ObjectShape",
    "Outcome",
    "Reason",
    "Scan",
    "StereoConfig",
    "StereoLateCascadeFusion",
    "SyncSettings",
    "WatchSettings",
    "adapt_points",
    "demo_frames",
    "draw",
    "evaluate",
    "evaluate_generalization",
    "evaluate_tracking",
    "export_onnx",
    "load_detector",
    "load_localizer",
    "open_dataset",
    "read_camera_detections",
    "read_coco_index",
    "read_coco_results",
    "read_detections_2d",
    "read_detections_3d",
    "read_run",
    "remember_sequence",
    "run",
    "self_calibrate",
    "simulate_drive",
    "simulate_frame",
    "to_classes",
    "write_bag",
    "write_detections_2d",
    "write_detections_3d",
    "write_folder",
    "write_kitti",
    "write_nuscenes",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"lcf3d.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'lcf3d' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

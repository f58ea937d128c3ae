"""The whole demonstration: frames, fusion variants, metrics, pictures."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.demo.detectors import camera_detections, ground_truth, lidar_detections
from lcf3d.demo.shipped import read_drive
from lcf3d.evaluation.generalization import GeneralizationMetrics, evaluate_generalization
from lcf3d.fusion.clustering import cluster_boxes
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.geometry.camera import project_boxes
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D, Detections3D, Frame

FRAMES = 20


@dataclass(frozen=True, eq=False)
class DemoFrame:
    """One moment of the drive with what the detectors say of it.

    Attributes:
        frame: scan, image, camera and ground truth: labelled objects with at least five returns.
        lidar: 3D detections without non-maximum suppression.
        camera: 2D detections by camera name.
    """

    frame: Frame
    lidar: Detections3D
    camera: dict[str, Detections2D]


def demo_frames(count: int = FRAMES, seed: int = 0) -> Iterator[DemoFrame]:
    """The first ``count`` frames of the shipped drive; ``seed`` is that of the detectors' faults.

    Raises:
        FormatError: the shipped archive is damaged.
    """
    for index, shipped in enumerate(read_drive(count=count)):
        rng = np.random.default_rng([seed, index])
        name = shipped.camera.name
        frame = Frame(shipped.id, shipped.points, (shipped.camera,), {name: shipped.image}, ground_truth(shipped))
        yield DemoFrame(frame, lidar_detections(shipped, rng), {name: camera_detections(shipped, rng)})


def lidar_alone(lidar: Detections3D, views: Sequence[Any]) -> Detections3D:
    """What a LiDAR detector gives by itself: after suppression, in view of a camera, as the ground truth is."""
    kept = cluster_boxes(lidar.boxes, lidar.scores, lidar.labels, method="nms").representative
    seen = np.any([project_boxes(lidar.boxes[kept], view)[1] for view in views], axis=0)
    return lidar[kept[seen]]


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What came out.

    Attributes:
        frames: the frames of the drive.
        fused: the full fusion's result on each.
        metrics: by variant: ``LiDAR alone``, then the presets ``paper`` and ``kitti`` without and with recovery.
        fusion_ms: median milliseconds of the full fusion a frame.
    """

    frames: list[DemoFrame]
    fused: list[FusedDetections]
    metrics: dict[str, GeneralizationMetrics]
    fusion_ms: float


def fuse_all(preset: str, recovery: bool, frames: Sequence[DemoFrame]) -> list[FusedDetections]:
    """All frames fused with the settings of a preset."""
    fusion = LateCascadeFusion(FusionConfig.preset(preset).updated(recovery=recovery))
    return [fusion(item.frame, item.lidar, item.camera) for item in frames]


def run_demo(frames: list[DemoFrame]) -> DemoResult:
    """Fuse and evaluate the frames of the drive."""
    full = LateCascadeFusion(FusionConfig.preset("kitti"))
    fused, times = [], []
    full(frames[0].frame, frames[0].lidar, frames[0].camera)  # compiles or loads what it needs
    for item in frames:
        start = time.perf_counter()
        fused.append(full(item.frame, item.lidar, item.camera))
        times.append((time.perf_counter() - start) * 1e3)
    variants = {"LiDAR alone": [lidar_alone(item.lidar, item.frame.cameras) for item in frames]}
    for preset in ("paper", "kitti"):
        variants[f"{preset}: matching"] = [f.detections for f in fuse_all(preset, False, frames)]
        recovered = fused if preset == "kitti" else fuse_all(preset, True, frames)
        variants[f"{preset}: matching + recovery"] = [f.detections for f in recovered]
    truth = [item.frame.labels for item in frames]
    metrics = {
        name: evaluate_generalization([t for t in truth if t is not None], found) for name, found in variants.items()
    }
    return DemoResult(frames, fused, metrics, sorted(times)[len(times) // 2])


def write_pictures(result: DemoResult, folder: Path) -> list[Path]:
    """One PNG a frame and an animation; gives the paths written."""
    from lcf3d.formats.files import atomic_path
    from lcf3d.visualization.png import draw_frame, save_png
    from lcf3d.visualization.scene import Scene

    pictures, paths = [], []
    for item, fused in zip(result.frames, result.fused, strict=True):
        picture = draw_frame(item.frame, Scene.from_fused(fused, item.frame.labels))
        paths.append(folder / f"{item.frame.id}.png")
        save_png(picture, paths[-1])
        pictures.append(picture.resize((picture.width // 2, picture.height // 2)))
    paths.append(folder / "drive.gif")
    with atomic_path(paths[-1]) as temporary:
        pictures[0].save(temporary, save_all=True, append_images=pictures[1:], duration=200, loop=0, format="GIF")
    return paths

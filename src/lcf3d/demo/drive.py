"""The whole demonstration: frames, both networks, the paper's ablation, metrics, pictures."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from lcf3d.datasets.drive import ShippedFrame, every_beam, read_drive
from lcf3d.detectors.base import CameraDetector, LidarDetector
from lcf3d.detectors.named import load_detector
from lcf3d.evaluation.ablation import suppressed
from lcf3d.evaluation.generalization import GeneralizationMetrics, evaluate_generalization
from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.localizers.named import ShippedLocalizer
from lcf3d.provenance import FusedDetections
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D

FRAMES = 20
CLASS_OF = {"Car": "Car", "Van": "Car", "Pedestrian": "Pedestrian", "Cyclist": "Cyclist"}
"""What the networks were taught to call the labelled things."""
LEAST_POINTS = 5
DRAWN_SCORE = 0.2
"""Boxes of a lower score are not drawn."""
LIDARS = {"64 beams": 1, "16 beams": 4}
"""LiDARs of the demonstration: one in so many beams of the shipped scan; the network was trained for the first."""
LIDAR_ALONE = "LiDAR alone"
FULL = "default (kitti preset)"
_FILTER: dict[str, Any] = {"unmatched": "drop", "ensemble": "none", "recovery": False}
VARIANTS: dict[str, dict[str, Any]] = {
    "paper's filter": _FILTER,
    "filter, recovery": {**_FILTER, "recovery": True},
    FULL: {},
}
"""Rows of the table: changes to the preset ``kitti``. The filter deletes what no camera confirms."""

T = TypeVar("T")


@dataclass(frozen=True)
class Detectors:
    """The two branches."""

    lidar: LidarDetector
    camera: CameraDetector


@dataclass(frozen=True, eq=False)
class DemoFrame:
    """One moment of the drive, seen by one LiDAR, with what the networks say of it.

    Attributes:
        frame: scan, image, camera and ground truth: labelled objects with five returns of the dense LiDAR or more.
        lidar: 3D detections without non-maximum suppression.
        camera: 2D detections by camera name.
        fused: of the full fusion.
        milliseconds: ``LiDAR network``, ``camera network``, ``fusion``; ``frame`` since the frame before was done.
    """

    frame: Frame
    lidar: Detections3D
    camera: dict[str, Detections2D]
    fused: FusedDetections
    milliseconds: dict[str, float]


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What came out with one LiDAR.

    Attributes:
        frames: the frames of the drive.
        metrics: by variant, `LIDAR_ALONE` first.
        fusion_ms: median milliseconds of the fusion by variant.
        stage_ms: median milliseconds by stage, of ``frame`` the mean, see `DemoFrame`.
    """

    frames: list[DemoFrame]
    metrics: dict[str, GeneralizationMetrics]
    fusion_ms: dict[str, float]
    stage_ms: dict[str, float]

    @property
    def frames_per_second(self) -> float:
        """Frames that the loop handles in a second: both networks and the full fusion."""
        return 1000 / self.stage_ms["frame"]


def shipped_detectors() -> Detectors:
    """The networks that come with lcf3d, one thread each: they run at the same time.

    Raises:
        DetectorError: a file of the package is missing.
    """
    return Detectors(
        load_detector("shipped:kitti?threads=1", "lidar", KITTI_CLASSES),
        load_detector("shipped:kitti?threads=1", "camera", KITTI_CLASSES),
    )


def ground_truth(frame: ShippedFrame) -> Detections3D:
    """Labelled objects with at least `LEAST_POINTS` returns; all are in view of the camera."""
    names = [CLASS_OF.get(str(name), "") for name in frame.objects.class_names]
    rows = np.flatnonzero(np.isin(names, KITTI_CLASSES))
    boxes = frame.objects.boxes[rows]
    labels = np.array([KITTI_CLASSES.index(names[row]) for row in rows], dtype=np.int64)
    seen = points_in_boxes(frame.points, boxes).sum(axis=1) >= LEAST_POINTS
    return Detections3D(boxes[seen], np.ones(int(seen.sum())), labels[seen], KITTI_CLASSES)


def demo_frames(count: int = FRAMES, beam_step: int = 1) -> list[Frame]:
    """Frames of the simulated drive that comes with lcf3d, with image, scan, labels and time; no extra is needed.

    Args:
        count: the first so many of the 20 frames, a tenth of a second apart.
        beam_step: keep one in so many of the 64 beams.

    Raises:
        FormatError: the shipped archive is damaged.
    """
    return [_frame(item, i, beam_step) for i, item in enumerate(read_drive(count=count))]


def _frame(item: ShippedFrame, number: int, beam_step: int) -> Frame:
    images = {item.camera.name: item.image}
    points = every_beam(item.points, beam_step)
    return Frame(item.id, points, (item.camera,), images, ground_truth(item), number / 10, sequence="demo")


def drive(detectors: Detectors, count: int = FRAMES) -> Iterator[dict[str, DemoFrame]]:
    """The first ``count`` moments of the shipped drive, by `LIDARS`: both networks, then the fusion.

    The networks have a thread each, and begin with the next frame while this one is fused.

    Raises:
        FormatError: the shipped archive is damaged.
    """
    shipped = read_drive(count=count)
    fusion = LateCascadeFusion(FusionConfig.preset("kitti"), ShippedLocalizer())
    moments = [[_frame(item, i, step) for step in LIDARS.values()] for i, item in enumerate(shipped)]
    with ThreadPoolExecutor(2) as pool:
        # compiles or loads what it needs
        _finished(_begun(moments[0][0], detectors, pool), fusion, 0.0)
        begun = _one_ahead(_begun(frame, detectors, pool) for moment in moments for frame in moment)
        last = time.perf_counter()
        for _ in moments:
            seen = {}
            for name in LIDARS:
                seen[name], last = _finished(next(begun), fusion, last)
            yield seen


class _Begun(NamedTuple):
    """A frame that both networks are at work on; each gives what it finds and the milliseconds it took."""

    frame: Frame
    lidar: Future[tuple[Detections3D, float]]
    camera: Future[tuple[Detections2D, float]]


def _begun(frame: Frame, detectors: Detectors, pool: ThreadPoolExecutor) -> _Begun:
    points, (image,) = frame.points, frame.images.values()
    assert points is not None
    lidar = pool.submit(_timed, lambda: detectors.lidar(points))
    return _Begun(frame, lidar, pool.submit(_timed, lambda: detectors.camera([image])[0]))


def _one_ahead(items: Iterable[T]) -> Iterator[T]:
    """The items, each handed out after the next one was made."""
    rest = iter(items)
    waiting = deque(islice(rest, 1))
    while waiting:
        waiting.extend(islice(rest, 1))
        yield waiting.popleft()


def _finished(begun: _Begun, fusion: LateCascadeFusion, last: float) -> tuple[DemoFrame, float]:
    """A frame fused, and when that was; ``last`` is when the frame before was."""
    frame = begun.frame
    (boxes, lidar_ms), (found, camera_ms) = begun.lidar.result(), begun.camera.result()
    camera = dict.fromkeys(frame.images, found)
    fused, fusion_ms = _timed(partial(fusion, frame, boxes, camera))
    now = time.perf_counter()
    spent = {"LiDAR network": lidar_ms, "camera network": camera_ms, "fusion": fusion_ms, "frame": (now - last) * 1e3}
    return DemoFrame(frame, boxes, camera, fused, spent), now


def _timed(call: Callable[[], T]) -> tuple[T, float]:
    """A result and the milliseconds that it took."""
    started = time.perf_counter()
    result = call()
    return result, (time.perf_counter() - started) * 1e3


def lidar_alone(lidar: Detections3D, views: Sequence[Any]) -> Detections3D:
    """What a LiDAR detector gives by itself: after suppression, in view of a camera, as the ground truth is."""
    kept = suppressed(lidar)
    return kept[np.any([project_boxes(kept.boxes, view)[1] for view in views], axis=0)]


def measure(frames: list[DemoFrame]) -> DemoResult:
    """Fuse the frames of one LiDAR by all variants, and evaluate them."""
    found = {LIDAR_ALONE: [lidar_alone(item.lidar, item.frame.cameras) for item in frames]}
    milliseconds: dict[str, float] = {}
    for name, changes in VARIANTS.items():
        if name == FULL:
            timed = [(item.fused, item.milliseconds["fusion"]) for item in frames]
        else:
            fusion = LateCascadeFusion(FusionConfig.preset("kitti").updated(**changes), ShippedLocalizer())
            timed = [_timed(partial(fusion, item.frame, item.lidar, item.camera)) for item in frames]
        found[name] = [fused.detections for fused, _ in timed]
        milliseconds[name] = float(np.median([spent for _, spent in timed]))
    truth = [item.frame.labels for item in frames]
    metrics = {
        name: evaluate_generalization([t for t in truth if t is not None], results) for name, results in found.items()
    }
    stages = {name: float(np.median([f.milliseconds[name] for f in frames])) for name in frames[0].milliseconds}
    # two frames are under way at once: what passes between their ends is short and long in turn
    stages["frame"] = float(np.mean([f.milliseconds["frame"] for f in frames]))
    return DemoResult(frames, metrics, milliseconds, stages)


def write_pictures(frames: Sequence[DemoFrame], folder: Path) -> list[Path]:
    """One PNG a frame and an animation; gives the paths written."""
    from lcf3d.visualization.png import draw_frame, save_gif, save_png
    from lcf3d.visualization.scene import Scene

    pictures, paths = [], []
    for item in frames:
        picture = draw_frame(item.frame, Scene.from_fused(item.fused, item.frame.labels, DRAWN_SCORE))
        paths.append(folder / f"{item.frame.id}.png")
        save_png(picture, paths[-1])
        pictures.append((None, picture))
    paths.append(folder / "drive.gif")
    save_gif(pictures, paths[-1])
    return paths

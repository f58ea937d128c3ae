"""A dataset through both branches and the fusion into a run folder, frame by frame, resumable."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.detectors.base import CameraDetector, LidarDetector
from lcf3d.detectors.results import CameraResults, LidarResults
from lcf3d.errors import DatasetError
from lcf3d.formats.run_folder import RunFolder
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.provenance import FusedDetections, Reason, Stage
from lcf3d.structures import Detections2D, Detections3D, Frame


@dataclass
class FrameSummary:
    """What happened to one frame.

    Attributes:
        frame_id: the frame.
        outputs: fused detections by stage and class, for example ``("recovered", "Pedestrian")``.
        dropped: LiDAR detections dropped, by reason.
        seconds: by part: ``lidar``, ``camera``, ``fusion``, ``write``.
    """

    frame_id: str
    outputs: Counter[tuple[str, str]] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass
class FrameRunner:
    """Runs single frames: detectors, fusion, files.

    Attributes:
        dataset: where frames come from.
        lidar: the LiDAR branch.
        cameras: the camera branch of each camera that is used, by camera name.
        fusion: the fusion.
        folder: where results go.
        prepare: applied to each branch's detections before fusion (score calibration), or None.
    """

    dataset: KittiDataset
    lidar: LidarResults | LidarDetector
    cameras: dict[str, CameraResults | CameraDetector]
    fusion: LateCascadeFusion
    folder: RunFolder
    prepare: Callable[[Detections3D], Detections3D] | None = None

    def __call__(self, frame_id: str) -> FrameSummary:
        """Fuse one frame and write its files."""
        marks = [time.perf_counter()]
        frame = self.dataset.frame(frame_id)
        lidar = self.detect_lidar(frame)
        marks.append(time.perf_counter())
        camera = {name: self.detect_camera(frame, name) for name in self.cameras}
        marks.append(time.perf_counter())
        fused = self.fusion(frame, lidar, camera)
        marks.append(time.perf_counter())
        self.folder.write(frame, fused)
        marks.append(time.perf_counter())
        parts = ("lidar", "camera", "fusion", "write")
        seconds = {name: b - a for name, a, b in zip(parts, marks, marks[1:], strict=False)}
        return summarize(frame_id, fused, seconds)

    def detect_lidar(self, frame: Frame) -> Detections3D:
        """The LiDAR branch's detections of one frame."""
        if isinstance(self.lidar, LidarResults):
            found = self.lidar.detect(frame)
        else:
            if frame.points is None:
                raise DatasetError(f"frame {frame.id} has no scan for the LiDAR detector; pass results:DIR instead")
            found = self.lidar(frame.points)
        return self.prepare(found) if self.prepare else found

    def detect_camera(self, frame: Frame, name: str) -> Detections2D:
        """One camera's detections of one frame."""
        detector = self.cameras[name]
        if isinstance(detector, CameraResults):
            return detector.detect(frame, name)
        if name not in frame.images:
            raise DatasetError(f"frame {frame.id} has no image of camera {name!r}; pass results:DIR instead")
        return detector([frame.images[name]])[0]


def summarize(frame_id: str, fused: FusedDetections, seconds: dict[str, float]) -> FrameSummary:
    """Count what the fusion of one frame decided."""
    names = fused.detections.class_names
    outputs = Counter(
        (Stage(stage).name.lower(), names[label])
        for stage, label in zip(fused.stages, fused.detections.labels, strict=True)
    )
    dropped = Counter(Reason(reason).name.lower() for reason in fused.lidar.reason[fused.dropped_lidar])
    return FrameSummary(frame_id, outputs, dropped, seconds)


_worker: FrameRunner


def _start_worker(runner: FrameRunner) -> None:
    global _worker
    _worker = runner


def _work(frame_id: str) -> FrameSummary:
    return _worker(frame_id)


def run_frames(runner: FrameRunner, frame_ids: Sequence[str], jobs: int = 1) -> Iterator[FrameSummary]:
    """Summaries of the frames in order, as they are done.

    Args:
        runner: what to do with a frame.
        frame_ids: the frames.
        jobs: processes; more than one pays where no detector runs, since those use all cores themselves.
    """
    if jobs <= 1:
        yield from map(runner, frame_ids)
        return
    # the runner travels to the workers by fork, so that results read once are not copied
    context = get_context("fork")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    chunk = max(1, min(16, len(frame_ids) // (4 * jobs)))
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(runner,)) as pool:
        try:
            yield from pool.map(_work, frame_ids, chunksize=chunk)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def pending_frames(folder: RunFolder, frame_ids: Sequence[str]) -> list[str]:
    """The frames that have no complete result yet."""
    return [frame_id for frame_id in frame_ids if not folder.is_done(frame_id)]


def total(summaries: Sequence[FrameSummary]) -> dict[str, Any]:
    """Counts over all frames and the median milliseconds of each part, as plain JSON values."""
    outputs: Counter[tuple[str, str]] = Counter()
    dropped: Counter[str] = Counter()
    for summary in summaries:
        outputs += summary.outputs
        dropped += summary.dropped
    by_stage: dict[str, dict[str, int]] = {}
    for (stage, name), count in sorted(outputs.items()):
        by_stage.setdefault(stage, {})[name] = count
    parts = summaries[0].seconds if summaries else {}
    median = {part: sorted(s.seconds[part] for s in summaries)[len(summaries) // 2] * 1e3 for part in parts}
    return {
        "frames": len(summaries),
        "outputs": by_stage,
        "dropped_lidar": dict(sorted(dropped.items())),
        "median_ms": {part: round(value, 3) for part, value in median.items()},
    }

"""A dataset through both branches and the fusion into a run folder, frame by frame, resumable."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from time import perf_counter
from typing import Any, Protocol

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.errors import DatasetError
from lcf3d.fusion.alignment import Alignment
from lcf3d.processes import end_with_parent, workers
from lcf3d.provenance import FusedDetections, Outcome, Reason
from lcf3d.run.alignment import aligned_frame
from lcf3d.run.folder import RunFolder
from lcf3d.run.sources import DetectorOnFrames, LidarOnScans
from lcf3d.structures import Detections2D, Detections3D, Frame


class Fusion(Protocol):
    """What a run asks of a fusion: `LateCascadeFusion` or its stereo form."""

    def __call__(self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D]) -> FusedDetections:
        """Fuse the detections of one frame."""
        ...


@dataclass
class FrameSummary:
    """What happened to one frame.

    Attributes:
        frame_id: the frame.
        outputs: fused detections by outcome and class, for example ``("recovered", "Pedestrian")``.
        dropped: LiDAR detections dropped, by reason.
        notes: what was missing or left out.
        milliseconds: by part: ``lidar``, ``camera``, ``fusion``, ``write``.
    """

    frame_id: str
    outputs: Counter[tuple[str, str]] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    notes: tuple[str, ...] = ()
    milliseconds: dict[str, float] = field(default_factory=dict)


@dataclass
class FrameRunner:
    """Runs single frames: detections, fusion, files.

    Attributes:
        dataset: where frames come from.
        lidar: the LiDAR branch.
        cameras: the camera branch of each camera that is used, by camera name.
        fusion: the fusion.
        folder: where results go.
        alignment: how cameras stand beside what their calibration says, by name.
    """

    dataset: Dataset
    lidar: LidarSource
    cameras: dict[str, CameraSource]
    fusion: Fusion
    folder: RunFolder
    alignment: Mapping[str, Alignment] = field(default_factory=dict)

    def __call__(self, frame_id: str) -> FrameSummary:
        """Fuse one frame and write its files."""
        marks = [perf_counter()]
        frame = self.dataset.frame(frame_id)
        lidar = self.lidar.detect(frame)
        marks.append(perf_counter())
        camera = self.detect_cameras(frame)
        marks.append(perf_counter())
        fused = self._with_missing(self.fusion(aligned_frame(frame, self.alignment), lidar, camera), frame)
        marks.append(perf_counter())
        self.folder.write(frame, fused)
        marks.append(perf_counter())
        parts = ("lidar", "camera", "fusion", "write")
        spent = {name: (b - a) * 1e3 for name, a, b in zip(parts, marks[:-1], marks[1:], strict=True)}
        # a camera that this run was never to use is nothing to report
        unused = tuple(f"camera {camera.name} " for camera in frame.cameras if camera.name not in self.cameras)
        notes = tuple(note for note in fused.notes if not note.startswith(unused))
        return replace(summarize(frame_id, fused, spent), notes=notes)

    def _with_missing(self, fused: FusedDetections, frame: Frame) -> FusedDetections:
        """The same with a note on what the run uses and this frame lacks: cameras, or what the LiDAR detector wants."""
        there = {camera.name for camera in frame.cameras}
        notes = [
            f"camera {name} is missing from this frame or too far off in time and was not used: nobody looked there"
            for name in self.cameras
            if name not in there
        ]
        if isinstance(self.lidar, (LidarOnScans, DetectorOnFrames)):
            notes += self.lidar.notes(frame)
        return replace(fused, notes=(*fused.notes, *notes)) if notes else fused

    def detect_cameras(self, frame: Frame) -> dict[str, Detections2D]:
        """2D detections of every camera that the frame has and that can be looked through.

        None where the dataset left all cameras out of the frame: the LiDAR branch then stands alone.

        Raises:
            DatasetError: there are cameras, but nothing to detect from in any of them.
        """
        there = {camera.name for camera in frame.cameras} & set(self.cameras)
        found = {
            name: source.detect(frame, name)
            for name, source in self.cameras.items()
            if name in there and source.sees(frame, name)
        }
        if there and not found:
            raise DatasetError(
                f"frame {frame.id} has no image of {' or '.join(self.cameras)}; pass results:PATH as the camera branch"
            )
        return found


def summarize(frame_id: str, fused: FusedDetections, milliseconds: dict[str, float]) -> FrameSummary:
    """Count what the fusion of one frame decided."""
    names = fused.detections.class_names
    outputs = Counter(
        (Outcome(outcome).name.lower(), names[label])
        for outcome, label in zip(fused.outcomes, fused.detections.labels, strict=True)
    )
    dropped = Counter(Reason(reason).name.lower() for reason in fused.lidar.reason[fused.dropped_lidar])
    return FrameSummary(frame_id, outputs, dropped, milliseconds=milliseconds)


_worker: FrameRunner


def _start_worker(runner: FrameRunner) -> None:
    global _worker
    _worker = runner
    end_with_parent()


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
    # by fork, so that results read once are shared and not sent
    context = get_context("fork")
    chunk = max(1, min(16, len(frame_ids) // (4 * jobs)))
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(runner,)) as pool:
        try:
            with workers("fusing: the frames that are done are kept, go on with --resume and fewer --jobs"):
                yield from pool.map(_work, frame_ids, chunksize=chunk)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def total(summaries: Sequence[FrameSummary]) -> dict[str, Any]:
    """Counts over all frames, frames by note, and the median milliseconds of each part, as plain JSON values."""
    outputs: Counter[tuple[str, str]] = Counter()
    dropped: Counter[str] = Counter()
    notes: Counter[str] = Counter()
    for summary in summaries:
        outputs += summary.outputs
        dropped += summary.dropped
        notes.update(set(summary.notes))
    by_outcome: dict[str, dict[str, int]] = {}
    for (outcome, name), count in sorted(outputs.items()):
        by_outcome.setdefault(outcome, {})[name] = count
    parts = summaries[0].milliseconds if summaries else {}
    medians = {part: sorted(s.milliseconds[part] for s in summaries)[len(summaries) // 2] for part in parts}
    return {
        "frames": len(summaries),
        "outputs": by_outcome,
        "dropped_lidar": dict(sorted(dropped.items())),
        "notes": dict(notes.most_common()),
        "median_ms": {part: round(value, 3) for part, value in medians.items()},
    }

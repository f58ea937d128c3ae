"""A dataset through both branches and the fusion into a run folder, frame by frame, resumable."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_all_start_methods, get_context, get_start_method
from time import perf_counter
from typing import Any, Protocol

import numpy as np

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import Alignment
from lcf3d.fusion.memory import remember
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_smooth import smooth_sequence
from lcf3d.fusion.memory_state import Memory
from lcf3d.processes import end_with_parent, workers
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import OUTCOMES, REASONS
from lcf3d.remote.places import is_watching, watch
from lcf3d.run.alignment import aligned_frame
from lcf3d.run.folder import RunFolder
from lcf3d.run.sources import DetectorOnFrames, LidarOnScans
from lcf3d.run.table_folder import SHARD_FRAMES, TableRunFolder
from lcf3d.structures import Detections2D, Detections3D


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
        milliseconds: by part: ``lidar``, ``camera``, ``fusion``, ``memory`` where there is one, ``write``.
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
        memory: settings of the memory of past frames; None to judge every frame alone. Frames are then to come in the
            order of `lcf3d.run.sequences.in_order`.
        smooth: whether later frames testify too, see `lcf3d.fusion.memory_smooth`.
    """

    dataset: Dataset
    lidar: LidarSource
    cameras: dict[str, CameraSource]
    fusion: Fusion
    folder: RunFolder
    alignment: Mapping[str, Alignment] = field(default_factory=dict)
    memory: MemoryConfig | None = None
    smooth: bool = False
    _remembered: dict[str | None, Memory | None] = field(default_factory=dict, init=False, repr=False)

    def __call__(self, frame_id: str) -> FrameSummary:
        """Fuse one frame, add what the memory of its sequence says, and write its files."""
        frame, fused, spent = self._fuse(frame_id)
        if self.memory is not None:
            before = perf_counter()
            past = self._remembered.get(frame.sequence)
            seen = aligned_frame(frame, self.alignment)
            self._remembered[frame.sequence], fused = remember(past, fused, seen, self.memory)
            spent["memory"] = (perf_counter() - before) * 1e3
        return self._write(frame, fused, spent)

    def run_sequence(self, frame_ids: Sequence[str]) -> Iterator[FrameSummary]:
        """The frames of one sequence, in order of time; with ``smooth`` all are fused before the first is written."""
        if self.memory is None or not self.smooth:
            yield from map(self, frame_ids)
            return
        done = []
        for frame_id in frame_ids:
            _, fused, spent = self._fuse(frame_id)
            # the frame anew, so that no scan of the sequence stays in memory
            done.append((self.dataset.frame(frame_id), fused, spent))
        pairs = [(aligned_frame(frame, self.alignment), fused) for frame, fused, _ in done]
        smoothed = smooth_sequence(pairs, self.memory)
        for (frame, _, spent), fused in zip(done, smoothed, strict=True):
            yield self._write(frame, fused, spent)

    def _fuse(self, frame_id: str) -> tuple[Frame, FusedDetections, dict[str, float]]:
        """One frame, its fused detections judged alone, and the milliseconds of each part."""
        marks = [perf_counter()]
        frame = self.dataset.frame(frame_id)
        lidar = self.lidar.detect(frame)
        marks.append(perf_counter())
        camera = self.detect_cameras(frame)
        marks.append(perf_counter())
        fused = self._with_missing(self.fusion(aligned_frame(frame, self.alignment), lidar, camera), frame)
        marks.append(perf_counter())
        parts = zip(("lidar", "camera", "fusion"), marks[:-1], marks[1:], strict=True)
        return frame, fused, {name: (b - a) * 1e3 for name, a, b in parts}

    def _write(self, frame: Frame, fused: FusedDetections, spent: dict[str, float]) -> FrameSummary:
        """Write the files of a frame and sum up what happened to it."""
        before = perf_counter()
        self.folder.write(frame, fused)
        spent["write"] = (perf_counter() - before) * 1e3
        # a camera that this run was never to use is nothing to report
        unused = tuple(f"camera {camera.name} " for camera in frame.cameras if camera.name not in self.cameras)
        notes = tuple(note for note in fused.notes if not note.startswith(unused))
        return replace(summarize(frame.id, fused, spent), notes=notes)

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
    outputs: Counter[tuple[str, str]] = Counter()
    dropped: Counter[str] = Counter()
    # counted as numbers, named after it
    codes = np.bincount(fused.outcomes * len(names) + fused.detections.labels)
    for code in codes.nonzero()[0].tolist():
        outputs[OUTCOMES[code // len(names)], names[code % len(names)]] = int(codes[code])
    reasons = np.bincount(fused.lidar.reason[fused.dropped_lidar])
    for reason in reasons.nonzero()[0].tolist():
        dropped[REASONS[reason]] = int(reasons[reason])
    return FrameSummary(frame_id, outputs, dropped, milliseconds=milliseconds)


_worker: FrameRunner


def _start_worker(runner: FrameRunner | bytes) -> None:
    global _worker
    if isinstance(runner, bytes):
        # a process that was started anew knows nothing of places elsewhere
        elsewhere, content = pickle.loads(runner)
        if elsewhere:
            watch()
        _worker = pickle.loads(content)
    else:
        _worker = runner
    end_with_parent()


def _work(frame_ids: Sequence[str]) -> list[FrameSummary]:
    return list(run_shard(_worker, frame_ids))


def run_shard(runner: FrameRunner, frame_ids: Sequence[str]) -> Iterator[FrameSummary]:
    """Summaries of the frames of one shard; its files are there when the last is taken."""
    with runner.folder.shard():
        yield from runner.run_sequence(frame_ids)


def shards_of(folder: RunFolder, frame_ids: Sequence[str], size: int) -> list[Sequence[str]]:
    """Stretches of frames of that size; tables have the same shards whoever fuses them."""
    size = SHARD_FRAMES if isinstance(folder, TableRunFolder) else size
    return [frame_ids[start : start + size] for start in range(0, len(frame_ids), size)]


def run_frames(
    runner: FrameRunner, frame_ids: Sequence[str], jobs: int = 1, sequences: Sequence[Sequence[str]] | None = None
) -> Iterator[FrameSummary]:
    """Summaries of the frames in order, as they are done.

    Args:
        runner: what to do with a frame.
        frame_ids: the frames.
        jobs: processes; more than one pays where no detector runs, since those use all cores themselves. They start
            as `multiprocessing.set_start_method` says, else by fork where there is such a thing.
        sequences: the same frames in groups that must not be taken apart; any frame can be apart without.

    Raises:
        ConfigError: processes cannot be forked, and what runs cannot be sent to them.
    """
    if sequences is None:
        sequences = shards_of(runner.folder, frame_ids, max(1, min(16, len(frame_ids) // (4 * jobs))))
    if jobs <= 1:
        for sequence in sequences:
            yield from run_shard(runner, sequence)
        return
    method = get_start_method(allow_none=True) or ("fork" if "fork" in get_all_start_methods() else "spawn")
    # forked processes share what was read; others are sent it
    sent = runner if method == "fork" else _pickled(runner)
    context = get_context(method)
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(sent,)) as pool:
        try:
            with workers("fusing: the frames that are done are kept, go on with --resume and fewer --jobs"):
                for done in pool.map(_work, sequences):
                    yield from done
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _pickled(runner: FrameRunner) -> bytes:
    try:
        return pickle.dumps((is_watching(), pickle.dumps(runner)))
    except Exception as error:
        raise ConfigError(
            f"what this run is made of cannot be sent to other processes ({error}), and they cannot be forked here; "
            "leave --jobs out, or start a process for each --shard i/n"
        ) from None


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

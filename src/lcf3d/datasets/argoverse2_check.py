"""Sanity rules of Argoverse 2 logs, and of a file of results that belongs to them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from lcf3d.datasets.argoverse2_frames import id_of, split_id
from lcf3d.datasets.argoverse2_log import Argoverse2Log
from lcf3d.datasets.argoverse2_results import ArgoverseLidarResults, result_file
from lcf3d.datasets.check import Finding, check_frames
from lcf3d.errors import Lcf3dError
from lcf3d.formats.argoverse import read_submission
from lcf3d.frame import Frame
from lcf3d.structures import ARGOVERSE_CLASSES

RULES = {
    "ARG01": "calibration, poses and annotations of every log can be read",
    "ARG02": "the calibration describes all cameras",
    "ARG03": "there is an ego pose at the time of every frame",
    "ARG04": "every annotated moment has a sweep",
    "ARG05": "the file of results is well-formed and belongs to these logs",
    "ARG06": "scores lie in [0, 1] (else a calibration is needed)",
}


class ArgoverseLogs(Protocol):
    """What the rules ask of an Argoverse 2 dataset."""

    log_ids: tuple[str, ...]
    camera_names: tuple[str, ...]

    def log(self, log_id: str) -> Argoverse2Log:
        """The log of that id."""
        ...

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id."""
        ...


class _Readable:
    """The frames of the logs that can be read."""

    def __init__(self, dataset: ArgoverseLogs, ids: tuple[str, ...]) -> None:
        self.ids = ids
        self._dataset = dataset

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id."""
        return self._dataset.frame(frame_id)


def check_argoverse2(
    dataset: ArgoverseLogs, results: Path | None = None, progress: Callable[[], None] = lambda: None
) -> list[Finding]:
    """Everything that `RULES` find wrong, then the rules of every dataset on the logs that can be read.

    Args:
        dataset: the logs to look at; sweeps and images are read.
        results: a file in the submission form, or None.
        progress: called after every frame.
    """
    findings: list[Finding] = []
    ids: list[str] = []
    for log_id in dataset.log_ids:
        try:
            log = dataset.log(log_id)
            times = log.times()
            absent = [name for name in dataset.camera_names if name not in log.calibration.intrinsics]
            annotated = np.zeros(0, np.int64) if log.annotations is None else np.unique(log.annotations.timestamps_ns)
            placed = [int(time) for time in times if log.has_pose(int(time))]
        except Lcf3dError as error:
            findings.append(Finding("ARG01", "error", f"log {log_id}: {error}"))
            continue
        if absent:
            findings.append(Finding("ARG02", "warning", f"log {log_id} has no calibration of {', '.join(absent)}"))
        if len(placed) < len(times):
            count = f"{len(times) - len(placed)} of {len(times)}"
            findings.append(Finding("ARG03", "error", f"log {log_id} has no ego pose for {count} frames"))
        lacking = [int(time) for time in annotated if int(time) not in log.sweeps]
        if lacking:
            count = f"{len(lacking)} of {len(annotated)} annotated moments have no sweep, first {lacking[0]}"
            findings.append(Finding("ARG04", "warning", f"log {log_id}: {count}"))
        ids += [id_of(log_id, time) for time in placed]
    if results is not None:
        findings += _check_results(tuple(ids), results)
    return findings + check_frames(_Readable(dataset, tuple(ids)), progress=progress)


def _check_results(frame_ids: tuple[str, ...], results: Path) -> Iterator[Finding]:
    try:
        ArgoverseLidarResults(results, frame_ids, ARGOVERSE_CLASSES, "error")
        found = read_submission(result_file(results))
    except Lcf3dError as error:
        yield Finding("ARG05", "error", str(error))
        return
    known = {split_id(frame_id) for frame_id in frame_ids}
    sweeps = set(zip((found.log_ids[i] for i in found.logs), found.timestamps_ns.tolist(), strict=True))
    others = sweeps - known
    if others:
        yield Finding("ARG05", "warning", f"{results} holds boxes of {len(others)} sweeps that are no frames here")
    outside = int(((found.scores < 0) | (found.scores > 1)).sum())
    if outside:
        yield Finding("ARG06", "warning", f"{results}: {outside} of {len(found)} scores lie outside [0, 1]")

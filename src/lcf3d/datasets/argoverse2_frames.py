"""Frame ids of Argoverse 2, ``LOG_TIME`` with the time in nanoseconds, and results by them."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.formats.argoverse import Cuboids
from lcf3d.structures import Detections3D


def id_of(log_id: str, time: int) -> str:
    """The id of a log's frame at a time in nanoseconds."""
    return f"{log_id}_{time}"


def split_id(id: str) -> tuple[str, int]:
    """Log and time in nanoseconds of a frame id.

    Raises:
        DatasetError: it is none.
    """
    log_id, _, time = id.rpartition("_")
    if not log_id or not time.isdigit():
        raise DatasetError(f"an Argoverse 2 frame is named LOG_TIME with the time in nanoseconds, got {id!r}")
    return log_id, int(time)


def results_of_frames(detections: Mapping[str, Detections3D]) -> Cuboids:
    """Cuboids of detections by frame id, in each frame's LiDAR frame."""
    by_log: dict[str, dict[int, Detections3D]] = {}
    for id, found in detections.items():
        log_id, time = split_id(id)
        by_log.setdefault(log_id, {})[time] = found
    return Cuboids.concatenate([Cuboids.from_detections(log_id, found) for log_id, found in by_log.items()])


def detections_by_frame(cuboids: Cuboids) -> dict[str, Detections3D]:
    """Detections by frame id of the sweeps that have any."""
    order = np.lexsort((cuboids.timestamps_ns, cuboids.logs))
    ordered = cuboids[order]
    change = (np.diff(ordered.timestamps_ns) != 0) | (np.diff(ordered.logs) != 0)
    starts = np.concatenate([[0], np.flatnonzero(change) + 1, [len(ordered)]])
    return {
        id_of(ordered.log_ids[ordered.logs[a]], int(ordered.timestamps_ns[a])): ordered[a:b].detections()
        for a, b in pairwise(starts.tolist())
        if b > a
    }

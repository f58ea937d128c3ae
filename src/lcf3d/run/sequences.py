"""Frames in the order in which a memory of past frames needs them: whole sequences, each by time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from lcf3d.datasets.base import Dataset
from lcf3d.errors import DatasetError


def in_order(dataset: Dataset, frame_ids: Sequence[str]) -> list[list[str]]:
    """The frames by sequence, in the order in which the sequences first appear, those of each by time.

    Frames of no sequence, or without a time, are groups of their own.

    Raises:
        DatasetError: no frame tells its sequence and time, so that there is nothing to remember.
    """
    groups: dict[str, list[tuple[float, int, str]]] = {}
    result: list[list[str]] = []
    placed: dict[str, int] = {}
    for rank, frame_id in enumerate(frame_ids):
        frame = dataset.frame(frame_id)
        if frame.sequence is None or frame.timestamp is None:
            result.append([frame_id])
            continue
        if frame.sequence not in groups:
            placed[frame.sequence] = len(result)
            result.append([])
        groups.setdefault(frame.sequence, []).append((frame.timestamp, rank, frame_id))
    if frame_ids and not groups:
        raise DatasetError(
            f"no frame tells its sequence and time (first {frame_ids[0]}), so there is no past to remember; run "
            "without --memory, or give the frames of a drive (KITTI: ids SEQUENCE_FRAME)"
        )
    for sequence, members in groups.items():
        result[placed[sequence]] = [frame_id for _, _, frame_id in sorted(members)]
    return result


def pending(sequences: Sequence[Sequence[str]], is_done: Callable[[str], bool]) -> list[Sequence[str]]:
    """The sequences that are not done in full: an interrupted one begins anew, since its memory is gone."""
    return [sequence for sequence in sequences if not all(is_done(frame_id) for frame_id in sequence)]

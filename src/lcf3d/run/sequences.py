"""Frames in the order in which a memory of past frames needs them: whole sequences, each by time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

from lcf3d.datasets.base import Dataset
from lcf3d.errors import DatasetError
from lcf3d.frame import Frame

if TYPE_CHECKING:
    from lcf3d.run.setup import Run


def in_order(dataset: Dataset, frame_ids: Sequence[str]) -> list[list[str]]:
    """The frames by sequence, in the order in which the sequences first appear, those of each by time.

    Frames of no sequence, or without a time, are groups of their own.

    Raises:
        DatasetError: no frame tells its sequence and time, so that there is nothing to remember.
    """
    return [[frame_ids[place] for place in group] for group in places_in_order(map(dataset.frame, frame_ids))]


def places_in_order(frames: Iterable[Frame], told: bool = True) -> list[list[int]]:
    """The same by place: groups of indices into ``frames``; see `in_order`. ``told``: some frame has to tell."""
    groups: dict[str, list[tuple[float, int]]] = {}
    result: list[list[int]] = []
    placed: dict[str, int] = {}
    first = None
    for place, frame in enumerate(frames):
        first = first or frame.id
        if frame.sequence is None or frame.timestamp is None:
            result.append([place])
            continue
        if frame.sequence not in groups:
            placed[frame.sequence] = len(result)
            result.append([])
        groups.setdefault(frame.sequence, []).append((frame.timestamp, place))
    if told and first is not None and not groups:
        raise DatasetError(
            f"no frame tells its sequence and time (first {first}), so there is no past to remember; leave --memory "
            "out, or give the frames of a drive (KITTI: ids SEQUENCE_FRAME)"
        )
    for sequence, members in groups.items():
        result[placed[sequence]] = [place for _, place in sorted(members)]
    return result


def pending_frames(run: Run) -> tuple[list[str], list[Sequence[str]] | None]:
    """The frames of a run that are still to be done; and, where it remembers earlier ones, in whole sequences."""
    if run.runner.memory is None:
        return [frame_id for frame_id in run.frame_ids if not run.folder.is_done(frame_id)], None
    sequences = pending(in_order(run.dataset, run.frame_ids), run.folder.is_done)
    return [frame_id for sequence in sequences for frame_id in sequence], sequences


def pending(sequences: Sequence[Sequence[str]], is_done: Callable[[str], bool]) -> list[Sequence[str]]:
    """The sequences that are not done in full: an interrupted one begins anew, since its memory is gone."""
    return [sequence for sequence in sequences if not all(is_done(frame_id) for frame_id in sequence)]

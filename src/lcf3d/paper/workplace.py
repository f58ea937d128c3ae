"""Where the paper is measured, what came of a row, and the settings of a row's run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lcf3d.paper.estimates import DATA
from lcf3d.paper.networks import NeedsError, branches
from lcf3d.paper.tables import Row, Table

# a LiDAR branch alone goes through the same run, which then changes nothing: no overlap is higher than 1
_ALONE = (
    "unmatched=keep",
    "out_of_view=keep",
    "ensemble=none",
    "recovery=false",
    "cluster_iou=1",
    "lidar_score_threshold=0",
    "camera_score_threshold=0.1",
)

Advance = Callable[[], None]


@dataclass(frozen=True)
class Workplace:
    """Where the paper is measured.

    Attributes:
        out: folder of the tables; runs lie in ``runs`` below it.
        roots: folder by kind of dataset, ``kitti`` or ``nuscenes``, of those that are there.
        uses: what stands for the paper's networks, see `lcf3d.paper.networks.spec_of`.
        results: result files of systems by name of the row, measured instead of running them.
        device: torch device of the networks.
        overwrite: begin runs anew that were made with other settings or inputs.
        begin: is told what begins and of how many frames, and gives what to call after each.
    """

    out: Path
    roots: Mapping[str, Path]
    uses: Mapping[str, str] = field(default_factory=dict)
    results: Mapping[str, Path] = field(default_factory=dict)
    device: str = "cpu"
    overwrite: bool = False
    begin: Callable[[str, int], Advance] = lambda name, frames: lambda: None


@dataclass(frozen=True)
class Measured:
    """What came of a row.

    Attributes:
        values: by column, None where it cannot be measured.
        frames: how many it was measured on.
        notes: what a reader has to know.
    """

    values: tuple[float | None, ...]
    frames: int = 0
    notes: tuple[str, ...] = ()


def settings_of(table: Table, row: Row) -> tuple[str, ...]:
    """The changes to the paper's preset that make the row's run."""
    if not row.camera:
        return _ALONE
    cascade = () if row.lidar_used else ("lidar_score_threshold=1",)
    changes = {text.partition("=")[0]: text for text in (*table.changes, *row.changes, *cascade)}
    if changes.get("recovery") == "recovery=false":
        changes.pop("enlargement", None)
    return tuple(changes.values())


def run_name(table: Table, row: Row) -> str:
    """Folder name of a row's run: rows of different tables that run the same share it."""
    parts = [*row.networks, *(["stereo"] if row.stereo else []), *(settings_of(table, row) if row.camera else [])]
    return "+".join(parts).replace("/", "-")


def needed(table: Table, row: Row, place: Workplace) -> tuple[str, str, str]:
    """LiDAR, camera and localizer of a row, see `lcf3d.paper.networks.branches`, all of whose data is here too.

    Raises:
        NeedsError: data or weights are not here; all that is absent is named.
    """
    absent: list[str] = []
    found = ("", "", "")
    try:
        found = branches(row, place.uses, place.device)
    except NeedsError as error:
        absent += error.parts
    try:
        root_of(row.task[1] if row.task else table.data[0], place)
    except NeedsError as error:
        absent += error.parts
    if absent:
        raise NeedsError(*absent)
    return found


def root_of(kind: str, place: Workplace) -> Path:
    """The folder of a dataset.

    Raises:
        NeedsError: it was not named; says how large it is.
    """
    if kind not in place.roots:
        raise NeedsError(f"--{kind} FOLDER: {DATA[kind]}")
    return place.roots[kind]


def without_values(table: Table, *notes: str) -> Measured:
    """A row that could not be measured, and why."""
    return Measured((None,) * len(table.columns), 0, notes)

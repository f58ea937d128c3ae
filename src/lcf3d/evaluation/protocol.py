"""What a dataset's evaluation offers, so that every verb works with every dataset.

A dataset names its evaluation (`lcf3d.datasets.base.Dataset.evaluation`); `lcf3d.evaluation.opening`
finds it. The official protocols of KITTI, nuScenes and Argoverse 2 are evaluations; datasets without one of their own
are measured by centre distance (`lcf3d.evaluation.distance`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from lcf3d.errors import ConfigError
from lcf3d.evaluation.bootstrap import Interval
from lcf3d.evaluation.study import Study
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray


@dataclass(frozen=True)
class EvaluationOptions:
    """What people may ask of an evaluation; each refuses what it does not know (`refuse_options`).

    Attributes:
        classes: only these classes.
        iou: ``CLASS=VALUE`` or ``CLASS:MEASURE=VALUE`` items.
        front: only what the front camera sees.
        nds_hat: NDS^ and what it is made of, without velocities and attributes (paper section 5.2).
    """

    classes: tuple[str, ...] = ()
    iou: tuple[str, ...] = ()
    front: bool = False
    nds_hat: bool = False


class TableData(NamedTuple):
    """A table for people, printed by the command line and shown in the report.

    Attributes:
        title: above it.
        columns: headings; the first column is left-aligned, all others right-aligned.
        rows: cells; a last row that sums up may follow a None.
        notes: sentences below it.
    """

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...] | None]
    notes: tuple[str, ...] = ()


class ComparisonRow(NamedTuple):
    """One number of two result sets and how sure their difference is.

    Attributes:
        class_name: evaluated class.
        measure: what was measured, for example ``3D`` or ``AP``.
        level: difficulty or matching distance, in words; may be empty.
        first: value of the first result set, percent, with its interval.
        second: the same of the second.
        difference: second minus first, with the interval of the paired difference (the same frames drawn for both).
    """

    class_name: str
    measure: str
    level: str
    first: Interval
    second: Interval
    difference: Interval


class Verdict(NamedTuple):
    """Detections of many frames, frame after frame, judged against the labels.

    Attributes:
        judged: (N,) whether the protocol judges a detection (it is not ignored, too small or too far).
        right: (N,) 1 for a true positive, else 0.
    """

    judged: BoolArray
    right: FloatArray


class ResultSet(Protocol):
    """Results read and measured."""

    name: str

    def to_json(self) -> dict[str, Any]:
        """The metrics as plain JSON values."""
        ...

    def tables(self) -> list[TableData]:
        """The metrics for people."""
        ...

    def study(self) -> Study:
        """A closer look, for the report."""
        ...


class Evaluation(Protocol):
    """The metric of a dataset over some of its frames.

    Attributes:
        heading: what `figures` gives, for example ``3D AP R40``.
        columns: names of the figures of a class.
        class_names: classes that are evaluated.
        frame_ids: the frames.
    """

    frame_ids: tuple[str, ...]
    heading: str
    columns: tuple[str, ...]
    class_names: tuple[str, ...]

    def figures(self, results: Sequence[Detections3D]) -> dict[str, tuple[float, ...]]:
        """The figures of every class, percent, NaN where undefined, of detections by frame (LiDAR frames)."""
        ...

    def judge_lidar(self, found: Sequence[Detections3D], source: Any = None) -> Verdict:
        """Which 3D detections are right; ``source`` is where they were read from, if that is known."""
        ...

    def judge_camera(self, found: Sequence[Mapping[str, Detections2D]], source: Any = None) -> Verdict:
        """Which 2D detections are right, camera after camera in each frame."""
        ...

    def read(self, path: Path, name: str, missing: str = "error") -> ResultSet:
        """Result files, or those of a run folder, measured."""
        ...

    def compare(self, first: Any, second: Any, samples: int, seed: int) -> list[ComparisonRow]:
        """Two result sets of this evaluation, with bootstrap intervals over frames."""
        ...


class TrackingResult(Protocol):
    """Tracks read and measured."""

    def to_json(self) -> dict[str, Any]:
        """The measures as plain JSON values."""
        ...

    def table(self) -> TableData:
        """The measures for people."""
        ...


class TrackingEvaluation(Protocol):
    """The measure of tracks over some frames of a dataset."""

    def read(self, path: Path, missing: str = "error") -> TrackingResult:
        """Tracks in the dataset's form, or those of a run folder, measured."""
        ...


def refuse_options(what: str, options: EvaluationOptions, *names: str) -> None:
    """Refuse those of the named options that were given.

    Raises:
        ConfigError: one was.
    """
    defaults = EvaluationOptions()
    for field in fields(options):
        if field.name in names and getattr(options, field.name) != getattr(defaults, field.name):
            flag = "class" if field.name == "classes" else field.name
            raise ConfigError(f"--{flag} does not go with {what}; leave it out")


def tracked_classes(options: EvaluationOptions, known: Sequence[str], who: str) -> tuple[str, ...]:
    """The classes whose tracks are to be measured: those asked for, else all that are known.

    Args:
        options: what was asked for.
        known: classes of the measure.
        who: says of it what it does with these, for messages.

    Raises:
        ConfigError: an unknown class, or an option for other evaluations.
    """
    refuse_options("--tracking", options, "iou", "front", "nds_hat")
    unknown = [name for name in options.classes if name not in known]
    if unknown:
        raise ConfigError(f"--tracking does not know class {unknown[0]!r}; {who} {', '.join(known)}")
    return options.classes or tuple(known)


def frames_note(counted: int, every: int, drives: int, name: str) -> str:
    """How many frames of how many a measure counts, in a sentence; ``name`` is what the data set calls its drives."""
    of = f"frames of {drives} {name}{'' if drives == 1 else 's'}"
    if counted == every:
        return f"counted: all {every} {of}"
    return f"counted: {counted} of the {every} {of}: those that the run covers"

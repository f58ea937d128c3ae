"""The tables of what was decided: a row an input (`Decisions`), a row for the track of every output (`TrackTable`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from lcf3d.reasons import OUTCOMES, REASONS, Outcome, Reason
from lcf3d.structures import BoolArray, FloatArray, IntArray

WHOLE = ("cluster", "lidar", "camera", "detection", "output", "pair")
"""Columns of `Decisions` that hold numbers of something, -1 for none."""
REAL = ("iou", "lidar_score", "camera_score", "score", "quality")
"""Columns of `Decisions` that hold measures, NaN for none."""


@dataclass(eq=False)
class Decisions:
    """One row an input, in the order of the inputs; -1 and NaN stand for none.

    The stages of the fusion fill the columns; in `FusedDetections` they are read-only.

    Attributes:
        outcome: `Outcome` codes.
        reason: `Reason` codes.
        cluster: cluster of the LiDAR box, or of the LiDAR box that a camera detection matched.
        lidar: index of the LiDAR detection (for camera rows: of the representative it matched).
        camera: index into ``FusedDetections.camera_names`` of the camera (for LiDAR rows: of the primary match).
        detection: index of the 2D detection within its camera.
        iou: image IoU that decided.
        lidar_score: score of the LiDAR detection before fusion.
        camera_score: score of the 2D detection before fusion.
        score: score after fusion.
        output: index of the output detection this input led to.
        quality: how good the localizer believed its fit to be (camera rows).
        pair: row of the camera table with the other view's detection of the same object, where a stereo pair has two.
    """

    outcome: IntArray
    reason: IntArray
    cluster: IntArray
    lidar: IntArray
    camera: IntArray
    detection: IntArray
    iou: FloatArray
    lidar_score: FloatArray
    camera_score: FloatArray
    score: FloatArray
    output: IntArray
    pair: IntArray
    quality: FloatArray

    @classmethod
    def blank(cls, n: int) -> Decisions:
        """``n`` rows of dropped inputs, all else unset; the fusion fills its columns."""
        # one block a type: a table is made for every frame
        whole, real = np.empty((len(WHOLE) + 2, n), dtype=np.int64), np.empty((len(REAL), n))
        whole.fill(-1)
        real.fill(np.nan)
        whole[0], whole[1] = Outcome.DROPPED.value, Reason.LOW_SCORE.value
        columns: dict[str, Any] = dict(zip(("outcome", "reason", *WHOLE, *REAL), (*whole, *real), strict=True))
        return cls(**columns)

    def __len__(self) -> int:
        return len(self.outcome)

    def freeze(self) -> None:
        """Make all columns read-only: what was decided stays."""
        for column in self.__dict__.values():
            column.setflags(write=False)

    def as_lists(self) -> Decisions:
        """The same with lists for columns: single cells are read much quicker than those of arrays."""
        columns: dict[str, Any] = {name: column.tolist() for name, column in self.__dict__.items()}
        return Decisions(**columns)

    def columns(self) -> dict[str, list[Any]]:
        """Each column in words and numbers, None where unset."""
        result: dict[str, list[Any]] = {
            "outcome": [OUTCOMES[code] for code in self.outcome.tolist()],
            "reason": [REASONS[code] for code in self.reason.tolist()],
        }
        for name in WHOLE:
            result[name] = [None if value < 0 else value for value in getattr(self, name).tolist()]
        for name in REAL:
            # only NaN is not what it is
            result[name] = [None if value != value else value for value in getattr(self, name).tolist()]
        return result

    def row(self, index: int) -> dict[str, Any]:
        """One row of `columns`."""
        return {name: column[index] for name, column in self.columns().items()}

    def rows(self) -> list[dict[str, Any]]:
        """All rows of `columns`."""
        columns = self.columns()
        return [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]

    @classmethod
    def from_rows(cls, rows: Sequence[dict[str, Any]]) -> Decisions:
        """The inverse of `rows`."""
        decisions = cls.blank(len(rows))
        for i, row in enumerate(rows):
            # lcf3d 0.1 wrote "stage", and another word for a class that the camera does not detect
            decisions.outcome[i] = Outcome[row["outcome" if "outcome" in row else "stage"].upper()]
            reason = row["reason"].upper()
            decisions.reason[i] = Reason["CLASS_NOT_DETECTED" if reason == "NOT_JUDGED" else reason]
            for column in fields(cls)[2:]:
                # provenance written before a column existed lacks it
                if row.get(column.name) is not None:
                    getattr(decisions, column.name)[i] = row[column.name]
        return decisions


@dataclass(frozen=True, eq=False)
class TrackTable:
    """What the memory of past frames says of the outputs, one row an output, see `lcf3d.fusion.memory`.

    Attributes:
        ids: number of the track, the same in every frame of a sequence.
        ages_s: seconds since it was first seen.
        hits: number of frames that saw it, this one included.
        unseen_s: seconds since it was last seen; 0 for what this frame sees, more for predicted boxes.
        support: what past frames say for it, see `lcf3d.fusion.memory_evidence`.
        log_odds: log-odds that the memory added; those of the whole box for predicted ones.
    """

    ids: IntArray
    ages_s: FloatArray
    hits: IntArray
    unseen_s: FloatArray
    support: FloatArray
    log_odds: FloatArray

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: Any) -> TrackTable:
        """The rows selected by a slice, an integer array or a boolean mask."""
        return TrackTable(*(getattr(self, column.name)[index] for column in fields(self)))

    @property
    def predicted(self) -> BoolArray:
        """(N,) the boxes that no detection of this frame led to."""
        return self.unseen_s > 0

    def to_json(self) -> dict[str, list[Any]]:
        """Columns as plain JSON values."""
        return {column.name: np.round(getattr(self, column.name), 5).tolist() for column in fields(self)}

    @classmethod
    def from_json(cls, value: dict[str, list[Any]]) -> TrackTable:
        """The inverse of `to_json`."""
        columns: dict[str, Any] = {name: np.array(values) for name, values in value.items()}
        for name in columns:
            columns[name] = columns[name].astype(np.int64 if name in ("ids", "hits") else np.float64)
        return cls(**columns)

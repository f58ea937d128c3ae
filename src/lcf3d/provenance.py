"""What the fusion returns: detections, and for every input and output the reason why it is there or not."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan
from typing import Any

import numpy as np

from lcf3d.decisions import Decisions, TrackTable
from lcf3d.errors import FormatError
from lcf3d.reasons import OUTCOMES, REASON_TEXT, Outcome, Reason
from lcf3d.structures import Detections2D, Detections3D, IntArray


@dataclass(frozen=True, eq=False)
class FusedDetections:
    """Result of the fusion of one frame.

    Attributes:
        detections: (N) the fused 3D detections, highest score first.
        lidar: decisions on the LiDAR detections, one row each, in input order.
        camera: decisions on the camera detections, camera after camera, in input order.
        lidar_inputs: the LiDAR detections that were given.
        camera_inputs: the 2D detections that were given, by position in ``camera_names``.
        camera_names: the cameras that were used.
        notes: what was missing or left out, one sentence each.
        tracks: what the memory says of the outputs; None where frames are judged alone.
    """

    detections: Detections3D
    lidar: Decisions
    camera: Decisions
    lidar_inputs: Detections3D
    camera_inputs: tuple[Detections2D, ...]
    camera_names: tuple[str, ...]
    notes: tuple[str, ...] = ()
    tracks: TrackTable | None = None

    def __post_init__(self) -> None:
        for table in (self.lidar, self.camera):
            table.freeze()

    def __len__(self) -> int:
        return len(self.detections)

    def reordered(self, detections: Detections3D, order: IntArray, tracks: TrackTable) -> FusedDetections:
        """The same inputs with other outputs.

        Args:
            detections: the new outputs.
            order: (N,) for each of them which output it was; numbers from the old count on are of outputs that no
                input led to.
            tracks: of the new outputs.
        """
        place = np.empty(len(order) + 1, dtype=np.int64)
        place[order] = np.arange(len(order))
        place[-1] = -1  # no output before, none now
        tables = [copy(self.lidar), copy(self.camera)]
        for table in tables:
            table.output = place[table.output]
        return replace(self, detections=detections, lidar=tables[0], camera=tables[1], tracks=tracks)

    @cached_property
    def outcomes(self) -> IntArray:
        """(N,) `Outcome` of every output."""
        outcomes = self.of_outputs("outcome", Outcome.KEPT.value)
        if self.tracks is not None:
            outcomes[self.tracks.predicted] = Outcome.PREDICTED
        outcomes.setflags(write=False)
        return outcomes

    def of_outputs(self, name: str, otherwise: int) -> IntArray:
        """(N,) a column of the decisions by output, ``otherwise`` where no input led to one."""
        values = np.full(len(self.detections), otherwise)
        for table in (self.camera, self.lidar):
            led = (table.output >= 0).nonzero()[0]
            values[table.output[led]] = getattr(table, name)[led]
        return values

    @property
    def origins(self) -> list[str]:
        """What became of every output, in words: an `Outcome`, or ``downweighted`` where no camera confirms it."""
        names = [Outcome(outcome).name.lower() for outcome in self.outcomes]
        lowered = self.lidar.output[self.lidar.reason == Reason.DOWNWEIGHTED]
        for output in lowered[lowered >= 0]:
            names[output] = "downweighted"
        return names

    @property
    def dropped_lidar(self) -> IntArray:
        """Indices of the LiDAR detections that were dropped, without those that another box of theirs represents."""
        reason = self.lidar.reason
        merged = (reason == Reason.IN_CLUSTER.value) | (reason == Reason.SUPPRESSED.value)
        dropped: IntArray = ((self.lidar.outcome == Outcome.DROPPED.value) & ~merged).nonzero()[0]
        return dropped

    def explain(self, output: int) -> str:
        """One sentence on why output ``output`` is there, with the numbers that decided."""
        predicted = self.tracks is not None and self.tracks.predicted[output]
        return self._sentence(output, "" if predicted else self._because(*self._origin(output), self.camera))

    def explanations(self) -> list[str]:
        """`explain` of every output; quicker than one after the other."""
        origins: dict[int, str] = {}
        lidar, camera = self.lidar.as_lists(), self.camera.as_lists()
        for table in (lidar, camera):
            for row, output in enumerate(table.output):
                if output >= 0 and output not in origins:
                    origins[output] = self._because(table, row, camera)
        return [self._sentence(output, origins.get(output, "")) for output in range(len(self))]

    def _sentence(self, output: int, because: str) -> str:
        """What an output is, why it is there (empty for one that only the memory predicts), and its past."""
        label = self.detections.class_names[self.detections.labels[output]]
        score = f"{label} {self.detections.scores[output]:.2f}"
        if self.tracks is None:
            return f"{score}, {because}"
        past = self._past_text(self.tracks, output)
        if self.tracks.predicted[output]:
            return f"{score}, predicted: no detection of this frame shows it, but {past}"
        return f"{score}, {because}; {past}"

    @staticmethod
    def _past_text(tracks: TrackTable, output: int) -> str:
        """The memory of an output in words."""
        track = f"track {tracks.ids[output]}"
        if tracks.hits[output] == 1:
            return f"{track} begins here ({tracks.log_odds[output]:+.2f} log-odds)"
        ago = f", the last {tracks.unseen_s[output]:.1f} s ago" if tracks.predicted[output] else ""
        return (
            f"{track} was seen in {tracks.hits[output]} frames over {tracks.ages_s[output]:.1f} s{ago} "
            f"(support {tracks.support[output]:.1f}, {tracks.log_odds[output]:+.2f} log-odds)"
        )

    def explain_lidar(self, index: int) -> str:
        """One sentence on what became of LiDAR detection ``index`` of those given."""
        label = self.lidar_inputs.class_names[self.lidar_inputs.labels[index]]
        return f"{label} {self.lidar_inputs.scores[index]:.2f}, {self._because(self.lidar, index, self.camera)}"

    def explain_camera(self, row: int) -> str:
        """One sentence on what became of the 2D detection in row ``row`` of ``camera``."""
        found = self.camera_inputs[self.camera.camera[row]]
        index = self.camera.detection[row]
        because = self._because(self.camera, row, self.camera)
        return f"{found.class_names[found.labels[index]]} {found.scores[index]:.2f}, {because}"

    def _because(self, table: Decisions, row: int, camera: Decisions) -> str:
        """Outcome, reason, and where a row comes from, in words; ``camera`` is the table of 2D detections."""
        parts = []
        if table.lidar[row] >= 0:
            parts.append(f"LiDAR detection {table.lidar[row]} (score {table.lidar_score[row]:.2f})")
        if table.camera[row] >= 0:
            parts.append(self._camera_text(table, row))
        if table.pair[row] >= 0:
            parts.append(self._camera_text(camera, int(table.pair[row])))
        overlap = "" if isnan(table.iou[row]) else f", image IoU {table.iou[row]:.2f}"
        if not isnan(table.quality[row]):
            overlap += f", fit {table.quality[row]:.2f}"
        reason = REASON_TEXT[Reason(table.reason[row])]
        return f"{OUTCOMES[table.outcome[row]]}: {reason}; from {' and '.join(parts)}{overlap}"

    def _camera_text(self, table: Decisions, row: int) -> str:
        """The 2D detection of a row in words."""
        name = self.camera_names[table.camera[row]]
        return f"{name} detection {table.detection[row]} (score {table.camera_score[row]:.2f})"

    def _origin(self, output: int) -> tuple[Decisions, int]:
        """The table and row that led to an output: the LiDAR row where there is one."""
        for table in (self.lidar, self.camera):
            rows = np.flatnonzero(table.output == output)
            if len(rows):
                return table, int(rows[0])
        raise IndexError(f"no output {output}: there are {len(self.detections)}")

    def to_json(self) -> dict[str, Any]:
        """Provenance as plain JSON values; read back with `from_json`."""
        tracks = {} if self.tracks is None else {"tracks": self.tracks.to_json()}
        return {
            **tracks,
            "cameras": list(self.camera_names),
            "notes": list(self.notes),
            "detections": _detections_to_json(self.detections),
            "lidar_inputs": _detections_to_json(self.lidar_inputs),
            "camera_inputs": [_detections_to_json(d) for d in self.camera_inputs],
            "lidar": self.lidar.rows(),
            "camera": self.camera.rows(),
        }

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> FusedDetections:
        """The inverse of `to_json`; instance masks are not kept.

        Raises:
            FormatError: a row refers to a detection or camera that is not there.
        """
        fused = cls(
            detections=Detections3D(**_detections_from_json(value["detections"])),
            lidar=Decisions.from_rows(value["lidar"]),
            camera=Decisions.from_rows(value["camera"]),
            lidar_inputs=Detections3D(**_detections_from_json(value["lidar_inputs"])),
            camera_inputs=tuple(Detections2D(**_detections_from_json(d)) for d in value["camera_inputs"]),
            camera_names=tuple(value["cameras"]),
            notes=tuple(str(note) for note in value["notes"]),
            tracks=TrackTable.from_json(value["tracks"]) if "tracks" in value else None,
        )
        fused.require_consistent()
        return fused

    def require_consistent(self) -> None:
        """See that every row refers to detections and cameras that are there.

        Raises:
            FormatError: one does not; names the column.
        """
        if len(self.camera_names) != len(self.camera_inputs):
            raise FormatError(f"{len(self.camera_inputs)} lists of 2D detections of {len(self.camera_names)} cameras")
        if len(self.lidar) != len(self.lidar_inputs) or len(self.camera) != sum(map(len, self.camera_inputs)):
            raise FormatError("a provenance needs one row a detection")
        counts = np.array([*map(len, self.camera_inputs), 0], dtype=np.int64)
        for table in (self.lidar, self.camera):
            limits = {
                "lidar": len(self.lidar_inputs),
                "camera": len(self.camera_names),
                "output": len(self.detections),
                "pair": len(self.camera),
            }
            for name, limit in limits.items():
                column = getattr(table, name)
                if len(column) and (column.min() < -1 or column.max() >= limit):
                    raise FormatError(f"column {name} of a provenance refers to what is not there")
            if len(table) and (table.detection >= np.where(table.camera >= 0, counts[table.camera], 0)).any():
                raise FormatError("column detection of a provenance refers to what is not there")
        led = np.concatenate([self.lidar.output, self.camera.output])
        # predicted boxes come from earlier frames
        tracks = self.tracks
        if tracks is not None and len(tracks) != len(self.detections):
            raise FormatError("a provenance needs one row of tracks an output")
        predicted = np.flatnonzero(tracks.predicted) if tracks is not None else np.zeros(0, dtype=np.int64)
        if len(np.unique(np.concatenate([led[led >= 0], predicted]))) != len(self.detections):
            raise FormatError("a provenance does not say what each output comes from")
        if len(self.camera) and (self.camera.camera < 0).any():
            raise FormatError("a row of a 2D detection names no camera")


def _detections_to_json(detections: Detections2D | Detections3D) -> dict[str, Any]:
    # five decimals are a hundredth of a millimetre, and a third of the size
    value: dict[str, Any] = {
        "boxes": np.round(detections.boxes, 5).tolist(),
        "scores": np.round(detections.scores, 7).tolist(),
        "labels": detections.labels.tolist(),
        "class_names": list(detections.class_names),
    }
    if isinstance(detections, Detections3D) and detections.velocities is not None:
        velocities = np.round(detections.velocities, 5)
        value["velocities"] = [None if np.isnan(v).any() else v.tolist() for v in velocities]
    if isinstance(detections, Detections3D) and detections.attributes is not None:
        value["attributes"] = detections.attributes.tolist()
    return value


def _detections_from_json(value: dict[str, Any]) -> dict[str, Any]:
    value = {**value, "class_names": tuple(value["class_names"])}
    if "velocities" in value:
        value["velocities"] = [[np.nan, np.nan] if v is None else v for v in value["velocities"]]
    return value

"""Settings of the memory: a few numbers a class, with defaults by what kind of thing the class name says."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lcf3d.structures import BoolArray, FloatArray

Weight = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]


class ClassMemory(BaseModel):
    """How objects of one class are remembered; the equations are in `lcf3d.fusion.memory_evidence`.

    Attributes:
        seen_weight: weight of past support for an object seen now.
        missed_weight: weight of past support for an object not seen now.
        base: log-odds that a predicted box starts below.
        speed_spread: standard deviation of velocities along an axis, m/s.
        acceleration: standard deviation of accelerations, m/s^2.
        turns: whether it moves along its heading.
        rigid: whether sizes, heights and positions are made better along the track; people change shape as they walk.
        upright: whether heights of what is not rigid are; people keep theirs.
        standing_doubt: how much more false alarms stand than objects do, 0 to 1: what is taken for a person and moves
            is one, a pole stands.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    seen_weight: Weight = 0.25
    missed_weight: Weight = 0.3
    base: float = 4.5
    speed_spread: Positive = 3.0
    acceleration: Positive = 3.0
    turns: bool = True
    rigid: bool = True
    upright: bool = True
    standing_doubt: float = Field(default=0.0, ge=0, lt=1)


VEHICLE = ClassMemory(seen_weight=0.1, missed_weight=0.15, speed_spread=6.0, acceleration=5.0)
RIDER = ClassMemory(seen_weight=0.4, missed_weight=0.4, standing_doubt=0.6)
BICYCLE = RIDER.model_copy(update={"standing_doubt": 0.0})  # parked ones are objects too
PERSON = ClassMemory(speed_spread=1.5, acceleration=1.5, turns=False, rigid=False, standing_doubt=0.6)
FIXTURE = ClassMemory(speed_spread=0.3, acceleration=0.1, turns=False)

_KINDS = (
    (VEHICLE, ("car", "van", "truck", "bus", "tram", "trailer", "construction_vehicle", "vehicle")),
    (RIDER, ("cyclist", "bicyclist", "motorcyclist")),
    (BICYCLE, ("bicycle", "motorcycle")),
    (PERSON, ("pedestrian", "person", "person_sitting")),
    (FIXTURE, ("traffic_cone", "barrier", "sign")),
)
_KIND_OF = {name: kind for kind, names in _KINDS for name in names}


class Motion(NamedTuple):
    """How objects of each class move.

    Attributes:
        speed_spread: (L,) standard deviation of an object's velocity along an axis before it is measured, m/s.
        acceleration: (L,) standard deviation of accelerations, m/s^2.
        turns: (L,) whether it moves along its heading.
    """

    speed_spread: FloatArray
    acceleration: FloatArray
    turns: BoolArray


class ClassColumns(NamedTuple):
    """Settings of L classes as arrays (L,), see `ClassMemory`, and how objects of the classes move."""

    seen_weight: FloatArray
    missed_weight: FloatArray
    base: FloatArray
    rigid: BoolArray
    upright: BoolArray
    standing_doubt: FloatArray
    motion: Motion


class MemoryConfig(BaseModel):
    """Settings of `lcf3d.fusion.memory`.

    Attributes:
        classes: by class name; names left out get what their name says (car, pedestrian, ...), else the defaults of
            `ClassMemory`.
        horizon_s: a track not seen for longer is forgotten, and no box is predicted for it.
        moving_horizon_s: the same for what surely moves, not longer than ``horizon_s``; between the two it goes by how
            probable it is that the object stands.
        max_gap_s: after a longer gap between frames the memory begins anew.
        max_tracks: only so many tracks, those seen last and best supported, are kept.
        min_hits: frames that must have seen an object before boxes are predicted for it.
        min_log_odds: predicted boxes below are not reported.
        predict: whether boxes are predicted at all.
        free_space: whether predicted boxes are tested against the scan, where there is one.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: dict[str, ClassMemory] = Field(default_factory=dict)
    horizon_s: Positive = 2.05
    moving_horizon_s: Positive = 1.55
    max_gap_s: Positive = 1.05
    max_tracks: int = Field(default=300, ge=1)
    min_hits: int = Field(default=2, ge=1)
    min_log_odds: float = -4.0
    predict: bool = True
    free_space: bool = True

    def of(self, class_name: str) -> ClassMemory:
        """The settings of a class."""
        known = self.classes.get(class_name)
        return known or _KIND_OF.get(class_name.lower(), ClassMemory())

    def with_classes(self, class_names: Iterable[str], **changes: Any) -> MemoryConfig:
        """The same with some settings of `ClassMemory` changed for the named classes."""
        changed = {name: self.of(name).model_copy(update=changes) for name in class_names}
        return self.model_copy(update={"classes": {**self.classes, **changed}})

    def columns(self, class_names: Sequence[str]) -> ClassColumns:
        """The settings of some classes, one column a setting."""
        every = [self.of(name) for name in class_names]
        motion = Motion(
            np.array([c.speed_spread for c in every]),
            np.array([c.acceleration for c in every]),
            np.array([c.turns for c in every], dtype=bool),
        )
        return ClassColumns(
            np.array([c.seen_weight for c in every]),
            np.array([c.missed_weight for c in every]),
            np.array([c.base for c in every]),
            np.array([c.rigid for c in every], dtype=bool),
            np.array([c.upright for c in every], dtype=bool),
            np.array([c.standing_doubt for c in every]),
            motion,
        )

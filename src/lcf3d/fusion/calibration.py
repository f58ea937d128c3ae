"""Score calibration: what a score of a detector means as a probability, by class and branch, in one JSON file.

Fitted on labelled frames by ``lcf3d calibrate`` (`lcf3d.fusion.calibration_fit`), or without labels on a run's own
frames with the camera as teacher (`lcf3d.fusion.self_calibration`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lcf3d.errors import ConfigError
from lcf3d.files import read_json, write_text
from lcf3d.fusion.evidence import Evidence, to_probability
from lcf3d.fusion.memory_config import ClassMemory, MemoryConfig
from lcf3d.remote.places import local
from lcf3d.structures import Detections, Detections2D, Detections3D, FloatArray, with_columns

Transform = Literal["identity", "log", "logit"]


def transform_scores(scores: FloatArray, transform: Transform) -> FloatArray:
    """Scores on the scale on which a calibration is linear.

    ``identity`` for logits, ``log`` (the signed ``log(1 + |s|)``, defined and rising everywhere) for scores without an
    upper bound, ``logit`` for scores in [0, 1].
    """
    if transform == "log":
        return np.asarray(np.sign(scores) * np.log1p(np.abs(scores)))
    if transform == "logit":
        inside = np.clip(scores, 1e-6, 1 - 1e-6)
        return np.asarray(np.log(inside) - np.log1p(-inside))
    return np.asarray(scores, dtype=np.float64)


class ScoreMap(BaseModel):
    """A rising map from a detector's score to the probability that the detection is right.

    Attributes:
        kind: ``platt``, a straight line in log-odds, or ``isotonic``, straight between fitted points.
        transform: of the score, before the line; see `transform_scores`.
        slope: of the line; for ``isotonic`` beyond the first and last point.
        intercept: of the line (``platt``).
        points: (transformed score, log-odds), both rising (``isotonic``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["platt", "isotonic"] = "platt"
    transform: Transform = "identity"
    slope: Annotated[float, Field(gt=0)]
    intercept: float = 0.0
    points: tuple[tuple[float, float], ...] = ()

    @model_validator(mode="after")
    def _check_points(self) -> ScoreMap:
        if (self.kind == "isotonic") != bool(self.points):
            raise ValueError("points belong to an isotonic map, which needs at least one")
        rising = all(a[0] < b[0] and a[1] < b[1] for a, b in zip(self.points[:-1], self.points[1:], strict=True))
        if not rising:
            raise ValueError("points must rise in both numbers")
        return self

    def log_odds(self, scores: FloatArray) -> FloatArray:
        """(N,) log-odds of (N,) scores."""
        x = transform_scores(scores, self.transform)
        if self.kind == "platt":
            return self.slope * x + self.intercept
        knots, values = np.array(self.points).T
        beyond = np.minimum(x - knots[0], 0) + np.maximum(x - knots[-1], 0)
        return np.asarray(np.interp(x, knots, values) + self.slope * beyond)

    def transformed_at(self, log_odds: FloatArray) -> FloatArray:
        """(N,) transformed scores that have (N,) log-odds: the inverse of `log_odds`, on the transformed scale."""
        if self.kind == "platt":
            return (log_odds - self.intercept) / self.slope
        knots, values = np.array(self.points).T
        beyond = np.minimum(log_odds - values[0], 0) + np.maximum(log_odds - values[-1], 0)
        return np.asarray(np.interp(log_odds, values, knots) + beyond / self.slope)

    def __call__(self, scores: FloatArray) -> FloatArray:
        """(N,) probabilities of (N,) scores."""
        return to_probability(self.log_odds(scores))


class Calibration(BaseModel):
    """Everything that was fitted for a pair of detectors.

    Attributes:
        version: of the file's layout.
        source: what it was fitted on, for people.
        lidar: score map by class of the LiDAR branch; classes left out keep their scores.
        camera: the same for the camera branch.
        evidence: weights by class; classes left out take those of the settings.
        camera_classes: the classes that the camera branch detects at all, None if all: boxes of other classes are not
            judged by it.
        ground_z: height of the ground under the sensor, LiDAR frame, metres; None if unknown.
        memory: how objects are remembered, by class (``lcf3d calibrate --memory``); classes left out take the defaults
            of their kind.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    source: str = ""
    lidar: dict[str, ScoreMap] = Field(default_factory=dict)
    camera: dict[str, ScoreMap] = Field(default_factory=dict)
    evidence: dict[str, Evidence] = Field(default_factory=dict)
    camera_classes: tuple[str, ...] | None = None
    ground_z: float | None = None
    memory: dict[str, ClassMemory] = Field(default_factory=dict)

    @classmethod
    def load(cls, path: Path | str) -> Calibration:
        """Read a calibration file.

        Raises:
            FormatError: the file is absent or not JSON.
            ConfigError: it is no calibration of this version; names the first wrong entry.
        """
        values = read_json(Path(path))
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise ConfigError(
                f"{path} is not a calibration file of version 1: {where + ': ' if where else ''}{first['msg']}; "
                "write one with 'lcf3d calibrate'"
            ) from None

    def dump(self, path: Path | str) -> None:
        """Write the file, whole or not at all."""
        write_text(Path(path), self.model_dump_json(indent=2) + "\n")

    def calibrate_lidar(self, detections: Detections3D) -> Detections3D:
        """The detections with probabilities as scores, where a map for their class is known."""
        return _with_probabilities(detections, self.lidar)

    def calibrate_camera(self, detections: Detections2D) -> Detections2D:
        """The detections with probabilities as scores, where a map for their class is known."""
        return _with_probabilities(detections, self.camera)

    def detects(self, class_name: str) -> bool:
        """Whether the camera branch detects a class at all."""
        return self.camera_classes is None or class_name in self.camera_classes


def _with_probabilities(detections: Detections, maps: Mapping[str, ScoreMap]) -> Detections:
    if not len(detections) or not maps:
        return detections
    scores = detections.scores.copy()
    for label, name in enumerate(detections.class_names):
        own = detections.labels == label
        if name in maps and own.any():
            scores[own] = maps[name](scores[own])
    return with_columns(detections, scores=scores)


def load_calibration(text: str) -> Calibration | None:
    """What ``--calibration`` names: a file, or ``none``. ``auto`` needs the run's frames: see `self_calibrate`.

    Raises:
        Lcf3dError: the file is absent or malformed.
    """
    if text == "none":
        return None
    if text == "auto":
        raise ConfigError("'auto' calibrates on the frames of a run: see lcf3d.fusion.self_calibration")
    return Calibration.load(local(text))


def memory_settings(calibration: Calibration | None, settings: MemoryConfig | None = None) -> MemoryConfig:
    """Settings of the memory of recent frames; classes that they leave out take the weights of a calibration.

    Args:
        calibration: of the detectors; None without any.
        settings: the defaults if None.
    """
    chosen = settings or MemoryConfig()
    fitted = calibration.memory if calibration else {}
    return chosen.model_copy(update={"classes": {**fitted, **chosen.classes}})


def ground_height(bottoms: FloatArray) -> float | None:
    """Height of the ground under the sensor: the median underside of boxes that are believed; None without any."""
    return float(np.median(bottoms)) if len(bottoms) else None


def natural_transform(scores: FloatArray) -> Transform:
    """``logit`` for scores in [0, 1], ``log`` for wide positive ones, ``identity`` (logits) for others."""
    if scores.min() >= 0 and scores.max() <= 1:
        return "logit"
    return "log" if scores.min() >= 0 else "identity"

"""Settings of the fusion: one frozen model, flat YAML, three presets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lcf3d.errors import ConfigError
from lcf3d.files import write_text
from lcf3d.fusion.evidence import Evidence
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES, FloatArray

Fraction = Annotated[float, Field(ge=0, le=1)]


class FusionConfig(BaseModel):
    """All settings of `LateCascadeFusion`; see docs/configuration.md for what each does.

    The defaults are METHOD's for KITTI-like data with one camera. Thresholds are exclusive: a score or IoU must be
    higher.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    class_names: tuple[str, ...] = Field(default=KITTI_CLASSES, min_length=1, description="classes to detect")
    camera_score_threshold: Fraction = Field(default=0.5, description="2D detections not above it are left out")
    decisive_score: Fraction = Field(
        default=0.0, description="2D detections not above it only support boxes of their class: no label, no recovery"
    )
    lidar_score_threshold: Fraction = Field(default=0.1, description="3D detections not above it are left out")
    max_boxes: int = Field(default=1000, ge=1, description="only so many 3D boxes of highest score a frame take part")

    clustering: Literal["cliques", "components", "nms"] = Field(
        default="cliques", description="how 3D boxes are grouped"
    )
    cluster_iou: Fraction = Field(default=0.3, description="tau_z: BEV IoU that links two boxes")
    class_aware: bool = Field(default=False, description="link boxes of equal class only")

    assignment: Literal["gated", "paper", "class_first"] = Field(
        default="gated", description="drop poor pairs before assigning, after it (paper), or pair equal classes first"
    )
    match_iou: Fraction = Field(default=0.4, description="tau_b: image IoU of a match")
    representative: Literal["highest_score", "camera_class"] = Field(
        default="highest_score", description="which member stands for a matched cluster"
    )
    unmatched: Literal["drop", "downweight", "keep"] = Field(
        default="drop", description="clusters in view that no camera confirms"
    )
    miss_likelihood: Fraction = Field(
        default=0.2, description="downweight: the score a camera silently gives what it does not detect"
    )
    out_of_view: Literal["keep", "drop"] = Field(default="keep", description="clusters that no used camera looks at")

    recovery: bool = Field(default=True, description="lift unmatched 2D detections into frustums")
    enlargement: Annotated[float, Field(ge=0)] = Field(default=0.05, description="e: growth of 2D boxes before lifting")
    min_points: int = Field(default=10, ge=1, description="p_min: fewest points of a frustum")
    mask_mode: Literal["box", "mask", "box+mask"] = Field(default="box", description="how instance masks are used")
    confirm_iou: Fraction = Field(default=0.3, description="tau_d: image IoU that confirms a recovered box")
    min_quality: Fraction = Field(default=0.3, description="least quality of the localizer's fit that is confirmed")
    duplicate_iou: Fraction = Field(
        default=0.1, description="BEV IoU with a confirmed box that makes a recovered one a double"
    )

    ensemble: Literal["probabilistic", "product", "evidence", "none"] = Field(
        default="probabilistic", description="how scores are fused; none keeps the LiDAR branch's score and class"
    )
    evidence: dict[str, Evidence] = Field(
        default_factory=dict, description="ensemble evidence: weights by class, where no calibration gives them"
    )
    relabel_score: Fraction = Field(
        default=0.0, description="where labels differ, a 2D detection above it gives label and score (Algorithm 1: all)"
    )
    priors: dict[str, Annotated[float, Field(gt=0, lt=1)]] = Field(
        default_factory=dict, description="prior by class; classes left out are uniform"
    )

    @model_validator(mode="after")
    def _check_names(self) -> FusionConfig:
        if len(set(self.class_names)) != len(self.class_names):
            raise ValueError("class_names must differ from each other")
        for setting in ("priors", "evidence"):
            unknown = sorted(set(getattr(self, setting)) - set(self.class_names))
            if unknown:
                raise ValueError(f"{setting} names {unknown}, which are not in class_names")
        return self

    @classmethod
    def preset(cls, name: str) -> FusionConfig:
        """The settings of that name: ``paper``, ``kitti`` or ``nuscenes``.

        Raises:
            ConfigError: there is no such preset.
        """
        if name not in PRESETS:
            raise ConfigError(f"there is no preset {name!r}; choose one of {', '.join(PRESETS)}")
        return cls(**PRESETS[name])

    @classmethod
    def load(cls, name_or_path: str) -> FusionConfig:
        """A preset by name, or the settings of a YAML file (what it leaves out keeps its default).

        Raises:
            ConfigError: neither, or a value that makes no sense; names the setting.
        """
        if name_or_path in PRESETS:
            return cls.preset(name_or_path)
        path = Path(name_or_path)
        if not path.is_file():
            raise ConfigError(f"{name_or_path!r} is neither a preset ({', '.join(PRESETS)}) nor a file")
        try:
            values = yaml.safe_load(path.read_text(encoding="utf-8"))
        except yaml.YAMLError as error:
            raise ConfigError(f"{path} is not valid YAML: {str(error).splitlines()[0]}") from None
        if not isinstance(values, dict):
            raise ConfigError(f"{path} must hold settings as 'name: value' lines")
        return cls.of(values, source=str(path))

    @classmethod
    def of(cls, values: dict[str, Any], source: str = "settings") -> FusionConfig:
        """Settings from plain values.

        Raises:
            ConfigError: an unknown name or a value that makes no sense; names the setting and ``source``.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(str(part) for part in first["loc"])
            raise ConfigError(f"{source}: {name + ': ' if name else ''}{first['msg']}") from None

    def updated(self, **changes: Any) -> FusionConfig:
        """The same settings but for ``changes``, validated."""
        return self.of({**self.model_dump(), **changes})

    def dump(self, path: Path) -> None:
        """Write all settings as YAML, whole or not at all."""
        write_text(path, self.to_yaml())

    def to_yaml(self) -> str:
        """All settings as flat YAML, a comment on each."""
        values = self.model_dump(mode="json")
        lines = []
        for name, field in type(self).model_fields.items():
            text = yaml.safe_dump({name: values[name]}, default_flow_style=True, width=1000).strip()[1:-1]
            lines.append(f"{text}  # {field.description}")
        return "\n".join(lines) + "\n"

    def prior_array(self) -> FloatArray:
        """(L,) prior of every class: the given one, else 1 / L (product) or 1 / 2 (class or not, probabilistic)."""
        uniform = 1 / len(self.class_names) if self.ensemble == "product" else 0.5
        return np.array([self.priors.get(name, uniform) for name in self.class_names])


_PAPER: dict[str, Any] = {
    "assignment": "paper",
    "unmatched": "drop",
    "out_of_view": "drop",
    "ensemble": "product",
    "min_quality": 0.0,
}
# measured: docs/when-fusion-helps.md
_CAR = Evidence().model_dump()
_PERSON = {
    "base": -1.0,
    "trust": 1.0,
    "support": (2.5, 4.5, 6.0, 6.0),
    "miss": 0.3,
    "off_ground": 0.0,
    "rival": 3.0,
    "recovered": 0.7,
}
PRESETS: dict[str, dict[str, Any]] = {
    "paper": _PAPER,
    "kitti": {
        "camera_score_threshold": 0.1,
        "decisive_score": 0.5,
        "lidar_score_threshold": 0.0,
        "class_aware": True,
        "assignment": "class_first",
        "unmatched": "downweight",
        "out_of_view": "drop",
        "ensemble": "evidence",
        "evidence": {
            "Car": _CAR,
            "Pedestrian": _PERSON,
            # as for pedestrians but for the rival, which cost cyclists more than it brought
            "Cyclist": {**_PERSON, "rival": 0.0},
        },
    },
    # measured with simulated camera detections only: docs/six-cameras.md
    "nuscenes": {
        "class_names": NUSCENES_CLASSES,
        "camera_score_threshold": 0.1,
        "decisive_score": 0.2,
        "lidar_score_threshold": 0.05,
        "class_aware": True,
        "assignment": "class_first",
        "match_iou": 0.4,
        "enlargement": 0.0,
        "unmatched": "downweight",
        "out_of_view": "keep",
        "ensemble": "evidence",
        "evidence": {name: {**_PERSON, "rival": 0.0} for name in NUSCENES_CLASSES},
        "relabel_score": 0.8,
    },
}

"""Settings of the fusion: one frozen model, flat YAML, and presets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from typing_extensions import Self

from lcf3d.errors import ConfigError, FormatError
from lcf3d.files import read_text, reading, write_text
from lcf3d.fusion.evidence import ROLE_EVIDENCE, Evidence
from lcf3d.fusion.roles import ROLES, role_of
from lcf3d.remote.places import local
from lcf3d.structures import ARGOVERSE_CLASSES, KITTI_CLASSES, NUSCENES_CLASSES, FloatArray

Fraction = Annotated[float, Field(ge=0, le=1)]


class FusionConfig(BaseModel):
    """All settings of `LateCascadeFusion`; see docs/configuration.md for what each does.

    The defaults are what ``lcf3d run`` uses: the camera adds evidence and takes it away, and deletes nothing. They hold
    for any class names, see `lcf3d.fusion.roles`. Thresholds are exclusive: a score or IoU must be higher.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    class_names: tuple[str, ...] = Field(default=KITTI_CLASSES, min_length=1, description="classes to detect")
    camera_score_threshold: Fraction = Field(default=0.1, description="2D detections not above it are left out")
    decisive_score: Fraction = Field(
        default=0.5, description="2D detections not above it only support boxes of their class: no label, no recovery"
    )
    lidar_score_threshold: Fraction = Field(default=0.0, description="3D detections not above it are left out")
    max_boxes: int = Field(default=1000, ge=1, description="only so many 3D boxes of highest score a frame take part")

    clustering: Literal["cliques", "components", "nms"] = Field(
        default="cliques", description="how 3D boxes are grouped: cliques, components or nms"
    )
    cluster_iou: Fraction = Field(default=0.3, description="tau_z: BEV IoU that links two boxes")
    class_aware: bool = Field(default=True, description="link boxes of equal class only")
    assignment: Literal["gated", "paper", "class_first"] = Field(
        default="class_first",
        description="gated: drop poor pairs before assigning; paper: after it; class_first: pair equal classes first",
    )
    match_iou: Fraction = Field(default=0.4, description="tau_b: image IoU of a match")
    representative: Literal["highest_score", "camera_class"] = Field(
        default="highest_score",
        description="member that stands for a matched cluster: highest_score, or of the camera_class first",
    )
    elsewhere_iou: Fraction = Field(
        default=0.3, description="image IoU with a box confirmed in another camera that shows the same object"
    )

    recovery: bool = Field(default=True, description="lift unmatched 2D detections into frustums")
    enlargement: Annotated[float, Field(ge=0)] = Field(default=0.05, description="e: growth of 2D boxes before lifting")
    min_points: int = Field(default=10, ge=1, description="p_min: fewest points of a frustum")
    mask_mode: Literal["box", "mask", "box+mask"] = Field(
        default="box", description="points of a frustum: all in the box, those in the mask, or both told apart"
    )
    confirm_iou: Fraction = Field(default=0.3, description="tau_d: image IoU that confirms a recovered box")
    min_quality: Fraction = Field(default=0.3, description="least quality of the localizer's fit that is confirmed")
    duplicate_iou: Fraction = Field(
        default=0.1, description="BEV IoU with a confirmed box that makes a recovered one a double"
    )

    unmatched: Literal["drop", "downweight", "keep"] = Field(
        default="downweight", description="clusters in view that no camera confirms: drop, downweight or keep"
    )
    miss_likelihood: Fraction = Field(
        default=0.2, description="downweight: the score a camera silently gives what it does not detect"
    )
    out_of_view: Literal["keep", "drop"] = Field(
        default="keep", description="clusters that no used camera looks at: keep or drop"
    )
    ensemble: Literal["probabilistic", "product", "evidence", "none"] = Field(
        default="evidence",
        description="how scores are fused: evidence, probabilistic, product (the paper's), or none",
    )
    evidence: dict[str, Evidence] = Field(
        default_factory=lambda: dict(ROLE_EVIDENCE),
        description="ensemble evidence: weights by class, or by role for classes that are not named",
    )
    relabel_score: Fraction = Field(
        default=0.8, description="where labels differ, a 2D detection above it gives label and score (Algorithm 1: all)"
    )
    priors: dict[str, Annotated[float, Field(gt=0, lt=1)]] = Field(
        default_factory=dict, description="prior by class; classes left out are uniform"
    )

    @model_validator(mode="after")
    def _check_names(self) -> FusionConfig:
        if len(set(self.class_names)) != len(self.class_names):
            raise ValueError("class_names must differ from each other")
        for setting, others in (("priors", ()), ("evidence", ROLES)):
            unknown = sorted(set(getattr(self, setting)) - {*self.class_names, *others})
            if unknown:
                raise ValueError(f"{setting} names {unknown}, which are not in class_names")
        for name, condition in self.without_effect().items():
            if getattr(self, name) != type(self).model_fields[name].get_default(call_default_factory=True):
                raise ValueError(f"{name} has no effect here, it is used with {condition}; leave it out")
        return self

    def without_effect(self) -> dict[str, str]:
        """Settings that change nothing under the others, with what they are used with."""
        idle = {}
        if self.ensemble != "evidence":
            idle["evidence"] = "ensemble: evidence"
        if self.ensemble not in ("probabilistic", "product"):
            idle["priors"] = "ensemble: probabilistic or product"
        if self.ensemble == "none":
            idle["relabel_score"] = "an ensemble other than none"
        if self.unmatched != "downweight" or self.ensemble == "evidence":
            idle["miss_likelihood"] = "unmatched: downweight and an ensemble other than evidence"
        if self.class_aware:
            idle["representative"] = "class_aware: false"
        if not self.recovery:
            own = ("enlargement", "min_points", "mask_mode", "confirm_iou", "min_quality", "duplicate_iou")
            idle.update(dict.fromkeys(own, "recovery: true"))
        return idle

    @classmethod
    def preset(cls, name: str, **changes: Any) -> Self:
        """The settings of that name: ``default``, ``paper``, ``kitti``, ``nuscenes`` or ``argoverse2``.

        Args:
            name: of the preset.
            changes: settings that differ, for example ``class_names=("car", "person")``.

        Raises:
            ConfigError: there is no such preset, or a change makes no sense.
        """
        if name not in PRESETS:
            raise ConfigError(f"there is no preset {name!r}; choose one of {', '.join(PRESETS)}")
        return cls.of({**PRESETS[name], **changes}, source=f"preset {name}")

    @classmethod
    def load(cls, name_or_path: str | Path, class_names: Sequence[str] | None = None) -> Self:
        """A preset by name, or the settings of a YAML file (what it leaves out keeps its default).

        Args:
            name_or_path: name of a preset, or path of a file.
            class_names: classes to detect, where preset or file do not say.

        Raises:
            ConfigError: neither, or a value that makes no sense; names the setting.
        """
        own: dict[str, Any] = {} if class_names is None else {"class_names": tuple(class_names)}
        if name_or_path in PRESETS:
            return cls.preset(str(name_or_path), **({} if "class_names" in PRESETS[str(name_or_path)] else own))
        path = local(name_or_path)
        if not path.is_file():
            raise ConfigError(f"{str(name_or_path)!r} is neither a preset ({', '.join(PRESETS)}) nor a file")
        try:
            with reading(path, "settings"):
                values = _yaml(path)
        except FormatError as error:
            raise ConfigError(str(error)) from None
        if not isinstance(values, dict):
            raise ConfigError(f"{path} must hold settings as 'name: value' lines")
        return cls.of({**own, **values}, source=str(path))

    @classmethod
    def of(cls, values: dict[str, Any], source: str = "settings") -> Self:
        """Settings from plain values.

        Raises:
            ConfigError: an unknown name or a value that makes no sense; names the setting and ``source``.
        """
        try:
            return cls.model_validate(values)
        except (RecursionError, OverflowError, TypeError) as error:
            raise ConfigError(f"{source}: a value cannot be read ({error})") from None
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(str(part) for part in first["loc"])
            message = first["msg"].removeprefix("Value error, ")
            raise ConfigError(f"{source}: {name + ': ' if name else ''}{message}") from None

    def updated(self, **changes: Any) -> Self:
        """The same settings but for ``changes``, validated; those that lose their effect go back to their default.

        Raises:
            ConfigError: an unknown name, a value that makes no sense, or a change that would have no effect.
        """
        values = {name: getattr(self, name) for name in type(self).model_fields}
        values.update(changes)
        try:
            idle = type(self).model_construct(**values).without_effect()
        except (TypeError, AttributeError):
            idle = {}
        return self.of({name: value for name, value in values.items() if name in changes or name not in idle})

    def dump(self, path: Path) -> None:
        """Write all settings as YAML, whole or not at all."""
        write_text(path, self.to_yaml())

    def to_yaml(self) -> str:
        """All settings as flat YAML under the headings of their stages, a comment on each."""
        values = self.model_dump(mode="json")
        lines: list[str] = []
        for name, field in type(self).model_fields.items():
            if name in STAGES:
                lines.append(f"{'' if not lines else chr(10)}# {STAGES[name]}")
            text = yaml.safe_dump({name: values[name]}, default_flow_style=True, width=1000).strip()[1:-1]
            lines.append(f"{text}  # {field.description}")
        return "\n".join(lines) + "\n"

    def evidence_of(self, class_name: str) -> Evidence:
        """The weights of a class: its own, else those of its role."""
        role = role_of(class_name)
        return self.evidence.get(class_name) or self.evidence.get(role) or ROLE_EVIDENCE[role]

    def prior_array(self) -> FloatArray:
        """(L,) prior of every class: the given one, else 1 / L (product) or 1 / 2 (class or not, probabilistic)."""
        uniform = 1 / len(self.class_names) if self.ensemble == "product" else 0.5
        return np.array([self.priors.get(name, uniform) for name in self.class_names])


STAGES = {
    "class_names": "what takes part",
    "clustering": "bounding box matching (section 4.1.3)",
    "recovery": "detection recovery (section 4.1.4)",
    "unmatched": "semantic fusion (section 4.1.5) and what nothing confirms",
    "pairs": "stereo pairs (section 4.2)",
}
"""Headings of the settings: first setting of a stage -> what the stage is called."""

# nuScenes and Argoverse 2 count a box whose centre is near enough: a camera that sees the vehicle says most of it even
# where its box fits loosely, while KITTI asks for an overlap of 0.7. Measured: docs/nuscenes.md, docs/argoverse2.md
_BY_CENTRE = {"vehicle": Evidence(support=(1.5, 2.5, 3.0, 3.0))}

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    # the paper's own values for KITTI: docs/method.md
    "paper": {
        "camera_score_threshold": 0.5,
        "decisive_score": 0.0,
        "lidar_score_threshold": 0.1,
        "class_aware": False,
        "assignment": "paper",
        "unmatched": "drop",
        "out_of_view": "drop",
        "ensemble": "product",
        "relabel_score": 0.0,
        "min_quality": 0.0,
    },
    # measured: docs/when-fusion-helps.md. KITTI labels only what the front cameras see
    "kitti": {"class_names": KITTI_CLASSES, "out_of_view": "drop"},
    # measured with simulated camera detections only: docs/six-cameras.md
    "nuscenes": {
        "class_names": NUSCENES_CLASSES,
        "decisive_score": 0.2,
        "lidar_score_threshold": 0.05,
        "enlargement": 0.0,
        "evidence": _BY_CENTRE,
    },
    # measured with simulated camera detections only: docs/argoverse2.md
    "argoverse2": {"class_names": ARGOVERSE_CLASSES, "evidence": _BY_CENTRE},
}


def _yaml(path: Path) -> Any:
    """The value of a YAML file.

    Raises:
        ConfigError: it is no YAML.
    """
    try:
        return yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {str(error).splitlines()[0]}") from None

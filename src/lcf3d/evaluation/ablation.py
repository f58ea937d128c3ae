"""What each part of the fusion brings: the paper's table of module contributions, and the variants of each part."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.evaluation.bootstrap import Interval
from lcf3d.evaluation.protocol import Evaluation
from lcf3d.frame import Frame
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.clustering import cluster_boxes
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.localizer import Localizer
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.reasons import Outcome
from lcf3d.structures import Detections2D, Detections3D

Progress = Callable[[Sequence[int]], Iterable[int]]


class AblationInput(NamedTuple):
    """One frame with the detections of both branches, the 2D ones by camera."""

    frame: Frame
    lidar: Detections3D
    camera: Mapping[str, Detections2D]


class Variant(NamedTuple):
    """One row to measure.

    Attributes:
        group: heading.
        name: what is varied, in words.
        changes: settings that differ from those at hand; None for the LiDAR branch without any fusion.
    """

    group: str
    name: str
    changes: dict[str, Any] | None


@dataclass(frozen=True)
class AblationRow:
    """The result of one variant.

    Attributes:
        group: heading.
        name: what was varied.
        ap: figures of the evaluation by class, in percent; NaN where there are no detections of a class.
        matched: output boxes that a camera detection confirms.
        recovered: output boxes found from camera detections alone.
        kept: output boxes of the LiDAR branch that nothing confirms.
        gain: by class, how much better than the LiDAR branch alone, with bootstrap intervals, if asked for.
    """

    group: str
    name: str
    ap: dict[str, tuple[float, ...]]
    matched: int = 0
    recovered: int = 0
    kept: int = 0
    gain: dict[str, Interval] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values, None for NaN."""
        values = asdict(self)
        values["ap"] = {name: [None if np.isnan(v) else v for v in ap] for name, ap in self.ap.items()}
        if not self.gain:
            del values["gain"]
        return values


# the filter of the paper, whose modules its table switches on one after the other
_FILTER: dict[str, Any] = {"unmatched": "drop", "ensemble": "none", "recovery": False}
MODULES = "modules of the paper's filter"


def variants(config: FusionConfig, scans: bool, masks: bool) -> list[Variant]:
    """The rows that make sense: those with recovery only where there are scans, mask modes only where there are masks.

    Args:
        config: settings that the variants change.
        scans: whether the frames have LiDAR scans.
        masks: whether camera detections have instance masks.
    """
    semantic = {"ensemble": "probabilistic", "relabel_score": 0.0}
    rows = [
        Variant(MODULES, "none: LiDAR alone", None),
        Variant(MODULES, "recovery only", {**_FILTER, "unmatched": "keep", "recovery": True}),
        Variant(MODULES, "matching", _FILTER),
        Variant(MODULES, "matching + recovery", {**_FILTER, "recovery": True}),
        Variant(MODULES, "matching + semantic", {**_FILTER, **semantic}),
        Variant(MODULES, "matching + recovery + semantic", {**_FILTER, **semantic, "recovery": True}),
    ]
    here: dict[str, Any] = {"recovery": config.recovery}
    rows.append(Variant("these settings", "as they are", here))
    for method, iou in (("nms", 0.3), ("components", 0.5), ("cliques", 0.3)):
        changes = {**here, "clustering": method, "cluster_iou": iou}
        rows.append(Variant("clustering", f"{method}, BEV IoU {iou}", changes))
    for policy in ("drop", "downweight", "keep"):
        rows.append(Variant("unmatched clusters", policy, {**here, "unmatched": policy}))
    for ensemble in ("none", "product", "probabilistic", "evidence"):
        rows.append(Variant("ensemble", ensemble, {**here, "ensemble": ensemble}))
    if masks and scans:
        for mode in ("box", "mask", "box+mask"):
            rows.append(Variant("instance masks", mode, {"recovery": True, "mask_mode": mode}))
    if scans:
        return rows
    without = [row for row in rows if not (row.group == MODULES and (row.changes or {}).get("recovery"))]
    return [
        row._replace(changes=None if row.changes is None else {**row.changes, "recovery": False}) for row in without
    ]


def ablate(
    inputs: Sequence[AblationInput],
    evaluation: Evaluation,
    config: FusionConfig,
    calibration: Calibration | None = None,
    localizer: Localizer | None = None,
    progress: Progress = lambda indices: indices,
    suppress: bool = False,
    samples: int = 0,
) -> list[AblationRow]:
    """Measure all variants on frames of any dataset.

    Args:
        inputs: frames and detections.
        evaluation: of the same frames.
        config: settings that the variants change.
        calibration: score calibration, see `LateCascadeFusion`.
        localizer: for recovery, see `LateCascadeFusion`.
        progress: wraps the loop over variants, for a progress bar.
        suppress: the LiDAR detections are without non-maximum suppression: LiDAR alone is measured after it.
        samples: draws of the frames for intervals of the gain over the LiDAR branch alone; 0 for none.

    Raises:
        ConfigError: intervals are asked of an evaluation that has none.
    """
    if samples and not hasattr(evaluation, "differences"):
        raise ConfigError("bootstrap intervals of ablations are there for KITTI's evaluation only; leave --samples out")
    scans = all(item.frame.points is not None for item in inputs)
    masks = any(seen.masks is not None for item in inputs for seen in item.camera.values())
    chosen = variants(config, scans, masks)
    alone = [suppressed(item.lidar) for item in inputs] if suppress else [item.lidar for item in inputs]
    numbers = progress(range(len(chosen)))
    return [_measure(inputs, alone, evaluation, chosen[i], config, calibration, localizer, samples) for i in numbers]


def suppressed(lidar: Detections3D) -> Detections3D:
    """What a LiDAR detector gives by itself: the best of boxes that overlap in bird's-eye view."""
    return lidar[cluster_boxes(lidar.boxes, lidar.scores, lidar.labels, method="nms").representative]


def _measure(
    inputs: Sequence[AblationInput],
    alone: Sequence[Detections3D],
    evaluation: Evaluation,
    variant: Variant,
    config: FusionConfig,
    calibration: Calibration | None,
    localizer: Localizer | None,
    samples: int,
) -> AblationRow:
    outcomes = np.zeros(len(Outcome), dtype=np.int64)
    results = []
    fusion = None
    if variant.changes is not None:
        fusion = LateCascadeFusion(config.updated(**variant.changes), localizer, calibration)
    for item, detections in zip(inputs, alone, strict=True):
        if fusion is not None:
            fused = fusion(item.frame, item.lidar, item.camera)
            detections = fused.detections
            outcomes += np.bincount(fused.outcomes, minlength=len(Outcome))
        results.append(detections)
    figures = evaluation.figures(results)
    # not part of the protocol: see `ablate`
    differences = getattr(evaluation, "differences", None)
    gain = differences(alone, results, samples) if samples and differences else {}
    unknown = (float("nan"),) * len(evaluation.columns)
    matched, recovered, kept = (int(outcomes[s]) for s in (Outcome.MATCHED, Outcome.RECOVERED, Outcome.KEPT))
    ap = {name: figures.get(name, unknown) for name in config.class_names}
    return AblationRow(variant.group, variant.name, ap, matched, recovered, kept, gain)

"""nuScenes' tracking protocol as a measure of the verbs: see `lcf3d.evaluation.protocol`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lcf3d.evaluation.nuscenes_task import NuscenesEvaluation
from lcf3d.evaluation.nuscenes_tracking import MEASURES, NuscenesTrackingMetrics, evaluate_nuscenes_tracking
from lcf3d.evaluation.protocol import EvaluationOptions, TableData, frames_note, tracked_classes
from lcf3d.formats.nuscenes import TRACKING_CLASSES, read_tracking
from lcf3d.structures import IntArray

COUNTS = ("gt", "mt", "ml", "tp", "fp", "fn", "ids", "frag")
TITLES = {"gt": "objects", "faf": "FAF"}


class NuscenesTracking:
    """nuScenes' tracking metrics over samples of its tables.

    Args:
        dataset: a `NuscenesDataset`.
        frame_ids: samples that count; those that are usually evaluated with the tables without them.
        options: classes.

    Raises:
        ConfigError: an unknown class, an option for other evaluations, or a split without samples.
    """

    def __init__(self, dataset: Any, frame_ids: Sequence[str] | None, options: EvaluationOptions) -> None:
        self.classes = tracked_classes(options, TRACKING_CLASSES, "nuScenes tracks")
        self.tables = dataset.tables
        usual = NuscenesEvaluation(dataset, frame_ids, EvaluationOptions())
        self.rows: IntArray = usual.rows
        self.tokens = usual.frame_ids

    def read(self, path: Path, missing: str = "error") -> NuscenesTracks:
        """A tracking submission, or that of a run folder, measured.

        Raises:
            DatasetError: no annotations, or none with track numbers.
            FormatError: not a tracking submission, or one of other samples.
        """
        boxes, ids, meta = read_tracking(path / "tracking.json" if path.is_dir() else path)
        if missing == "empty" and set(self.tokens) & set(boxes.sample_tokens):
            boxes = boxes.numbered(self.tokens)
            boxes, ids = boxes[boxes.samples >= 0], ids[boxes.samples >= 0]
        metrics = evaluate_nuscenes_tracking(self.tables, self.rows, boxes, ids, self.classes, meta)
        scenes = np.unique(self.tables.samples.scenes[self.rows])
        every = int(np.isin(self.tables.samples.scenes, scenes).sum())
        return NuscenesTracks(metrics, every, len(scenes))


class NuscenesTracks(NamedTuple):
    """Tracks of nuScenes' scenes, measured.

    Attributes:
        metrics: by class.
        samples: how many samples the scenes have.
        scenes: how many scenes there are.
    """

    metrics: NuscenesTrackingMetrics
    samples: int
    scenes: int

    def to_json(self) -> dict[str, Any]:
        """What the devkit writes as ``metrics_summary.json``."""
        return self.metrics.to_json()

    def table(self) -> TableData:
        """A row a class, and all together."""
        columns = ("class", *(TITLES.get(name, name.upper()) for name in MEASURES))
        rows: list[tuple[str, ...] | None] = [
            (name, *(_cell(measure, own[measure]) for measure in MEASURES))
            for name, own in self.metrics.classes.items()
        ]
        rows += [None, ("all", *(_cell(measure, self.metrics.overall(measure)) for measure in MEASURES))]
        notes = (
            "centre distance within 2 m; AMOTA and AMOTP over recall, all else at the best MOTA of each class",
            "AMOTP, MOTP in m; TID, LGD in s; FAF by 100 samples; all: means, MT to FRAG sums, of classes with objects",
            frames_note(self.metrics.samples, self.samples, self.scenes, "scene"),
        )
        return TableData("nuScenes tracks", columns, rows, notes)


def _cell(measure: str, value: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.0f}" if measure in COUNTS else f"{value:.1f}" if measure == "faf" else f"{value:.3f}"

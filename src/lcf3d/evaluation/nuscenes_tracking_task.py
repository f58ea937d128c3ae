"""nuScenes' tracking protocol as a measure of the verbs: see `lcf3d.evaluation.protocol`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.evaluation.nuscenes_task import NuscenesEvaluation
from lcf3d.evaluation.nuscenes_tracking import MEASURES, NuscenesTrackingMetrics, evaluate_nuscenes_tracking
from lcf3d.evaluation.protocol import EvaluationOptions, TableData, frames_note, refuse_options
from lcf3d.formats.nuscenes import TRACKING_CLASSES, read_tracking
from lcf3d.formats.nuscenes_boxes import GlobalBoxes
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
        refuse_options("--tracking", options, "iou", "front", "nds_hat")
        unknown = [name for name in options.classes if name not in TRACKING_CLASSES]
        if unknown:
            raise ConfigError(
                f"--tracking does not know class {unknown[0]!r}; nuScenes tracks {', '.join(TRACKING_CLASSES)}"
            )
        self.classes = options.classes or TRACKING_CLASSES
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
            boxes, ids = _with_samples(boxes, ids, self.tokens)
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


def _with_samples(
    boxes: GlobalBoxes, ids: NDArray[np.str_], tokens: Sequence[str]
) -> tuple[GlobalBoxes, NDArray[np.str_]]:
    """The boxes of ``tokens`` and their tracks; samples that the file lacks have none."""
    position = {token: i for i, token in enumerate(tokens)}
    places = np.array([position.get(token, -1) for token in boxes.sample_tokens], dtype=np.int64)[boxes.samples]
    own = boxes[places >= 0]
    columns = {name: getattr(own, name) for name in own.__dataclass_fields__}
    columns.update(sample_tokens=tuple(tokens), samples=places[places >= 0])
    return GlobalBoxes(**columns), ids[places >= 0]

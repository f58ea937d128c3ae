"""nuScenes' official protocol as an evaluation of the verbs: see `lcf3d.evaluation.protocol`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.datasets.nuscenes_splits import default_split, scenes_of_split
from lcf3d.errors import ConfigError
from lcf3d.evaluation.distance import DistanceEvaluation, DistanceResultSet
from lcf3d.evaluation.nuscenes import NuscenesMetrics, evaluate_nuscenes
from lcf3d.evaluation.protocol import EvaluationOptions, TableData
from lcf3d.formats.nuscenes import read_submission
from lcf3d.formats.nuscenes_boxes import GlobalBoxes, detections_from_global, global_from_detections, split_by_sample
from lcf3d.structures import Detections3D

FRONT_CAMERA = "CAM_FRONT"
ERROR_TITLES = ("ATE", "ASE", "AOE", "AVE", "AAE")


class NuscenesEvaluation(DistanceEvaluation):
    """nuScenes' metrics over samples of its tables.

    Intervals and the closer look are of centre distance in the LiDAR frame (`DistanceEvaluation`): the protocol's own
    filters by distance from the vehicle and by bicycle racks are not in them.

    Args:
        dataset: a `NuscenesDataset`.
        frame_ids: samples to evaluate; those of the dataset's split without them, which is the one usually evaluated
            with the tables.
        options: whether only the front camera's view counts.

    Raises:
        ConfigError: an option for other datasets, or a split without samples.
    """

    heading = "nuScenes AP"

    def __init__(self, dataset: Any, frame_ids: Sequence[str] | None, options: EvaluationOptions) -> None:
        tables = dataset.tables
        if frame_ids is None and dataset.split is None:
            split = default_split(tables.version)
            rows = tables.rows_of_scenes(tables.scene_names if split is None else scenes_of_split(split))
            if not len(rows):
                raise ConfigError(
                    f"{tables.root / tables.version} holds no scene of split {split!r}; name another with --split, or "
                    f"give a file of scene names; there are {', '.join(tables.scene_names[:5])} ..."
                )
            frame_ids = [token.decode() for token in tables.samples.tokens[rows].tolist()]
        super().__init__(dataset, frame_ids, options)
        self.nuscenes: Any = dataset
        rows_of = {token.decode(): row for row, token in enumerate(tables.samples.tokens.tolist())}
        self.rows = np.array([rows_of[token] for token in self.frame_ids], dtype=np.int64)

    def official(self, boxes: GlobalBoxes, meta: dict[str, Any] | None = None) -> NuscenesMetrics:
        """The official metrics of boxes in the global frame.

        Raises:
            FormatError: boxes of other samples than these, or none for some of them.
        """
        camera = FRONT_CAMERA if self.front else None
        return evaluate_nuscenes(self.nuscenes.tables, self.rows, boxes, camera=camera, meta=meta)

    def figures(self, results: Sequence[Detections3D]) -> dict[str, tuple[float, ...]]:
        """The official AP of every class, percent; NaN for classes without annotations."""
        by_token = dict(zip(self.frame_ids, results, strict=True))
        transforms = {token: self.nuscenes.global_from_lidar(token) for token in self.frame_ids}
        metrics = self.official(global_from_detections(by_token, transforms, self.frame_ids))
        rows = zip(metrics.class_names, metrics.aps, metrics.ground_truth_counts, strict=True)
        return {name: (100 * float(aps.mean()) if count else float("nan"),) for name, aps, count in rows}

    def read(self, path: Path, name: str, missing: str = "error") -> NuscenesResultSet:
        """A submission file, or that of a run folder.

        Raises:
            FormatError: not a submission, or one of other samples.
        """
        file = path / "results.json" if path.is_dir() else path
        boxes, meta = read_submission(file)
        if missing == "empty":
            boxes = boxes.numbered(self.frame_ids)
            boxes = boxes[boxes.samples >= 0]
        metrics = self.official(boxes, dict(meta))
        by_token = split_by_sample(boxes)
        found = [
            detections_from_global(by_token[token], self.nuscenes.lidar_from_global(token)) for token in self.frame_ids
        ]
        return NuscenesResultSet(name, path, self, found, metrics)


@dataclass(frozen=True, eq=False)
class NuscenesResultSet(DistanceResultSet):
    """A submission, measured.

    Attributes:
        official: the metrics of the official protocol.
    """

    official: NuscenesMetrics

    def to_json(self) -> dict[str, Any]:
        """What the devkit writes as ``metrics_summary.json``, with NDS^ and counts."""
        return self.official.to_json()

    def details_json(self) -> dict[str, Any]:
        """What the devkit writes as ``metrics_details.json``."""
        return self.official.details_json()

    def tables(self) -> list[TableData]:
        """AP and errors by class, NDS and what was counted."""
        m, n = self.official, 3 if self.evaluation.nds_hat else len(ERROR_TITLES)
        rows: list[tuple[str, ...] | None] = []
        for name, aps, errors in zip(m.class_names, m.aps, m.class_errors, strict=True):
            values = (f"{100 * value:.1f}" for value in (aps.mean(), *aps))
            rows.append((name, *values, *("-" if np.isnan(v) else f"{v:.3f}" for v in errors[:n])))
        means = (f"{100 * value:.1f}" for value in (m.mean_ap, *m.aps.mean(axis=0)))
        rows += [None, ("mean", *means, *(f"{value:.3f}" for value in list(m.errors.values())[:n]))]
        columns = ("class", "AP", *(f"{th:g}m" for th in m.config.dist_ths), *ERROR_TITLES[:n])
        where = "front camera's view" if self.evaluation.front else "all around"
        title = f"{self.name}, {len(self.found)} samples, {where}"
        counted = ", ".join(f"{c.in_view} of {c.original} {name.replace('_', ' ')}" for name, c in m.counts.items())
        notes = [
            f"NDS {100 * m.nd_score:.2f}   NDS^ {100 * m.nds_hat:.2f}   mAP {100 * m.mean_ap:.2f}",
            "AP in percent by matching distance; errors in m, 1 - IoU, rad, m/s, 1 - accuracy",
            f"counted: {counted}",
        ]
        absent = [name for name, n in zip(m.class_names, m.ground_truth_counts, strict=True) if not n]
        if absent:
            notes.append(f"no ground truth (counts as AP 0, errors 1): {', '.join(absent)}")
        return [TableData(title, columns, rows, tuple(notes))]

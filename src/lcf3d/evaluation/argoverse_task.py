"""Argoverse 2's protocol as an evaluation of the verbs: see `lcf3d.evaluation.protocol`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.datasets.argoverse2_frames import detections_by_frame, results_of_frames, split_id
from lcf3d.datasets.argoverse2_results import result_file
from lcf3d.errors import DatasetError
from lcf3d.evaluation.argoverse import OFFICIAL, ArgoverseMetrics, evaluate_argoverse
from lcf3d.evaluation.distance import DistanceEvaluation, DistanceResultSet
from lcf3d.evaluation.distance_study import DistanceResults
from lcf3d.evaluation.protocol import EvaluationOptions, TableData, refuse_options
from lcf3d.formats.argoverse import Cuboids, read_submission
from lcf3d.structures import ARGOVERSE_CLASSES, BoolArray, Detections3D


class ArgoverseEvaluation(DistanceEvaluation):
    """Argoverse 2's metrics over frames of its logs.

    Intervals and the closer look are nuScenes' AP by centre distance within the range (`DistanceEvaluation`).

    Args:
        dataset: an `Argoverse2Dataset`.
        frame_ids: frames to evaluate; all that are annotated without them.
        options: classes to show.

    Raises:
        ConfigError: an option for other datasets.
        DatasetError: no frame is annotated.
    """

    heading = "Argoverse 2 AP"
    has_nds_hat = False

    def __init__(self, dataset: Any, frame_ids: Sequence[str] | None, options: EvaluationOptions) -> None:
        refuse_options("Argoverse 2", options, "iou", "front", "nds_hat")
        self.argoverse = dataset
        annotated = dataset.ground_truth()
        if not len(annotated):
            raise DatasetError(f"{dataset.root} holds no annotations, so that nothing can be evaluated")
        by_frame = detections_by_frame(annotated)
        chosen = list(by_frame) if frame_ids is None else frame_ids
        super().__init__(dataset, chosen, options)
        self.annotations = _of_frames(annotated, self.frame_ids)

    def results(self, found: Sequence[Detections3D]) -> DistanceResults:
        """Labels and detections in the evaluated classes, within the official range."""
        results = super().results(found)
        return replace(results, ranges_m=np.full(len(self.class_names), OFFICIAL.max_range_m))

    def official(self, found: Cuboids) -> ArgoverseMetrics:
        """The official metrics.

        Raises:
            FormatError: detections of other logs.
        """
        return evaluate_argoverse(self.annotations, found)

    def figures(self, results: Sequence[Detections3D]) -> dict[str, tuple[float, ...]]:
        """The official AP of every class, percent; NaN for classes without annotations."""
        metrics = self.official(results_of_frames(dict(zip(self.frame_ids, results, strict=True))))
        rows = zip(metrics.class_names, metrics.ap, metrics.ground_truth_counts, strict=True)
        return {name: (100 * float(ap) if n else float("nan"),) for name, ap, n in rows if name in self.class_names}

    def read(self, path: Path, name: str, missing: str = "error") -> ArgoverseResultSet:
        """A file in the submission form, or that of a run folder.

        Raises:
            FormatError: not such a file, or none of its boxes is of an evaluated frame.
        """
        # refuses files of other logs, or that lack some
        self.argoverse.lidar_results(path, self.class_names, missing)
        everything = read_submission(result_file(path))
        kept = _of_frames(everything, self.frame_ids)
        empty = Detections3D.empty(ARGOVERSE_CLASSES)
        by_frame = detections_by_frame(kept)
        found = [by_frame.get(frame_id, empty) for frame_id in self.frame_ids]
        return ArgoverseResultSet(name, path, self, found, self.official(kept), len(everything) - len(kept))


@dataclass(frozen=True, eq=False)
class ArgoverseResultSet(DistanceResultSet):
    """Results in the submission form, measured.

    Attributes:
        official: the metrics of the official protocol.
        left_out: how many boxes were of sweeps that are not evaluated.
    """

    official: ArgoverseMetrics
    left_out: int

    def to_json(self) -> dict[str, Any]:
        """Metrics by class and their averages, in the names of the official table."""
        return self.official.to_json()

    @cached_property
    def _shown(self) -> BoolArray:
        """(26,) classes that are annotated and asked for."""
        asked = np.isin(ARGOVERSE_CLASSES, self.evaluation.class_names)
        shown: BoolArray = asked & (self.official.ground_truth_counts > 0)
        return shown

    def tables(self) -> list[TableData]:
        """AP by distance, errors and CDS of the annotated classes, and their means."""
        m = self.official
        rows: list[tuple[str, ...] | None] = []
        for c in np.flatnonzero(self._shown):
            percent = (f"{100 * value:.1f}" for value in (m.ap[c], *m.aps[c]))
            errors = (f"{value:.3f}" for value in m.errors[c])
            count = str(m.ground_truth_counts[c])
            rows.append((m.class_names[c], *percent, *errors, f"{100 * m.cds[c]:.1f}", count))
        notes = ["AP and CDS in percent; errors in m, 1 - IoU, rad; no region-of-interest filter"]
        if self._shown.any():
            means = m.table(self._shown)
            percent = (f"{100 * value:.1f}" for value in (means["AP"], *m.aps[self._shown].mean(axis=0)))
            errors = (f"{means[name]:.3f}" for name in ("ATE", "ASE", "AOE"))
            total = str(m.ground_truth_counts[self._shown].sum())
            rows += [None, ("mean", *percent, *errors, f"{100 * means['CDS']:.1f}", total)]
        official = m.table()
        notes.append(
            f"over all {len(m.class_names)} classes, those without annotations as 0: AP {100 * official['AP']:.1f}, "
            f"CDS {100 * official['CDS']:.1f}"
        )
        if self.left_out:
            notes.append(f"{self.left_out} boxes are of sweeps that are not evaluated and were left out")
        columns = ("class", "AP", *(f"{t:g}m" for t in m.config.thresholds_m), "ATE", "ASE", "AOE", "CDS", "labels")
        return [TableData(f"{self.name}, {m.sweeps} annotated sweeps", columns, rows, tuple(notes))]


def _of_frames(cuboids: Cuboids, frame_ids: Sequence[str]) -> Cuboids:
    """The cuboids of these frames."""
    times: dict[str, list[int]] = {}
    for frame_id in frame_ids:
        log, time = split_id(frame_id)
        times.setdefault(log, []).append(time)
    kept = np.zeros(len(cuboids), dtype=bool)
    for i, log in enumerate(cuboids.log_ids):
        if log in times:
            kept |= (cuboids.logs == i) & np.isin(cuboids.timestamps_ns, times[log])
    return cuboids[kept]

"""A row of the paper measured here: its networks run with the paper's settings, its results evaluated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.datasets.opening import open_dataset
from lcf3d.errors import ConfigError
from lcf3d.evaluation.opening import open_evaluation
from lcf3d.evaluation.protocol import EvaluationOptions
from lcf3d.files import read_json, write_json
from lcf3d.paper.kept import keep_detections
from lcf3d.paper.networks import NeedsError, substitutes
from lcf3d.paper.shift import measure_shift
from lcf3d.paper.splits import KITTI_VAL
from lcf3d.paper.tables import Row, Table
from lcf3d.paper.workplace import Measured, Workplace, needed, root_of, run_name, settings_of
from lcf3d.run.frames import run_frames
from lcf3d.run.frames import total as count_frames
from lcf3d.run.setup import RunRequest, prepare_run

DIFFICULTIES = ("easy", "moderate", "hard")
KITTI_NAMES = ("Car", "Pedestrian", "Cyclist")


def measure_row(table: Table, row: Row, place: Workplace) -> Measured:
    """Run what is missing of a row (an interrupted run goes on) and evaluate it.

    Raises:
        NeedsError: something is not here; the message says what.
        Lcf3dError: data, weights or result files are wrong.
    """
    if row.name in place.results:
        return _evaluated(table, place, place.results[row.name], None, ("result files given",))
    if row.quoted or not row.lidar:
        raise NeedsError(row.quoted or row.needs)
    if table.measure.startswith("shift"):
        return measure_shift(table, row, place)
    lidar, camera, localizer = needed(table, row, place)
    kind = table.data[0]
    frames, notes = frames_of(kind, root_of(kind, place))
    cameras = dict.fromkeys(("left", "right") if row.stereo else ("*",), camera) if camera else {}
    request = RunRequest(
        f"{kind}:{root_of(kind, place)}",
        lidar,
        cameras,
        frames=frames,
        config="paper",
        changes=settings_of(table, row),
        localizer=localizer,
        calibration="none",
    )
    folder = place.out / "runs" / run_name(table, row)
    median_ms = _run(request, folder, row.name, place)
    words = tuple(f"with {text}" for text in substitutes(row, place.uses))
    return _evaluated(table, place, folder, _frames_a_second(table, median_ms), (*notes, *words))


def frames_of(kind: str, root: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Frames of the paper's validation split, and a note where the data's own list is another.

    KITTI trees without ``ImageSets/val.txt`` have to hold all 3,769; nuScenes' tables name their own split.

    Raises:
        ConfigError: they do not.
        DatasetError: there is no such dataset.
    """
    dataset = open_dataset(f"{kind}:{root}")
    if kind != "kitti":
        return open_evaluation(dataset).frame_ids, ()
    if not (root / "ImageSets" / "val.txt").is_file():
        absent = len(set(KITTI_VAL) - set(dataset.ids))
        if absent:
            raise ConfigError(
                f"{root} lacks {absent:,} of the {len(KITTI_VAL):,} frames that the paper validates on; name those to "
                f"measure on in {root / 'ImageSets' / 'val.txt'}, one a line, or add the frames"
            )
        return KITTI_VAL, ()
    frames = open_evaluation(dataset).frame_ids
    if set(frames) == set(KITTI_VAL):
        return frames, ()
    shared = len(set(frames) & set(KITTI_VAL))
    note = f"val of {root} has {len(frames)} frames, {shared} of them of the paper's {len(KITTI_VAL)}"
    return frames, (note,)


def _run(request: RunRequest, folder: Path, name: str, place: Workplace) -> dict[str, float]:
    """Run the frames that are not done; the median milliseconds of the branches and the fusion."""
    kept = folder / "median_ms.json"
    run = prepare_run(request, folder, resume=not place.overwrite, overwrite=place.overwrite)
    networks = keep_detections(run.runner, request.lidar, request.cameras, request.dataset, place.out / "detections")
    pending = [frame_id for frame_id in run.frame_ids if not run.folder.is_done(frame_id)]
    advance = place.begin(name, len(pending))
    summaries = []
    for summary in run_frames(run.runner, pending):
        summaries.append(summary)
        advance()
    run.folder.finish(run.frame_ids)
    if summaries:
        # the first frame warms up
        write_json(kept, {**count_frames(summaries[1:] or summaries)["median_ms"], **networks.medians()})
    return dict(read_json(kept)) if kept.is_file() else {}


def _frames_a_second(table: Table, median_ms: Mapping[str, float]) -> float | None:
    """As the paper counts: branches in parallel, so the slower one, and the fusion; of masks, the fusion alone."""
    if not median_ms:
        return None
    fusion = median_ms["fusion"]
    slower = 0.0 if table.measure == "nuscenes" else max(median_ms["lidar"], median_ms["camera"])
    return 1e3 / (slower + fusion)


def _evaluated(table: Table, place: Workplace, results: Path, speed: float | None, notes: Sequence[str]) -> Measured:
    """Results by the table's columns."""
    kind = table.data[0]
    root = root_of(kind, place)
    frames, _ = frames_of(kind, root)
    figures = (nuscenes_figures if kind == "nuscenes" else kitti_figures)(table, f"{kind}:{root}", frames, results)
    figures["FPS"] = speed
    values = tuple(None if (v := figures[c]) is None or np.isnan(v) else float(v) for c in table.columns)
    return Measured(values, len(frames), tuple(notes))


def kitti_figures(table: Table, dataset: str, frames: Sequence[str], results: Path) -> dict[str, float | None]:
    """3D AP R40 by column of the KITTI tables."""
    data = open_dataset(dataset)
    if table.measure == "kitti-iou":
        return _over_iou(table, data, frames, results)
    metrics = open_evaluation(data, frames).read(results, results.name).metrics  # type: ignore[attr-defined]
    ap = {(c, d): metrics.ap(c, "3d", d) for c in KITTI_NAMES for d in DIFFICULTIES if c in metrics.class_names}
    # the official program leaves out a class without any detection; here it counts as 0
    figures: dict[str, float | None] = {f"{c} {d}": ap.get((c, d), 0.0) for c in KITTI_NAMES for d in DIFFICULTIES}
    for d in DIFFICULTIES:
        figures[d] = float(np.mean([ap.get((c, d), 0.0) for c in KITTI_NAMES]))
    return figures


def _over_iou(table: Table, data: Any, frames: Sequence[str], results: Path) -> dict[str, float | None]:
    """Moderate 3D AP by class and IoU threshold."""
    figures: dict[str, float | None] = {}
    for threshold in dict.fromkeys(column.split()[1] for column in table.columns):
        options = EvaluationOptions(iou=tuple(f"{c}:3d={threshold}" for c in KITTI_NAMES))
        metrics = open_evaluation(data, frames, options).read(results, results.name).metrics  # type: ignore[attr-defined]
        for c in KITTI_NAMES:
            figures[f"{c} {threshold}"] = metrics.ap(c, "3d", "moderate") if c in metrics.class_names else 0.0
    return figures


def nuscenes_figures(table: Table, dataset: str, frames: Sequence[str], results: Path) -> dict[str, float | None]:
    """mAP, NDS and the classes' AP, 0 to 1 as the paper prints them."""
    evaluation = open_evaluation(open_dataset(dataset), frames)
    metrics = evaluation.read(results, results.name).official  # type: ignore[attr-defined]
    by_class = {name: float(aps.mean()) for name, aps in zip(metrics.class_names, metrics.aps, strict=True)}
    return {"mAP": metrics.mean_ap, "NDS": metrics.nd_score, **by_class}

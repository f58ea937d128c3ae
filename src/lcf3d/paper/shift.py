"""Rows of the domain shift: a detector of one dataset on the frames of another (paper section 5.8)."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from lcf3d.errors import ConfigError
from lcf3d.evaluation.domain_report import COLUMNS, table_values
from lcf3d.evaluation.domain_shift import IOU_THRESHOLDS
from lcf3d.evaluation.domain_tasks import FRONT, FUSED, LIDAR_ALONE, DomainTask, DomainTaskRunner
from lcf3d.files import read_json, write_json
from lcf3d.fusion.config import FusionConfig
from lcf3d.paper.kept import Kept
from lcf3d.paper.networks import substitutes, with_setting
from lcf3d.paper.tables import Row, Table
from lcf3d.paper.workplace import Measured, Workplace, needed, root_of, run_name


def measure_shift(table: Table, row: Row, place: Workplace) -> Measured:
    """NDS^ and its parts, or AP over the IoU threshold, of one method on one task; both are kept and not run twice.

    Raises:
        NeedsError: data or weights are not here.
        ConfigError: what is kept was measured with other inputs.
        Lcf3dError: data, weights or result files are wrong.
    """
    lidar, camera, _ = needed(table, row, place)
    trained, tested = row.task or ("", "")
    if lidar.startswith("mvxnet:") and tested != trained:
        # the one camera that it looks through has another name there
        lidar = with_setting(lidar, f"camera={FRONT[tested]}")
    root = root_of(tested, place)
    split = "val" if (root / "ImageSets" / "val.txt").is_file() else None
    # a network's scores are probabilities; those of files may be anything
    calibration = "auto" if lidar.startswith("results:") else "none"
    task = DomainTask(trained, tested, f"{tested}:{root}", lidar, camera or None, split=split, calibration=calibration)
    kept = place.out / "runs" / f"shift+{trained}+{tested}+{run_name(table, row)}.json"
    inputs = asdict(task)
    content: dict[str, Any] = {} if place.overwrite or not kept.is_file() else read_json(kept)
    if content and content.get("task") != inputs:
        raise ConfigError(f"{kept} was measured with other inputs; pass --overwrite or another --out")
    if not content:
        content = {"task": inputs, **_measure(task, row, place)}
        write_json(kept, content)
    figures = content["figures"]
    values = tuple(None if (v := figures.get(column)) is None else float(v) for column in table.columns)
    notes = tuple(f"with {text}" for text in substitutes(row, place.uses))
    return Measured(values, int(content["frames"]), notes)


def _measure(task: DomainTask, row: Row, place: Workplace) -> dict[str, Any]:
    runner = DomainTaskRunner(task, FusionConfig.preset("paper"))
    kept, folder = Kept(), place.out / "detections"
    runner.lidar = kept.lidar(runner.lidar, folder, f"{task.lidar} of {task.trained}", task.dataset)
    if runner.camera is not None and task.camera is not None:
        # a run on nuScenes keeps those of the same network in ten classes
        runner.camera = kept.camera(runner.camera, folder, f"{task.camera} in KITTI's classes", task.dataset)
    advance = place.begin(row.name, len(runner))
    found = runner(advance=advance)[FUSED if row.camera else LIDAR_ALONE]
    figures = dict(zip(COLUMNS, map(float, table_values(found)), strict=True))
    for name, row_of_class in zip(found.metrics.class_names, found.ap_over_iou, strict=True):
        for threshold, ap in zip(IOU_THRESHOLDS, row_of_class, strict=True):
            figures[f"{name} {threshold:.1f}"] = float(ap)
    return {"frames": len(runner), "figures": {k: None if v != v else v for k, v in figures.items()}}

"""``lcf3d calibrate``: what the scores of two detectors mean, fitted on labelled frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from lcf3d.evaluation.calibration_study import CalibrationStudy, ClassReport
    from lcf3d.evaluation.memory_calibration import MemoryReport
    from lcf3d.evaluation.protocol import TableData
    from lcf3d.fusion.calibration import Calibration


def calibrate(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT or another installed kind, with labels")],
    lidar: Annotated[str, typer.Option(help="LiDAR detector, kind:argument, best results:PATH")],
    camera: Annotated[str, typer.Option(help="camera detector, kind:argument, best results:PATH")],
    out: Annotated[Path, typer.Option(help="calibration file to write")] = Path("calibration.json"),
    split: Annotated[str | None, typer.Option(help="split of the dataset; the usual one if left out")] = None,
    tables: Annotated[str | None, typer.Option(help="nuScenes: folder of tables; the only one if left out")] = None,
    folds: Annotated[int, typer.Option(help="parts of the cross-validation; 0 to leave it out")] = 5,
    config: Annotated[
        str | None, typer.Option(help="preset or YAML file whose matching is used; the dataset's if left out")
    ] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    missing: Annotated[str, typer.Option(help="results that are not there: error, or empty")] = "error",
    memory: Annotated[
        bool, typer.Option("--memory", help="fit the weights of run --memory too; frames must be of whole drives")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the report as JSON")] = False,
) -> None:
    """Fit score maps and evidence weights by class, and measure by cross-validation what they bring.

    Folds are whole drives where frames tell theirs or ids read SEQUENCE_FRAME, else blocks of consecutive frames.

    Example: lcf3d calibrate kitti:KITTI --split val --lidar results:point_gnn --camera results:rcnn --out c.json
    """
    from dataclasses import asdict

    from lcf3d.cli.console import console, plain, print_json, print_table, tracked
    from lcf3d.evaluation.calibration_study import open_study
    from lcf3d.evaluation.memory_calibration import MemoryStudy
    from lcf3d.remote.places import local_file
    from lcf3d.run.setup import RunRequest

    request = RunRequest(
        dataset, lidar, {"*": camera}, split, tables, config=config, changes=tuple(set_ or ()), missing=missing
    )
    study = open_study(request, folds, plain if json_ else tracked)
    drives = MemoryStudy(study) if memory else None
    calibration = study.fit()
    if drives is not None:
        calibration = drives.fit(calibration)
    frames = f"{len(study.frames)} frames" + (f" of split {split}" if split else "")
    calibration = calibration.model_copy(update={"source": f"{frames}, {lidar} with {camera}"})
    reports = study.cross_validate(calibration) if folds else []
    remembered = drives.cross_validate(calibration) if folds and drives is not None else []
    calibration.dump(local_file(out))
    if json_:
        values: dict[str, Any] = {"out": str(out), "frames": len(study.frames), "folds": folds}
        values |= {"classes": [asdict(r) for r in reports], "memory": [asdict(r) for r in remembered]}
        print_json(values)
        return
    print_table(calibration_table(study, calibration))
    if reports:
        print_table(report_table(reports, folds, study.evaluation.heading))
    if drives is not None:
        print_table(memory_table(calibration, remembered, folds, study.evaluation.heading))
    console().print(f"wrote {out}; use it with: lcf3d run ... --calibration {out}", soft_wrap=True)


def calibration_table(study: CalibrationStudy, calibration: Calibration) -> TableData:
    """One row a class, one column a weight."""
    from lcf3d.evaluation.protocol import TableData

    rows: list[tuple[str, ...] | None] = []
    weights = ("base", "trust", "miss", "off_ground", "competing")
    for name in study.config.class_names:
        maps = (calibration.lidar.get(name), calibration.camera.get(name))
        evidence = calibration.evidence.get(name)
        values = ["-" if evidence is None else f"{getattr(evidence, weight):.2f}" for weight in weights]
        support = "-" if evidence is None else " ".join(f"{value:.2f}" for value in evidence.support)
        rows.append((name, *("-" if m is None else f"{m.kind} {m.transform}" for m in maps), *values, support))
    columns = ("class", "LiDAR\nmap", "camera\nmap", "base", "trust", "miss", "off\nground", "other\nclass", "support")
    notes = ["support: log-odds of a 2D detection at image IoU .5 .7 .85 1; other class: of a competing box"]
    notes += [
        f"the camera never detects {name}: boxes of that class keep the LiDAR branch's score"
        for name in study.config.class_names
        if name not in study.camera_classes
    ]
    if study.doubles:
        notes.append(
            f"{study.doubles:,} of {len(study.lidar.scores):,} LiDAR boxes double a surer one in their cluster, as "
            "before suppression: one box a cluster was fitted on, as the fusion passes on"
        )
    title = f"fitted on {len(study.frames)} frames; evidence in log-odds"
    return TableData(title, columns, rows, tuple(notes))


def report_table(reports: Sequence[ClassReport], folds: int, heading: str) -> TableData:
    """What calibration did to each class."""
    from lcf3d.evaluation.protocol import TableData

    rows: list[tuple[str, ...] | None] = []
    for report in reports:
        losses = (report.log_loss_before, report.log_loss_lidar, report.log_loss_fused)
        rows.append(
            (
                report.class_name,
                str(report.lidar_count),
                str(report.camera_count),
                *("-" if value != value else f"{value:.3f}" for value in losses),
                *(" ".join(f"{value:.2f}" for value in values) for values in (report.before, report.after)),
            )
        )
    columns = ("class", "3D", "2D", "loss", "calib.", "fused", "LiDAR alone", "fused, cross-validated")
    note = f"3D, 2D: detections judged; loss: log loss of scores as they are, calibrated, and fused; then {heading}"
    return TableData(f"cross-validated, {folds} folds", columns, rows, (note,))


def memory_table(calibration: Calibration, reports: Sequence[MemoryReport], folds: int, heading: str) -> TableData:
    """The weights of the memory, and what it brings to each class."""
    from lcf3d.evaluation.protocol import TableData

    by_name = {report.class_name: report for report in reports}
    rows: list[tuple[str, ...] | None] = []
    for name, settings in calibration.memory.items():
        weights = (settings.seen_weight, settings.missed_weight, settings.base)
        figures: tuple[str, ...] = ("-",) * 3
        if name in by_name:
            report = by_name[name]
            each = (report.alone, report.default, report.fitted)
            figures = tuple(" ".join(f"{value:.2f}" for value in values) for values in each)
        rows.append((name, *(f"{value:.2f}" for value in weights), *figures))
    columns = ("class", "seen", "missed", "base", "frames alone", "memory, defaults", "memory, fitted")
    title = f"memory, cross-validated, {folds} folds" if reports else "memory"
    notes = [f"seen, missed: weights of the past of boxes that the frame has or misses; then {heading}"]
    if not rows:
        notes.append("no class has boxes enough: the defaults stay")
    return TableData(title, columns, rows, tuple(notes))

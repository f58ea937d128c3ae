"""``lcf3d calibrate``: what the scores of two detectors mean, fitted on labelled frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.evaluation.calibration_study import CalibrationStudy, ClassReport
    from lcf3d.fusion.calibration import Calibration
    from lcf3d.fusion.config import FusionConfig


def calibrate(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, with labels")],
    lidar: Annotated[str, typer.Option(help="results of the LiDAR detector, results:DIR")],
    camera: Annotated[str, typer.Option(help="results of the camera detector, results:DIR")],
    out: Annotated[Path, typer.Option(help="calibration file to write")] = Path("calibration.json"),
    split: Annotated[str, typer.Option(help="file of ROOT/ImageSets")] = "val",
    folds: Annotated[int, typer.Option(help="parts of the cross-validation; 0 to leave it out")] = 5,
    config: Annotated[str, typer.Option(help="preset or YAML file whose matching is used")] = "kitti",
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    missing: Annotated[str, typer.Option(help="result files that are not there: error, or empty")] = "error",
    json_: Annotated[bool, typer.Option("--json", help="print the report as JSON")] = False,
) -> None:
    """Fit score maps and evidence weights by class, and measure by cross-validation what they bring.

    Folds are blocks of consecutive frames, or whole sequences where frame ids read SEQUENCE_FRAME.

    Example: lcf3d calibrate kitti:KITTI --split val --lidar results:point_gnn --camera results:rcnn --out c.json
    """
    import json
    from dataclasses import asdict

    from lcf3d.run.settings import build_config

    settings = build_config(config, set_ or []).updated(ensemble="evidence", unmatched="downweight")
    study = open_study(dataset, split, lidar, camera, settings, folds, missing, quiet=json_)
    calibration = study.fit()
    calibration = calibration.model_copy(
        update={"source": f"{len(study.frames)} frames of split {split}, {lidar} with {camera}"}
    )
    calibration.dump(out)
    reports = study.cross_validate(calibration) if folds else []
    if json_:
        values = {"out": str(out), "frames": len(study.frames), "folds": folds}
        typer.echo(json.dumps({**values, "classes": [asdict(r) for r in reports]}, indent=2))
        return
    console = wide_console()
    _print_calibration(console, study, calibration)
    if reports:
        _print_reports(console, reports, folds)
    console.print(f"wrote {out}; use it with: lcf3d run ... --calibration {out}", soft_wrap=True)


def open_study(
    dataset: str,
    split: str,
    lidar: str,
    camera: str,
    settings: FusionConfig,
    folds: int,
    missing: str = "error",
    quiet: bool = False,
) -> CalibrationStudy:
    """Read frames, labels and results of both branches.

    Raises:
        Lcf3dError: something is absent, malformed or makes no sense; one sentence says what.
    """
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.datasets.opening import parse_dataset
    from lcf3d.evaluation.calibration_study import CalibrationStudy
    from lcf3d.formats.kitti import read_folder
    from lcf3d.fusion.calibration_fit import block_folds

    kind, root = parse_dataset(dataset)
    if kind != "kitti":
        raise ConfigError(f"calibrate reads kitti:ROOT, got {dataset!r}")
    if missing not in ("error", "empty"):
        raise ConfigError(f"--missing takes error or empty, got {missing!r}")
    data = KittiDataset(root, split, class_names=settings.class_names)
    truth = read_folder(data.folder / "label_2", data.ids, results=False)
    branches = [
        read_folder(
            results_path(text, option), data.ids, results=True, missing="empty" if missing == "empty" else "error"
        )
        for option, text in (("--lidar", lidar), ("--camera", camera))
    ]
    # the kind of each score map is chosen by cross-validation even where no report is asked for
    parts = block_folds(data.ids, folds or 2)
    progress = plain if quiet else tracked
    frames = [data[i] for i in range(len(data))]
    return CalibrationStudy(frames, truth, branches[0], branches[1], settings, parts, progress)


def results_path(text: str, option: str) -> Path:
    """The folder that ``results:DIR`` names.

    Raises:
        Lcf3dError: it is another kind, or the folder does not exist.
    """
    from lcf3d.evaluation.kitti import result_folder

    kind, _, folder = text.partition(":")
    if kind != "results" or not folder:
        raise ConfigError(f"{option} takes results:DIR here (KITTI result files), got {text!r}; write them with run")
    return result_folder(Path(folder))


def plain(indices: Sequence[int]) -> Iterator[int]:
    """The indices, without a progress bar."""
    return iter(indices)


def tracked(indices: Sequence[int]) -> Iterator[int]:
    """The indices under a progress bar."""
    from rich.console import Console
    from rich.progress import track

    return iter(track(indices, "matching", transient=True, console=Console(stderr=True)))


def wide_console() -> Any:
    """A console that does not fold tables into 80 columns where the output is no terminal."""
    from rich.console import Console

    console = Console()
    return console if console.is_terminal else Console(width=130)


def _print_calibration(console: Any, study: CalibrationStudy, calibration: Calibration) -> None:
    """One row a weight, one column a class."""
    from rich.table import Table

    names = list(study.config.class_names)
    table = Table(title=f"fitted on {len(study.frames)} frames; evidence in log-odds")
    table.add_column("")
    for name in names:
        table.add_column(name, justify="right")
    for title, maps in (("LiDAR score map", calibration.lidar), ("camera score map", calibration.camera)):
        table.add_row(title, *(f"{maps[n].kind}, {maps[n].transform}" if n in maps else "-" for n in names))
    found = [calibration.evidence.get(name) for name in names]
    for weight in ("base", "trust", "miss", "off_ground", "rival"):
        table.add_row(weight.replace("_", " "), *("-" if e is None else f"{getattr(e, weight):.2f}" for e in found))
    supports = ("-" if e is None else " ".join(f"{value:.2f}" for value in e.support) for e in found)
    table.add_row("support at IoU .5 .7 .85 1", *supports)
    console.print(table)
    for name in names:
        if name not in study.camera_classes:
            console.print(f"the camera never detects {name}: boxes of that class keep the LiDAR branch's score")


def _print_reports(console: Any, reports: Sequence[ClassReport], folds: int) -> None:
    from rich.table import Table

    table = Table(title=f"cross-validated, {folds} folds")
    for column in ("class", "LiDAR boxes", "2D boxes", "log loss: as is", "calibrated", "fused"):
        table.add_column(column, justify="right" if column != "class" else "left")
    table.add_column("3D AP R40, LiDAR", justify="right", no_wrap=True)
    table.add_column("fused", justify="right", no_wrap=True)
    for report in reports:
        losses = (report.log_loss_before, report.log_loss_lidar, report.log_loss_fused)
        table.add_row(
            report.class_name,
            str(report.lidar_count),
            str(report.camera_count),
            *("-" if value != value else f"{value:.3f}" for value in losses),
            *(" ".join(f"{value:.2f}" for value in values) for values in (report.before, report.after)),
        )
    console.print(table)

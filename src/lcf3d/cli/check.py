"""``lcf3d check``: numbered sanity rules over a dataset and result files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.datasets.base import Dataset
    from lcf3d.datasets.check import Finding


def check(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT or another installed kind")],
    split: Annotated[str | None, typer.Option(help="split of the dataset; all frames if left out")] = None,
    results: Annotated[Path | None, typer.Option(help="also check these result files")] = None,
    tables: Annotated[str | None, typer.Option(help="nuScenes: folder of tables; the only one if left out")] = None,
    lidar: Annotated[str | None, typer.Option(help="LiDAR detector, kind:argument: with it and --camera ...")] = None,
    camera: Annotated[
        str | None,
        typer.Option(help="... camera detector, kind:argument: how does each camera stand against the LiDAR?"),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="write a PNG of the first frame: images with the scan's points and the labels")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="print the findings as JSON")] = False,
) -> None:
    """Look a dataset over before it costs an evening: files, shapes, calibration against labels and scans.

    Exit code 0 without errors (warnings are allowed), 1 with errors.

    Examples:

    lcf3d check kitti:KITTI --split val --results runs/point_gnn/data

    lcf3d check kitti:KITTI --lidar results:point_gnn --camera results:rcnn_2d

    lcf3d check folder:drive --picture check.png
    """
    from dataclasses import asdict

    from rich.progress import Progress

    from lcf3d.cli.console import print_json
    from lcf3d.datasets.check_picture import draw_check
    from lcf3d.datasets.opening import check_dataset

    with Progress(disable=json_) as progress:

        def begin(frames: int) -> Callable[[], None]:
            task = progress.add_task("checking", total=frames)
            return lambda: progress.advance(task)

        def tell(opened: Dataset) -> None:
            if not json_:
                for line in opened.describe():
                    progress.console.print(line, markup=False, highlight=False, soft_wrap=True)
            if picture is not None:
                draw_check(opened).save(picture)

        findings = check_dataset(dataset, results, begin, tell, split=split, version=tables)
    if (lidar is None) != (camera is None):
        raise ConfigError("how cameras stand against the LiDAR takes both, --lidar and --camera")
    if lidar is not None and camera is not None:
        findings += _alignment(dataset, split, tables, lidar, camera, quiet=json_)
    if json_:
        print_json([asdict(finding) for finding in findings])
    else:
        _print(findings)
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(1)


def _alignment(
    dataset: str, split: str | None, tables: str | None, lidar: str, camera: str, quiet: bool
) -> list[Finding]:
    """How each camera stands, printed, and what is wrong with it."""
    from lcf3d.run.alignment import alignment_findings, describe, find_alignment
    from lcf3d.run.setup import RunRequest, read_inputs

    request = RunRequest(dataset, lidar, {"*": camera}, split=split, tables=tables, recovery="off")
    inputs = read_inputs(request)
    reports = find_alignment(inputs.dataset, inputs.frame_ids, inputs.lidar, inputs.cameras, inputs.config.class_names)
    if not quiet:
        for name, (whole, *_) in reports.items():
            typer.echo(f"camera {name}: {whole.status}; {describe(whole)}")
    return alignment_findings(reports)


def _print(findings: list[Finding]) -> None:
    for finding in findings:
        typer.echo(f"{finding.id} {finding.severity}: {finding.message}")
    errors = sum(finding.severity == "error" for finding in findings)
    typer.echo(f"{errors} errors, {len(findings) - errors} warnings" if findings else "all rules hold")

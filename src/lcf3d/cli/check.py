"""``lcf3d check``: numbered sanity rules over a dataset and result files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from lcf3d.datasets.check import Finding


def check(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT or another installed kind")],
    split: Annotated[str | None, typer.Option(help="split of the dataset; all frames if left out")] = None,
    results: Annotated[Path | None, typer.Option(help="also check these result files")] = None,
    tables: Annotated[str | None, typer.Option(help="nuScenes: folder of tables; the only one if left out")] = None,
    json_: Annotated[bool, typer.Option("--json", help="print the findings as JSON")] = False,
) -> None:
    """Look a dataset over before it costs an evening: files, shapes, calibration against labels and scans.

    Exit code 0 without errors (warnings are allowed), 1 with errors.

    Example: lcf3d check kitti:KITTI --split val --results runs/point_gnn/data
    """
    import json
    from dataclasses import asdict

    from rich.progress import Progress

    from lcf3d.datasets.opening import check_dataset

    with Progress(disable=json_) as progress:

        def begin(frames: int) -> Callable[[], None]:
            task = progress.add_task("checking", total=frames)
            return lambda: progress.advance(task)

        findings = check_dataset(dataset, results, begin, split=split, version=tables)
    if json_:
        typer.echo(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        _print(findings)
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(1)


def _print(findings: list[Finding]) -> None:
    for finding in findings:
        typer.echo(f"{finding.id} {finding.severity}: {finding.message}")
    errors = sum(finding.severity == "error" for finding in findings)
    typer.echo(f"{errors} errors, {len(findings) - errors} warnings" if findings else "all rules hold")

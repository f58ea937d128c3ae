"""``lcf3d check``: numbered sanity rules over a dataset and result files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from lcf3d.datasets.check import Finding


def check(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT or nuscenes:ROOT")],
    split: Annotated[str | None, typer.Option(help="file of ROOT/ImageSets (kitti); all frames if left out")] = None,
    results: Annotated[Path | None, typer.Option(help="also check this folder of KITTI result files")] = None,
    version: Annotated[str | None, typer.Option(help="tables to read (nuscenes); those there if left out")] = None,
    json_: Annotated[bool, typer.Option("--json", help="print the findings as JSON")] = False,
) -> None:
    """Look a dataset over before it costs an evening: files, shapes, calibration against labels and scans.

    Exit code 0 without errors (warnings are allowed), 1 with errors.

    Example: lcf3d check kitti:KITTI --split val --results runs/point_gnn/data
    """
    import json
    from dataclasses import asdict

    from lcf3d.datasets.opening import parse_dataset

    kind, root = parse_dataset(dataset)
    findings = _check_kitti(root, split, results, quiet=json_) if kind == "kitti" else _check_nuscenes(root, version)
    if json_:
        typer.echo(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        _print(findings)
    if any(finding.severity == "error" for finding in findings):
        raise typer.Exit(1)


def _check_kitti(root: Path, split: str | None, results: Path | None, quiet: bool) -> list[Finding]:
    from rich.progress import Progress

    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.datasets.kitti_check import check_kitti

    data = KittiDataset(root, split)
    with Progress(disable=quiet) as progress:
        task = progress.add_task("checking", total=len(data))
        return check_kitti(data, results, lambda: progress.advance(task))


def _check_nuscenes(root: Path, version: str | None) -> list[Finding]:
    from lcf3d.datasets.nuscenes_check import check_nuscenes

    return check_nuscenes(root, version)


def _print(findings: list[Finding]) -> None:
    for finding in findings:
        typer.echo(f"{finding.id} {finding.severity}: {finding.message}")
    errors = sum(finding.severity == "error" for finding in findings)
    typer.echo(f"{errors} errors, {len(findings) - errors} warnings" if findings else "all rules hold")

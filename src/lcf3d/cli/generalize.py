"""``lcf3d generalize``: detectors on other data than they were trained on, alone and fused (paper section 5.8)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from lcf3d.evaluation.domain_report import Results


def generalize(
    task: Annotated[
        list[str],
        typer.Option(help="TRAINED->TESTED DATASET lidar=SPEC, then camera=SPEC, split=NAME ...; repeatable"),
    ],
    out: Annotated[Path, typer.Option(help="folder for the report, the charts and the numbers")],
    config: Annotated[str, typer.Option(help="preset or YAML file, in KITTI's classes")] = "kitti",
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    class_: Annotated[
        list[str] | None, typer.Option("--class", help="evaluate only Car, Pedestrian or Cyclist; repeatable")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="print the numbers as JSON")] = False,
) -> None:
    """Compare LiDAR alone with the fusion where training and test data differ.

    A task names the data that the LiDAR detector was trained on and what it is tested on. Names that begin with kitti
    or nuscenes say what scans look like: a detector run here on points of the other kind gets them adapted (ground
    height, intensity, time channel, view). Result files are taken as they are.

    Example, two of the paper's four tasks:

    lcf3d generalize --out shift
    --task "kitti->kitti kitti:KITTI split=val lidar=results:point_gnn camera=results:rcnn_2d"
    --task "nuscenes->kitti kitti:KITTI split=val lidar=results:nus_on_kitti camera=results:rcnn_2d"
    """
    from rich.console import Console
    from rich.progress import Progress

    from lcf3d.cli.console import print_json
    from lcf3d.evaluation.domain_report import run_tasks, to_json
    from lcf3d.run.settings import build_config

    settings = build_config(config, list(set_ or ()))
    with Progress(console=Console(stderr=True), disable=json_, transient=True) as progress:

        def begin(name: str, frames: int) -> Callable[[], None]:
            bar = progress.add_task(name, total=frames)
            return lambda: progress.advance(bar)

        results = run_tasks(task, settings, out, tuple(class_ or ()), begin)
    if json_:
        print_json(to_json(results))
        return
    Console().print(_table(results))
    typer.echo(f"report in {out / 'report.html'}")


def _table(results: Results) -> Table:
    """The paper's table; the better of a task's methods is bold."""
    from rich.table import Table

    from lcf3d.evaluation.domain_report import COLUMNS, best_cells, table_values

    table = Table("task", "method", box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for column in COLUMNS:
        table.add_column(column, justify="right")
    for task, methods in results:
        best = best_cells(methods)
        for i, (method, metrics) in enumerate(methods.items()):
            cells = [
                f"[bold]{value:.3f}[/bold]" if is_best else f"{value:.3f}"
                for value, is_best in zip(table_values(metrics), best[method], strict=True)
            ]
            table.add_row(task.name if i == 0 else "", method, *cells)
    return table

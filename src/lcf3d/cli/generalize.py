"""``lcf3d generalize``: detectors on other data than they were trained on, alone and fused (paper section 5.6)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError

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
    import json

    from rich.console import Console

    from lcf3d.evaluation.domain_report import charts, html_report, standalone_svg, to_json
    from lcf3d.evaluation.domain_tasks import DomainTaskRunner, parse_task
    from lcf3d.files import write_json, write_text
    from lcf3d.run.settings import build_config
    from lcf3d.structures import KITTI_CLASSES

    names = tuple(class_ or KITTI_CLASSES)
    if unknown := [name for name in names if name not in KITTI_CLASSES]:
        raise ConfigError(f"--class takes {', '.join(KITTI_CLASSES)}, got {unknown[0]!r}")
    if out.is_file():
        raise ConfigError(f"{out} is a file; choose a folder for --out")
    settings = build_config(config, list(set_ or ()))
    # everything is opened before anything is run: most mistakes are found at once
    tasks = [parse_task(text) for text in task]
    if doubles := [t.name for i, t in enumerate(tasks) if t.name in {other.name for other in tasks[:i]}]:
        raise ConfigError(f"two tasks are named {doubles[0]!r}; tell them apart, for example as kitti-b->kitti")
    runners = [DomainTaskRunner(parsed, settings) for parsed in tasks]
    results = _run(runners, names, quiet=json_)
    settings.dump(out / "config.yaml")
    write_json(out / "domain_shift.json", to_json(results))
    write_text(out / "report.html", html_report(results))
    for (tested, name), svg in charts(results).items():
        write_text(out / "charts" / f"{tested}_{name}.svg".replace("/", "_"), standalone_svg(svg))
    if json_:
        typer.echo(json.dumps(to_json(results), indent=2))
        return
    Console().print(_table(results))
    typer.echo(f"report in {out / 'report.html'}")


def _run(runners: list, names: tuple[str, ...], quiet: bool) -> Results:  # type: ignore[type-arg]
    """All tasks under a progress bar."""
    from rich.console import Console
    from rich.progress import Progress

    results = []
    with Progress(console=Console(stderr=True), disable=quiet, transient=True) as progress:
        for runner in runners:
            bar = progress.add_task(runner.task.name, total=len(runner))
            results.append((runner.task, runner(names, lambda bar=bar: progress.advance(bar))))
    return results


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

"""``lcf3d bench``: speed on this machine, against budgets and references."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.benchmark.timing import Timing

WHAT = ("fusion", "eval")


def bench(
    what: Annotated[str, typer.Argument(help=" or ".join(WHAT))] = "fusion",
    dataset: Annotated[str | None, typer.Option(help="eval: also time this dataset, kitti:ROOT")] = None,
    results: Annotated[Path | None, typer.Option(help="eval: its result folder")] = None,
    seconds: Annotated[float, typer.Option(help="about how long to measure each figure")] = 1.0,
    json_: Annotated[bool, typer.Option("--json", help="print the figures as JSON")] = False,
) -> None:
    """Measure medians in milliseconds; machines are noisy, so compare ratios of one run.

    Examples:

    lcf3d bench fusion

    lcf3d bench eval --dataset kitti:KITTI --results runs/pointpillars
    """
    import json
    from dataclasses import asdict

    if what not in WHAT:
        raise ConfigError(f"bench measures {' or '.join(WHAT)}, got {what!r}")
    timings = _fusion(seconds) if what == "fusion" else _evaluation(dataset, results, seconds)
    if json_:
        typer.echo(json.dumps([{**asdict(t), "speedup": t.speedup} for t in timings], indent=2))
    else:
        _print(timings)


def _fusion(seconds: float) -> list[Timing]:
    from lcf3d.benchmark.fusion import bench_fusion

    return bench_fusion(seconds)


def _evaluation(dataset: str | None, results: Path | None, seconds: float) -> list[Timing]:
    from lcf3d.benchmark.evaluation import bench_evaluation
    from lcf3d.datasets.opening import parse_dataset

    if (dataset is None) != (results is None):
        raise ConfigError("bench eval takes --dataset and --results together")
    root = None
    if dataset is not None:
        kind, root = parse_dataset(dataset)
        if kind != "kitti":
            raise ConfigError(f"bench eval times kitti:ROOT, got {dataset!r}")
    return bench_evaluation(seconds, root, results)


def _print(timings: list[Timing]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("stage", "median ms", "best ms", "budget ms", "reference ms", "times faster", "a second")
    for t in timings:
        table.add_row(
            t.name,
            f"{t.median_ms:.3f}",
            f"{t.best_ms:.3f}",
            "" if t.budget_ms is None else f"{t.budget_ms:g}",
            "" if t.reference_ms is None else f"{t.reference_ms:.1f}",
            "" if t.speedup is None else f"{t.speedup:.0f}",
            f"{1000 * t.items / t.median_ms:.0f}",
        )
    Console().print(table)

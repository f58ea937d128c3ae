"""``lcf3d bench``: speed on this machine, against budgets and references."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.benchmark.timing import Timing

WHAT = ("fusion",)


def bench(
    what: Annotated[str, typer.Argument(help=" or ".join(WHAT))] = "fusion",
    seconds: Annotated[float, typer.Option(help="about how long to measure each figure")] = 1.0,
    json_: Annotated[bool, typer.Option("--json", help="print the figures as JSON")] = False,
) -> None:
    """Measure medians in milliseconds; machines are noisy, so compare ratios of one run.

    Example: lcf3d bench fusion
    """
    import json
    from dataclasses import asdict

    from lcf3d.benchmark.fusion import bench_fusion

    if what not in WHAT:
        raise ConfigError(f"bench measures {' or '.join(WHAT)}, got {what!r}")
    timings = bench_fusion(seconds)
    if json_:
        typer.echo(json.dumps([{**asdict(t), "speedup": t.speedup} for t in timings], indent=2))
    else:
        _print(timings)


def _print(timings: list[Timing]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("stage", "median ms", "best ms", "budget ms", "reference ms", "times faster")
    for t in timings:
        table.add_row(
            t.name,
            f"{t.median_ms:.3f}",
            f"{t.best_ms:.3f}",
            "" if t.budget_ms is None else f"{t.budget_ms:g}",
            "" if t.reference_ms is None else f"{t.reference_ms:.1f}",
            "" if t.speedup is None else f"{t.speedup:.0f}",
        )
    Console().print(table)

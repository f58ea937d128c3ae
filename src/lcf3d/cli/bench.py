"""``lcf3d bench``: speed on this machine, against budgets and references."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.benchmark.timing import Timing

SIMULATION_BUDGET_MS = 1000.0


def bench(
    what: Annotated[str, typer.Argument(help="fusion, eval, simulate or detectors")] = "fusion",
    dataset: Annotated[str | None, typer.Option(help="eval: also time this dataset, kitti:ROOT")] = None,
    results: Annotated[Path | None, typer.Option(help="eval: its result folder")] = None,
    name: Annotated[list[str] | None, typer.Option(help="detectors: only this configuration; repeatable")] = None,
    seconds: Annotated[float, typer.Option(help="fusion, eval: about how long to measure each figure")] = 1.0,
    json_: Annotated[bool, typer.Option("--json", help="print the figures as JSON")] = False,
) -> None:
    """Measure medians on this machine; machines are noisy, so compare ratios of one run.

    Examples:

    lcf3d bench fusion

    lcf3d bench eval --dataset kitti:KITTI --results runs/pointpillars

    lcf3d bench detectors --name pointpillars-kitti
    """
    from lcf3d.cli.console import print_json

    benches: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "fusion": lambda: _fusion(seconds),
        "eval": lambda: _evaluation(dataset, results, seconds),
        "simulate": _simulation,
        "detectors": lambda: _detectors(name),
    }
    if what not in benches:
        raise ConfigError(f"bench measures {', '.join(benches)}, got {what!r}")
    rows = benches[what]()
    if json_:
        print_json(rows)
    else:
        _print(rows)


def _fusion(seconds: float) -> list[dict[str, Any]]:
    from lcf3d.benchmark.fusion import bench_fusion

    return [_row(timing) for timing in bench_fusion(seconds)]


def _evaluation(dataset: str | None, results: Path | None, seconds: float) -> list[dict[str, Any]]:
    from lcf3d.benchmark.evaluation import bench_evaluation
    from lcf3d.datasets.opening import root_of

    if (dataset is None) != (results is None):
        raise ConfigError("bench eval takes --dataset and --results together")
    root = None
    if dataset is not None:
        _, root = root_of(dataset, ("kitti",), "bench eval")
    return [_row(timing) for timing in bench_evaluation(seconds, root, results)]


def _simulation() -> list[dict[str, Any]]:
    from lcf3d.simulation.bench import benchmark

    medians = benchmark()
    return [
        {"stage": name, "median_ms": value * 1e3, "budget_ms": SIMULATION_BUDGET_MS if name == "frame" else None}
        for name, value in medians.items()
    ]


def _detectors(names: list[str] | None) -> list[dict[str, Any]]:
    from lcf3d.detectors.camera.torchvision_benchmarking import NETWORKS, benchmark_camera
    from lcf3d.detectors.lidar.benchmarking import benchmark

    if not names:
        return [cost.to_dict() for cost in (*benchmark(), *benchmark_camera())]
    lidar = benchmark([name for name in names if name not in NETWORKS])
    camera = benchmark_camera([name for name in names if name in NETWORKS])
    return [cost.to_dict() for cost in (*lidar, *camera)]


def _row(timing: Timing) -> dict[str, Any]:
    values = asdict(timing)
    items = values.pop("items")
    speed = {"times_faster": timing.speedup, "per_second": 1000 * items / timing.median_ms}
    return {"stage": values.pop("name"), **values, **speed}


_SHORT = {
    "stage": "stage",
    "name": "network",
    "runtime": "runtime",
    "median_ms": "ms",
    "budget_ms": "wanted",
    "reference_ms": "other\nms",
    "times_faster": "times\nfaster",
    "per_second": "per\nsecond",
    "memory_mb": "MB",
    "gflops": "GFLOP",
    "parameters_m": "Mpar",
}
"""Headings that leave room for the figures in a terminal of 80 columns."""


def _print(rows: list[dict[str, Any]]) -> None:
    from lcf3d.cli.console import print_table
    from lcf3d.evaluation.protocol import TableData

    # columns that hold nothing are left out
    names = [name for name in rows[0] if any(row[name] is not None for row in rows)]
    columns = tuple(_SHORT.get(name, name.replace("_", "\n")) for name in names)
    print_table(TableData("", columns, [tuple(_text(row[name]) for name in names) for row in rows]))


def _text(value: Any) -> str:
    if value is None:
        return ""
    return (
        f"{value:.3g}"
        if isinstance(value, float) and abs(value) < 100
        else f"{value:.0f}"
        if isinstance(value, float)
        else str(value)
    )

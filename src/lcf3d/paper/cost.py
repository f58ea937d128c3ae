"""The paper's table of complexity measured on this machine (paper section 5.7.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from lcf3d.paper.networks import NeedsError
from lcf3d.paper.tables import Row, Table
from lcf3d.paper.workplace import Measured

LIDAR, CAMERA, MATCHING, RECOVERY, SEMANTIC, WHOLE = range(6)
"""Rows that are measured, in the order of the table; those of other systems follow."""

Costs = tuple[float | None, float | None, float | None]
"""Milliseconds, GFLOPs and megabytes of one module."""


def measure_costs(fusion_ms: Callable[[], Mapping[str, float]], device: str = "cpu") -> list[Costs]:
    """Costs of `LIDAR` to `WHOLE`: untrained weights, whose operations are those of trained ones.

    Args:
        fusion_ms: measures the fusion; milliseconds of ``matching``, ``recovery`` and ``semantic``.
        device: torch device of the networks; the fusion runs on the CPU.
    """
    from lcf3d.detectors.camera.torchvision_benchmarking import benchmark_camera
    from lcf3d.detectors.lidar.benchmarking import benchmark

    networks = [
        benchmark(["pointpillars-kitti"], device=device, onnx=False)[0],
        benchmark_camera(["fasterrcnn-r101-kitti"], device=device)[0],
    ]
    times = fusion_ms()
    costs: list[Costs] = [(cost.milliseconds, cost.gflops, cost.peak_memory_mb) for cost in networks]
    costs += [(times[name], None, None) for name in ("matching", "recovery", "semantic")]
    # the branches run side by side, so the slower one counts
    ms = max(cost.milliseconds for cost in networks) + sum(times.values())
    gflops = [cost.gflops for cost in networks]
    memory = [cost.peak_memory_mb for cost in networks]
    known = None if None in memory else max(m for m in memory if m is not None)
    costs.append((ms, None if None in gflops else sum(g for g in gflops if g is not None), known))
    return costs


def cost_rows(table: Table, rows: tuple[Row, ...], costs: list[Costs], device: str) -> dict[str, Measured]:
    """Measured values of the table's rows by name.

    Raises:
        NeedsError: none of the rows is one that is measured.
    """
    found = {}
    for row, values in zip(table.rows, costs, strict=False):
        if row in rows:
            found[row.name] = Measured(values, 1, (f"on {device}, untrained weights",))
    if not found:
        raise NeedsError("; ".join(row.needs for row in rows))
    return found

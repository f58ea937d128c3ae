"""The paper's table of complexity measured on this machine (paper section 5.7.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from lcf3d.paper.networks import NeedsError, spec_of, with_device
from lcf3d.paper.tables import Row, Table
from lcf3d.paper.workplace import Measured, without_values
from lcf3d.structures import KITTI_CLASSES

LIDAR, CAMERA, MATCHING, RECOVERY, SEMANTIC, WHOLE = range(6)
"""Rows that are measured, in the order of the table; those of other systems follow."""

Costs = tuple[float | None, float | None, float | None]
"""Milliseconds, GFLOPs and megabytes of one module."""

NETWORKS = {"lidar": "pointpillars-kitti", "camera": "fasterrcnn-r101-kitti"}
"""The network of each branch."""
_RUN: dict[int, tuple[str, ...]] = {LIDAR: ("lidar",), CAMERA: ("camera",), WHOLE: ("lidar", "camera")}


def networks_of(table: Table, row: Row) -> tuple[str, ...]:
    """Published names of all that a row runs; those that the costs are measured of too."""
    return tuple(NETWORKS.values()) if table.measure == "cost" else row.networks


def measure_costs(
    fusion_ms: Callable[[], Mapping[str, float]], uses: Mapping[str, str], device: str = "cpu"
) -> list[Costs]:
    """Costs of `LIDAR` to `WHOLE`, of what stands for the networks or else of untrained ones, which cost as much.

    Args:
        fusion_ms: measures the fusion; milliseconds of ``matching``, ``recovery`` and ``semantic``.
        uses: what stands for `NETWORKS`, see `lcf3d.paper.networks.spec_of`.
        device: torch device of the networks; the fusion runs on the CPU.

    Raises:
        NeedsError: result files stand for a network, of which nothing can be timed.
        Lcf3dError: what stands for a network cannot be loaded.
    """
    from lcf3d.detectors.camera.torchvision_benchmarking import benchmark_camera
    from lcf3d.detectors.lidar.benchmarking import benchmark

    untrained: dict[str, Callable[[], Any]] = {
        "lidar": lambda: benchmark([NETWORKS["lidar"]], device=device, onnx=False)[0],
        "camera": lambda: benchmark_camera([NETWORKS["camera"]], device=device)[0],
    }
    networks: list[Costs] = []
    branches: tuple[Literal["lidar", "camera"], ...] = ("lidar", "camera")
    for branch in branches:
        name = NETWORKS[branch]
        if name in uses:
            networks.append(_cost_of(with_device(spec_of(name, branch, uses), device), branch, device))
        else:
            cost = untrained[branch]()
            networks.append((cost.milliseconds, cost.gflops, cost.peak_memory_mb))
    times = fusion_ms()
    costs = [*networks, *((times[name], None, None) for name in ("matching", "recovery", "semantic"))]
    # the branches run side by side, so the slower one counts
    ms = max(cost[0] or 0.0 for cost in networks) + sum(times.values())
    gflops = [cost[1] for cost in networks]
    memory = [cost[2] for cost in networks]
    known = None if None in memory else max(m for m in memory if m is not None)
    costs.append((ms, None if None in gflops else sum(g for g in gflops if g is not None), known))
    return costs


def _cost_of(spec: str, branch: Literal["lidar", "camera"], device: str) -> Costs:
    """Cost of a detector on a made-up scan, or on noise of the size of KITTI's images."""
    from lcf3d.detectors.lidar.benchmarking import count_gflops, example_scan, median_ms, peak_memory_mb
    from lcf3d.detectors.named import load_detector

    if spec.startswith("results:"):
        raise NeedsError(f"a detector to time in the place of {spec}")
    detector = load_detector(spec, branch, KITTI_CLASSES)
    noise = np.random.default_rng(0).integers(0, 256, (375, 1242, 3), dtype=np.uint8)
    given: Any = example_scan() if branch == "lidar" else [noise]

    def run() -> None:
        detector(given)

    run()
    memory = peak_memory_mb(run, device)
    # onnxruntime's operations are not seen
    gflops = count_gflops(run) or None
    return median_ms(run, 3, device), gflops, memory


def cost_rows(
    table: Table, rows: tuple[Row, ...], costs: list[Costs], uses: Mapping[str, str], device: str
) -> dict[str, Measured]:
    """Measured values of the table's rows by name; of rows that are not measured, what that would need."""
    found = {row.name: without_values(table, row.needs) for row in rows if row.needs}
    for i, (row, values) in enumerate(zip(table.rows, costs, strict=False)):
        if row in rows:
            names = [NETWORKS[branch] for branch in _RUN.get(i, ())]
            stand_ins = [f"{uses[name]} for {name}" for name in names if name in uses]
            weights = f"with {', '.join(stand_ins)}" if stand_ins else "untrained weights"
            found[row.name] = Measured(values, 1, (f"on {device}, {weights}" if names else "on cpu",))
    return found

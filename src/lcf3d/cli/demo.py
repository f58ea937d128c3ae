"""``lcf3d demo``: the method on a drive that comes with the package, without data, network or torch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from lcf3d.demo.drive import DemoResult


def demo(
    out: Annotated[Path, typer.Option(help="folder for the pictures")] = Path("lcf3d-demo"),
    frames: Annotated[int, typer.Option(min=1, max=20, help="frames to drive")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="of the detectors' noise, misses and false alarms")] = 0,
    json_: Annotated[bool, typer.Option("--json", help="print the figures as JSON")] = False,
) -> None:
    """Drive along a simulated street, fuse a camera with a LiDAR, compare with the LiDAR alone.

    Images, scans and labels come with the package (made by lcf3d simulate). The detectors are made from the labels
    with noise, misses and false alarms: the figures show what the fusion does, not how good any detector is.
    """
    import json

    from rich.progress import Progress

    from lcf3d.demo.drive import demo_frames, run_demo, write_pictures

    with Progress(disable=json_) as progress:
        driven = list(progress.track(demo_frames(frames, seed), total=frames, description="driving "))
        task = progress.add_task("fusing  ", total=None)
        result = run_demo(driven)
        progress.update(task, total=1, completed=1)
        task = progress.add_task("drawing ", total=None)
        paths = write_pictures(result, out)
        progress.update(task, total=1, completed=1)
    if json_:
        figures = {name: metrics.to_json() for name, metrics in result.metrics.items()}
        typer.echo(json.dumps({"fusion_ms": result.fusion_ms, "variants": figures}, indent=2))
    else:
        _print(result, paths)


def _print(result: DemoResult, paths: list[Path]) -> None:
    from rich.console import Console
    from rich.table import Table

    first = next(iter(result.metrics.values()))
    table = Table(title=f"{len(result.frames)} frames: average precision by class (centre distance 0.5 to 4 m)")
    table.add_column("")
    for name in first.class_names:
        table.add_column(name, justify="right")
    table.add_column("mAP", justify="right")
    table.add_column("NDS^", justify="right")
    for variant, metrics in result.metrics.items():
        by_class = metrics.aps.mean(axis=1)
        table.add_row(
            variant, *(f"{100 * ap:.1f}" for ap in by_class), f"{100 * metrics.mean_ap:.1f}", f"{metrics.nds_hat:.3f}"
        )
    console = Console()
    console.print(table)
    console.print(
        "paper: what the camera does not confirm is deleted. kitti: it is weighed, see docs/when-fusion-helps.md"
    )
    console.print(f"\nfusion: {result.fusion_ms:.1f} ms a frame (median). Some of its decisions:")
    for sentence in _examples(result):
        console.print(f"  {sentence}", soft_wrap=True)
    console.print(f"\npictures: {paths[0].parent}/ (frame by frame, and {paths[-1].name})", soft_wrap=True)


def _examples(result: DemoResult) -> list[str]:
    """Sentences on matched, recovered and doubted boxes of the frame with most recovered ones."""
    import numpy as np

    from lcf3d.provenance import Stage

    fused = max(result.fused, key=lambda f: int((f.stages == Stage.RECOVERED).sum()))
    name = result.frames[result.fused.index(fused)].frame.id
    stages = (Stage.MATCHED, Stage.RECOVERED, Stage.KEPT)
    chosen = [int(i) for stage in stages for i in np.flatnonzero(fused.stages == stage)[:2]]
    return [f"frame {name}: {fused.explain(i)}" for i in chosen]

"""``lcf3d demo``: the method on a drive that comes with the package, without data, network or torch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from lcf3d.demo.drive import DemoResult


def demo(
    out: Annotated[Path, typer.Option(help="folder for the pictures")] = Path("lcf3d-demo"),
    frames: Annotated[int, typer.Option(min=1, max=20, help="frames to drive")] = 20,
    view: Annotated[bool, typer.Option("--view", help="open the animation when done")] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the figures as JSON")] = False,
) -> None:
    """Drive along a simulated street with two small networks, fuse them, compare with the LiDAR alone.

    Images, scans, labels and both networks come with the package; the networks were trained on other simulated
    streets (lcf3d train lidar, lcf3d train camera), not on this one.
    """
    import json

    from rich.console import Console
    from rich.progress import Progress

    from lcf3d.demo.drive import drive, measure, shipped_detectors, write_pictures

    with Progress(disable=json_, console=Console(stderr=True)) as progress:
        detectors = shipped_detectors()
        driven = list(progress.track(drive(detectors, frames), total=frames, description="driving  "))
        task = progress.add_task("measuring", total=None)
        result = measure(driven)
        progress.update(task, total=1, completed=1)
        task = progress.add_task("drawing  ", total=None)
        paths = write_pictures(driven, out)
        progress.update(task, total=1, completed=1)
    if json_:
        variants = {
            name: {**metrics.to_json(), "fusion_ms": result.fusion_ms.get(name)}
            for name, metrics in result.metrics.items()
        }
        figures = {"stage_ms": result.stage_ms, "frames_per_second": result.frames_per_second, "variants": variants}
        typer.echo(json.dumps(figures, indent=2))
    else:
        _print(result, paths)
    if view:
        typer.launch(str(paths[-1]))


def _print(result: DemoResult, paths: list[Path]) -> None:
    from rich.console import Console

    # paths and sentences of the fusion are no markup
    console = Console(markup=False, highlight=False)
    console.print(_table(result))
    console.print(
        "matching: what the camera does not confirm is deleted (paper). weighed: it is doubted, see "
        "docs/when-fusion-helps.md",
        soft_wrap=True,
    )
    stages = ", ".join(f"{name} {value:.0f} ms" for name, value in result.stage_ms.items() if name != "frame")
    console.print(
        f"\nmedian of a frame: {stages}: {result.frames_per_second:.1f} frames a second. Some decisions:",
        soft_wrap=True,
    )
    for sentence in _examples(result):
        console.print(f"  {sentence}", soft_wrap=True)
    console.print(f"\npictures: {paths[0].parent}/ (frame by frame, and {paths[-1].name})", soft_wrap=True)


def _table(result: DemoResult) -> Table:
    """One row a variant: AP by class, means, milliseconds."""
    from rich.box import SIMPLE
    from rich.table import Table

    first = next(iter(result.metrics.values()))
    title = f"{len(result.frames)} frames: average precision (centre distance 0.5 to 4 m), fusion time"
    table = Table(title=title, box=SIMPLE, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("", *first.class_names, "mAP", "NDS^", "ms"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for variant, metrics in result.metrics.items():
        spent = result.fusion_ms.get(variant)
        table.add_row(
            variant,
            *(f"{100 * ap:.1f}" for ap in metrics.aps.mean(axis=1)),
            f"{100 * metrics.mean_ap:.1f}",
            f"{metrics.nds_hat:.3f}",
            "" if spent is None else f"{spent:.1f}",
        )
    return table


def _examples(result: DemoResult) -> list[str]:
    """Sentences on matched, recovered and doubted boxes of the frame with most recovered ones."""
    import numpy as np

    from lcf3d.provenance import Outcome

    item = max(result.frames, key=lambda f: int((f.fused.outcomes == Outcome.RECOVERED).sum()))
    outcomes = (Outcome.MATCHED, Outcome.RECOVERED, Outcome.KEPT)
    chosen = [int(i) for outcome in outcomes for i in np.flatnonzero(item.fused.outcomes == outcome)[:2]]
    return [f"frame {item.frame.id}: {item.fused.explain(i)}" for i in chosen]

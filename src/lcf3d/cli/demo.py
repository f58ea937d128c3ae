"""``lcf3d demo``: the method on a drive that comes with the package, without data, network or torch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.table import Table

    from lcf3d.demo.drive import DemoResult


def demo(
    out: Annotated[Path, typer.Option(help="folder for the pictures")] = Path("lcf3d-demo"),
    frames: Annotated[int, typer.Option(min=1, max=20, help="frames to drive")] = 20,
    view: Annotated[bool, typer.Option("--view", help="open the animation when done")] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the figures as JSON")] = False,
) -> None:
    """Drive along a simulated street with two small networks, fuse them, compare with the LiDAR alone.

    The street is seen by the LiDAR that the network was trained for, and again by one with a quarter of its beams.
    Images, scans, labels and both networks come with the package; the networks were trained on other simulated
    streets (benchmarks/train_all.py), not on this one, and the fusion's settings are the defaults.
    """
    from rich.console import Console
    from rich.progress import Progress

    from lcf3d.cli.console import print_json
    from lcf3d.demo.drive import LIDARS, drive, measure, shipped_detectors, write_pictures

    with Progress(disable=json_, console=Console(stderr=True)) as progress:
        detectors = shipped_detectors()
        driven = list(progress.track(drive(detectors, frames), total=frames, description="driving  "))
        by_lidar = {name: [moment[name] for moment in driven] for name in LIDARS}
        results = {
            name: measure(seen)
            for name, seen in progress.track(by_lidar.items(), total=len(LIDARS), description="measuring")
        }
        paths = [
            path
            for name, seen in progress.track(by_lidar.items(), total=len(LIDARS), description="drawing  ")
            for path in write_pictures(seen, out / name.replace(" ", "-"))
        ]
    if json_:
        print_json({name: _figures(result) for name, result in results.items()})
    else:
        _print(results, out)
    if view:
        typer.launch(str(paths[-1]))


def _figures(result: DemoResult) -> dict[str, Any]:
    """The figures of one LiDAR as plain data."""
    variants = {
        name: {**metrics.to_json(), "fusion_ms": result.fusion_ms.get(name)} for name, metrics in result.metrics.items()
    }
    return {"stage_ms": result.stage_ms, "frames_per_second": result.frames_per_second, "variants": variants}


def _print(results: Mapping[str, DemoResult], out: Path) -> None:
    from rich.console import Console

    # paths and sentences of the fusion are no markup
    console = Console(markup=False, highlight=False)
    console.print(_table(results))
    console.print(
        "The paper's filter deletes what the camera does not confirm; recovery finds boxes behind camera detections\n"
        "that no LiDAR box explains; the default doubts instead of deleting (docs/when-fusion-helps.md).",
        soft_wrap=True,
    )
    for name, result in results.items():
        stages = ", ".join(f"{stage} {value:.0f} ms" for stage, value in result.stage_ms.items() if stage != "frame")
        console.print(f"\n{name}, median: {stages}: {result.frames_per_second:.1f} frames a second", soft_wrap=True)
        for sentence in _examples(result):
            console.print(f"  {sentence}", soft_wrap=True)
    console.print(f"\npictures, and an animation, of each LiDAR: {out}/", soft_wrap=True)


def _table(results: Mapping[str, DemoResult]) -> Table:
    """One row for each LiDAR and variant: AP by class, means, milliseconds."""
    from rich.box import SIMPLE
    from rich.table import Table

    first = next(iter(results.values()))
    classes = next(iter(first.metrics.values())).class_names
    title = f"{len(first.frames)} frames: average precision (centre distance 0.5 to 4 m), fusion time"
    table = Table(title=title, box=SIMPLE, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("", "", *classes, "mAP", "NDS^", "ms"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for lidar, result in results.items():
        for row, (variant, metrics) in enumerate(result.metrics.items()):
            spent = result.fusion_ms.get(variant)
            table.add_row(
                "" if row else lidar,
                variant,
                *(f"{100 * ap:.1f}" for ap in metrics.aps.mean(axis=1)),
                f"{100 * metrics.mean_ap:.1f}",
                f"{metrics.nds_hat:.3f}",
                "" if spent is None else f"{spent:.1f}",
            )
        table.add_section()
    return table


def _examples(result: DemoResult) -> list[str]:
    """Sentences on matched, recovered and doubted boxes of the frame with most recovered ones."""
    import numpy as np

    from lcf3d.reasons import Outcome

    item = max(result.frames, key=lambda f: int((f.fused.outcomes == Outcome.RECOVERED).sum()))
    outcomes = (Outcome.MATCHED, Outcome.RECOVERED, Outcome.KEPT)
    chosen = [int(i) for outcome in outcomes for i in np.flatnonzero(item.fused.outcomes == outcome)[:1]]
    return [f"frame {item.frame.id}: {item.fused.explain(i)}" for i in chosen]

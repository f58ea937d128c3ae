"""``lcf3d simulate``: street scenes in KITTI or nuScenes layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder to write the data set to; must be empty or new unless --resume.")],
    preset: Annotated[
        str,
        typer.Option(
            help="kitti64, mono64, sparse16, rain, night, train_kitti, train_mono (KITTI layout), nuscenes32 or "
            "train_nuscenes (nuScenes layout)."
        ),
    ] = "kitti64",
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 20,
    seed: Annotated[int, typer.Option(help="Equal seeds give equal bytes.")] = 0,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="Drives of up to 40 consecutive frames instead of single scenes.")
    ] = False,
    street: Annotated[
        str | None, typer.Option(help="residential, city, avenue, country or square; a mix when not given.")
    ] = None,
    density: Annotated[float, typer.Option(help="Factor on the number of road users.")] = 1.0,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Complete a data set whose simulation was interrupted.")
    ] = False,
) -> None:
    """Simulate LiDAR scans and camera images of street scenes, with exact labels.

    lcf3d simulate drive --frames 20 --sequence

    lcf3d simulate night --preset night --frames 100 --jobs 2
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from lcf3d.simulation.presets import get_preset
    from lcf3d.simulation.writer import Recipe, write_dataset

    recipe = Recipe(preset, frames, seed, sequence, street, density)
    console = Console(stderr=True, markup=False, highlight=False)
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("frames", total=frames)
        ids = write_dataset(recipe, out, jobs, resume, lambda n: bar.advance(task, n))
    layout = get_preset(preset).layout
    console.print(f"{len(ids)} frame{'s' * (len(ids) != 1)} in {out}; look at one with: lcf3d view {layout}:{out}")

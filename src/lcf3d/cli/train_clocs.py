"""``lcf3d train clocs``: the rival CLOCs on result files of two detectors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def clocs(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT or another installed kind, with labels")],
    lidar: Annotated[str, typer.Option(help="LiDAR detector, kind:argument, for example results:DIR")],
    camera: Annotated[str, typer.Option(help="camera detector, kind:argument, for example results:DIR")],
    out: Annotated[Path, typer.Option(help="file for the networks")] = Path("clocs.json"),
    split: Annotated[str | None, typer.Option(help="split of the dataset; the usual one if left out")] = None,
    folds: Annotated[int, typer.Option(min=0, help="also cross-validate in so many parts; 0 for none")] = 5,
    steps: Annotated[int | None, typer.Option(min=1, help="batches of each network; 1,000 if left out")] = None,
    seed: Annotated[int, typer.Option(min=0, help="of weights and batches")] = 0,
) -> None:
    """Train CLOCs, learned fusion of 3D and 2D candidates, and cross-validate it beside the LiDAR branch alone.

    lcf3d train clocs kitti:KITTI --lidar results:pointrcnn --camera results:rrc_2d --out clocs.json

    Fused results in Python: ClocsFusion.load("clocs.json")(frame, lidar, camera).
    """
    from dataclasses import replace

    from lcf3d.cli.console import console, print_table
    from lcf3d.errors import ConfigError
    from lcf3d.evaluation.calibration_study import open_study
    from lcf3d.evaluation.protocol import TableData
    from lcf3d.run.setup import RunRequest
    from lcf3d.training.clocs import SETTINGS, cross_validate, train_clocs

    if folds == 1:
        raise ConfigError("--folds takes 0, or 2 and more: one part leaves nothing to train on")
    settings = replace(SETTINGS, steps=steps or SETTINGS.steps, seed=seed)
    study = open_study(RunRequest(dataset, lidar, {"*": camera}, split), folds)
    fusion, absent = train_clocs(study, settings)
    fusion.dump(out)
    for name, reason in absent.items():
        console().print(f"{name}: no network, {reason}")
    if folds:
        alone = study.evaluation.figures(study.lidar_inputs)
        found = cross_validate(study, tuple(fusion.networks), settings)
        rows: list[tuple[str, ...] | None] = []
        for name, values in found.items():
            for way, figures in (("LiDAR alone", alone[name]), ("CLOCs", values)):
                rows.append((name if way != "CLOCs" else "", way, *(f"{value:.2f}" for value in figures)))
        title = f"{study.evaluation.heading}, {len(study.frames)} frames, {folds} folds"
        print_table(TableData(title, ("class", "", *study.evaluation.columns), rows))
    console().print(f"wrote {out}")

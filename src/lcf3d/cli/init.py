"""``lcf3d init``: a first ``sensors.yaml`` for a folder of images and scans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def init(
    root: Annotated[Path, typer.Argument(help="folder that holds images and scans, each sensor's in a folder")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the sensors.yaml that is there")] = False,
) -> None:
    """Write a first sensors.yaml from what lies in a folder, and say what in it was guessed.

    Example: lcf3d init drive
    """
    from lcf3d.datasets.folder_init import init_folder

    sensors, guessed = init_folder(root.expanduser(), overwrite)
    for name, lidar in sensors.lidars.items():
        typer.echo(f"LiDAR {name}: {lidar.scans}, columns {' '.join(lidar.columns)}, {lidar.axes}")
    for name, camera in sensors.cameras.items():
        size = "" if camera.size is None else f", {camera.size[0]} x {camera.size[1]}"
        typer.echo(f"camera {name}: {camera.images}{size}")
    if sensors.labels is not None:
        typer.echo(f"labels: {sensors.labels}, classes {', '.join(sensors.classes)}")
    typer.echo("guessed, correct it:")
    for what in guessed:
        typer.echo(f"  {what}")
    typer.echo(f"written to {root / 'sensors.yaml'}; look at it with: lcf3d check folder:{root} --picture check.png")

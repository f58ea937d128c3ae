"""``lcf3d train``: the small networks, each with one command from the simulation to an ONNX file."""

from __future__ import annotations

import typer

from lcf3d.cli.train_camera import camera
from lcf3d.cli.train_lidar import lidar
from lcf3d.cli.train_localizer import localizer

train = typer.Typer(
    name="train",
    help="Train the small networks: localizer, LiDAR detector, camera detector (needs the extra 'train').",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for verb in (localizer, lidar, camera):
    train.command(verb.__name__)(verb)

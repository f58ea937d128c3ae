"""``lcf3d train``: the small networks, each with one command."""

from __future__ import annotations

import typer

from lcf3d.cli.train_camera import camera
from lcf3d.cli.train_clocs import clocs
from lcf3d.cli.train_lidar import lidar
from lcf3d.cli.train_localizer import localizer
from lcf3d.cli.train_quantize import quantize

train = typer.Typer(
    name="train",
    help="Train the small networks: localizer, LiDAR detector, camera detector, CLOCs (needs the extra 'train').",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for verb in (localizer, lidar, camera, clocs, quantize):
    train.command(verb.__name__)(verb)

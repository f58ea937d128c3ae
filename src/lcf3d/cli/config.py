"""``lcf3d config``: print settings, to read or to keep in a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def config(
    preset: Annotated[
        str, typer.Argument(help="preset (default, paper, kitti, nuscenes, argoverse2) or a YAML file")
    ] = "default",
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    stereo: Annotated[bool, typer.Option("--stereo", help="with the settings of stereo pairs")] = False,
    out: Annotated[Path | None, typer.Option(help="write to this file instead of the screen")] = None,
) -> None:
    """Print all settings of a preset or file, with a word on each.

    Example: lcf3d config kitti --set unmatched=drop --out my.yaml
    """
    from lcf3d.run.settings import build_config

    settings = build_config(preset, set_ or [], stereo)
    if out is None:
        typer.echo(settings.to_yaml(), nl=False)
    else:
        settings.dump(out)
        typer.echo(f"wrote {out}")

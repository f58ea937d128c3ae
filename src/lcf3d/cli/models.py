"""``lcf3d models``: the published weights, and downloading them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lcf3d.errors import ConfigError


def models(
    action: Annotated[str, typer.Argument(help="list or get")] = "list",
    name: Annotated[str | None, typer.Argument(help="which model to get")] = None,
    to: Annotated[Path | None, typer.Option(help="folder for the file; ~/.cache/lcf3d/models without it")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the list as JSON")] = False,
) -> None:
    """List the published weights of the paper's LiDAR detectors, or download and verify one.

    lcf3d models                            what there is

    lcf3d models get pointpillars-kitti     download; prints the path of the file
    """
    from lcf3d.detectors.published import PUBLISHED, download, find_model

    if action == "get":
        if name is None:
            raise ConfigError("name the model to get: lcf3d models get NAME (lcf3d models lists them)")
        typer.echo(str(download(find_model(name), to)))
    elif action == "list":
        if as_json:
            entries = [{**asdict(m), "sha256": None, "sha256_begins": m.digest_prefix} for m in PUBLISHED]
            typer.echo(json.dumps(entries, indent=2))
            return
        for model in PUBLISHED:
            typer.echo(f"{model.name}\n    {model.url}")
            typer.echo(f"    sha256 {model.digest_prefix}... (the rest is not published)   {model.scores}")
            typer.echo(f"    paper: {model.row or '-'}")
    else:
        raise ConfigError(f"lcf3d models takes list or get NAME, got {action!r}")

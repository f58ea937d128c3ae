"""``lcf3d models``: the published weights, and downloading them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lcf3d.cli.console import print_json
from lcf3d.detectors.published import PublishedModel
from lcf3d.errors import ConfigError


def models(
    action: Annotated[str, typer.Argument(help="list or get")] = "list",
    name: Annotated[str | None, typer.Argument(help="which model to get")] = None,
    to: Annotated[Path | None, typer.Option(help="folder for the file; ~/.cache/lcf3d/models without it")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the list as JSON")] = False,
) -> None:
    """List the published weights (LiDAR and camera detectors, localizers), or download and verify one.

    A detector takes a name of the list in the place of a file, and downloads it at its first use.

    lcf3d models                            what there is

    lcf3d models get pointpillars-kitti     download; prints the path of the file
    """
    from lcf3d.detectors.downloads import download
    from lcf3d.detectors.published import PUBLISHED, find_model

    if action == "get":
        if name is None:
            raise ConfigError("name the model to get: lcf3d models get NAME (lcf3d models lists them)")
        typer.echo(str(download(find_model(name), to)))
    elif action == "list":
        if as_json:
            entries = [{**asdict(m), "sha256_begins": m.digest_prefix} for m in PUBLISHED]
            print_json(entries)
            return
        for model in PUBLISHED:
            typer.echo("\n    ".join(_lines(model)))
    else:
        raise ConfigError(f"lcf3d models takes list or get NAME, got {action!r}")


def _lines(model: PublishedModel) -> list[str]:
    """What the list says of a model: name first, then only what is known."""
    lines = [f"{model.name}   {model.use}", model.url or model.note]
    if model.url:
        partial = "" if model.sha256 else "... (the rest is not published)"
        size = f"{model.size_bytes:,} bytes, " if model.size_bytes else ""
        known = f"{size}sha256 {model.digest_prefix}{partial}" if model.digest_prefix else model.note
        lines += [f"{known}   {model.scores}", model.licence]
    return [*lines, *([f"paper: {model.row}"] if model.row else [])]

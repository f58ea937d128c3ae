"""``lcf3d merge``: the parts of a run that were made on several machines, put together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def merge(
    shards: Annotated[list[Path], typer.Argument(help="folders of 'lcf3d run --shard i/n', all n of them")],
    out: Annotated[Path, typer.Option(help="folder for the whole run")],
) -> None:
    """Put the shards of a run together.

    Example: lcf3d merge part-1 part-2 part-3 --out fused
    """
    from lcf3d.cli.console import console
    from lcf3d.remote.places import local
    from lcf3d.run.shards import merge_shards

    count = merge_shards([local(shard) for shard in shards], local(out, new=True))
    console().print(f"{count} frames of {len(shards)} shards in {out}", soft_wrap=True)

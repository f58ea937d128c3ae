"""``lcf3d submit``: the file that a test server takes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def submit(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, or nuscenes:ROOT with the tables v1.0-test")],
    results: Annotated[Path, typer.Argument(help="result files of the test set, or a folder of 'lcf3d run'")],
    out: Annotated[Path, typer.Option(help="the zip (KITTI) or JSON file (nuScenes) to write")],
) -> None:
    """Check results of a test set against the server's limits and write the file to upload.

    lcf3d submit kitti:KITTI fused --out kitti.zip

    lcf3d submit "nuscenes:NUSCENES?version=v1.0-test" fused --out nuscenes.json
    """
    from lcf3d.datasets.opening import open_dataset
    from lcf3d.datasets.submission import write_submission_file
    from lcf3d.remote.places import local, local_file

    frames = write_submission_file(dataset, open_dataset(dataset), local(results), local_file(out))
    typer.echo(f"wrote {out}: {frames:,} frames")

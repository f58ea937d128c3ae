"""``lcf3d export``: a run in the forms that other tools load."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from lcf3d.datasets.base import Dataset


def export(
    run: Annotated[Path, typer.Argument(help="folder of 'lcf3d run'")],
    to: Annotated[str, typer.Option(help="folder, parquet, coco, fiftyone, label-studio, nuscenes or argoverse")],
    out: Annotated[Path, typer.Option(help="folder for folder and parquet, else a file")],
    dataset: Annotated[str | None, typer.Option(help="kind:ROOT, where the run's dataset has moved")] = None,
) -> None:
    """Write the results of a run for other tools.

    Example: lcf3d export fused --to label-studio --out tasks.json

    Example: lcf3d export fused --to parquet --out fused-tables
    """
    from lcf3d.cli.console import console
    from lcf3d.remote.places import local, local_file
    from lcf3d.run.export import export_run
    from lcf3d.run.table_folder import FORMS

    folder = local(run)
    data, _ = dataset_of_run(folder, dataset)
    place = local(out, new=True) if to in FORMS else local_file(out)
    count = export_run(folder, data, to, place)
    console().print(f"{count} frames in {out}", soft_wrap=True)


def dataset_of_run(folder: Path, instead: str | None) -> tuple[Dataset, str]:
    """The dataset that a run was made from, and what it is called.

    Args:
        folder: of the run.
        instead: ``kind:ROOT`` of the dataset, where it is not where it was.

    Raises:
        ConfigError: no run folder, or its dataset is not there.
    """
    from lcf3d.datasets.opening import open_dataset
    from lcf3d.run.folder import RunFolder

    if not RunFolder.is_run(folder):
        raise ConfigError(f"{folder} is no folder of 'lcf3d run': it has no run.json and provenance")
    request = RunFolder(folder).request()
    name = instead or str(request.get("dataset"))
    try:
        return open_dataset(name, split=request.get("split"), version=request.get("tables")), name
    except DatasetError as error:
        raise ConfigError(f"the dataset of this run is not there ({error}); name it with --dataset") from None

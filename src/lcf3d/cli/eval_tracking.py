"""``lcf3d eval --tracking``: tracks against KITTI's tracking labels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from lcf3d.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from lcf3d.evaluation.kitti_tracking import TrackingMetrics
    from lcf3d.evaluation.protocol import TableData


def eval_tracking(dataset: str, results: Path, classes: tuple[str, ...], as_json: bool) -> None:
    """Print the measures of a folder of ``SEQUENCE.txt`` tracking results, or of a run folder that holds ``tracks``.

    Raises:
        Lcf3dError: no KITTI layout with ``training/label_02``, no results, or a malformed line.
    """
    import json

    from lcf3d.cli.console import print_table
    from lcf3d.evaluation.kitti_tracking import CLASSES, evaluate_tracks
    from lcf3d.remote.places import local

    kind, _, root = dataset.partition(":")
    labels = local(root) / "training" / "label_02"
    if kind != "kitti" or not labels.is_dir():
        raise DatasetError(
            f"--tracking needs KITTI's tracking labels, ROOT/training/label_02/SEQUENCE.txt; {dataset} has none"
        )
    unknown = [name for name in classes if name not in CLASSES]
    if unknown:
        raise ConfigError(f"--tracking does not know class {unknown[0]!r}; it measures {', '.join(CLASSES)}")
    folder = results / "tracks" if (results / "tracks").is_dir() else results
    metrics = evaluate_tracks(labels, folder, classes=classes or CLASSES)
    if as_json:
        typer.echo(json.dumps({name: one.to_json() for name, one in metrics.items()}, indent=2))
        return
    print_table(tracking_table(metrics))


def tracking_table(metrics: dict[str, TrackingMetrics]) -> TableData:
    """The measures for people."""
    from lcf3d.evaluation.protocol import TableData

    columns = ("class", "objects", "sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "switches", "HOTA", "DetA", "AssA")
    rows: list[tuple[str, ...] | None] = []
    for name, one in metrics.items():
        best, over = one.averaged.best, one.averaged
        values = (over.samota, over.amota, over.amotp, best.mota, best.motp)
        parts = (one.hota.hota, one.hota.deta, one.hota.assa)
        cells = [*(f"{v:.2f}" for v in values), str(best.switches), *(f"{v:.2f}" for v in parts)]
        rows.append((name, str(best.objects), *cells))
    note = "3D IoU 0.25; MOTA, MOTP, switches and HOTA at the threshold of the best MOTA on these very frames"
    return TableData("tracks, percent", columns, rows, (note,))

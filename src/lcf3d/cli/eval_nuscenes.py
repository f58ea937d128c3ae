"""What ``lcf3d eval nuscenes:ROOT RESULTS`` does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from lcf3d.evaluation.nuscenes import NuscenesMetrics

FRONT_CAMERA = "CAM_FRONT"
_ERROR_TITLES = ("ATE", "ASE", "AOE", "AVE", "AAE")


def eval_nuscenes(
    root: Path,
    results: Path,
    *,
    version: str | None = None,
    split: str | None = None,
    front: bool = False,
    nds_hat: bool = False,
    as_json: bool = False,
    out: Path | None = None,
) -> NuscenesMetrics:
    """Evaluate a submission file, print a table or JSON, and return the metrics.

    Args:
        root: folder that holds the folder of tables.
        results: submission file with exactly the split's samples.
        version: name of the folder of tables; None for the only one there.
        split: official split or file of scene names; None for the one usually evaluated with that version.
        front: count only what the front camera sees.
        nds_hat: lead with NDS^ instead of NDS.
        as_json: print the summary as JSON instead of a table.
        out: folder for ``metrics_summary.json`` and ``metrics_details.json``.

    Raises:
        Lcf3dError: tables or results are wrong; one sentence says how.
    """
    from rich.console import Console

    from lcf3d.datasets.nuscenes import find_version
    from lcf3d.datasets.nuscenes_loading import load_tables
    from lcf3d.datasets.nuscenes_splits import default_split, scenes_of_split
    from lcf3d.evaluation.nuscenes import evaluate_nuscenes
    from lcf3d.files import write_json
    from lcf3d.formats.nuscenes import read_submission

    version = version or find_version(root)
    split = split or default_split(version)
    console = Console(stderr=True)
    # the results are read first: they are small, and most mistakes are in them
    with console.status(f"reading {results.name}"):
        boxes, meta = read_submission(results)
    with console.status(f"reading the tables of {version} (trainval: half a minute)"):
        tables = load_tables(root, version)
    rows = tables.rows_of_scenes(tables.scene_names if split is None else scenes_of_split(split))
    if not len(rows):
        raise ConfigError(
            f"{root / version} holds no scene of split {split!r}; name another with --split, or give a file of "
            f"scene names; there are {', '.join(tables.scene_names[:5])} ..."
        )
    metrics = evaluate_nuscenes(tables, rows, boxes, camera=FRONT_CAMERA if front else None, meta=meta)
    if out is not None:
        write_json(out / "metrics_summary.json", metrics.to_json())
        write_json(out / "metrics_details.json", metrics.details_json(), indent=None)
    if as_json:
        print(json.dumps(metrics.to_json(), indent=2))
    else:
        where = "front camera's view" if front else "all around"
        print_metrics(metrics, f"{results.name}, {split or version}, {len(rows)} samples, {where}", nds_hat)
    return metrics


def print_metrics(metrics: NuscenesMetrics, title: str, nds_hat: bool = False) -> None:
    """Print the table of classes and, below, the scores and what was counted."""
    from rich.console import Console

    console = Console()
    console.print(metrics_table(metrics, title, nds_hat))
    console.print("\n".join(_summary(metrics, nds_hat)), highlight=False)


def metrics_table(metrics: NuscenesMetrics, title: str, nds_hat: bool = False) -> Table:
    """AP (percent) and errors by class and their means; a dash where a class has no such error."""
    import numpy as np
    from rich.table import Table

    config = metrics.config
    errors = 3 if nds_hat else len(_ERROR_TITLES)
    # eleven columns have to fit into 80 characters
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("class", no_wrap=True)
    for heading in ("AP", *(f"{th:g}m" for th in config.dist_ths), *_ERROR_TITLES[:errors]):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, aps, row in zip(metrics.class_names, metrics.aps, metrics.class_errors, strict=True):
        cells = [f"{100 * value:.1f}" for value in (aps.mean(), *aps)]
        cells += ["-" if np.isnan(value) else f"{value:.3f}" for value in row[:errors]]
        table.add_row(name, *cells)
    means = [f"{100 * value:.1f}" for value in (metrics.mean_ap, *metrics.aps.mean(axis=0))]
    means += [f"{value:.3f}" for value in list(metrics.errors.values())[:errors]]
    table.add_row("mean", *means, style="bold")
    return table


def _summary(metrics: NuscenesMetrics, nds_hat: bool) -> list[str]:
    score = f"NDS^ {100 * metrics.nds_hat:.2f}" if nds_hat else f"NDS {100 * metrics.nd_score:.2f}"
    lines = [
        f"{score}   mAP {100 * metrics.mean_ap:.2f}",
        "AP in percent by matching distance; errors in m, 1 - IoU, rad, m/s, 1 - accuracy",
        "counted: "
        + ", ".join(f"{c.in_view} of {c.original} {name.replace('_', ' ')}" for name, c in metrics.counts.items()),
    ]
    absent = [name for name, n in zip(metrics.class_names, metrics.ground_truth_counts, strict=True) if not n]
    if absent:
        lines.append(f"no ground truth (counts as AP 0, errors 1): {', '.join(absent)}")
    return lines

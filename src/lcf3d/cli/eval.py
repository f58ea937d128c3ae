"""``lcf3d eval``: results against ground truth by a dataset's official metric, as tables, JSON and an HTML report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.datasets.base import Dataset
    from lcf3d.evaluation.protocol import ComparisonRow, EvaluationOptions, ResultSet, TableData
    from lcf3d.evaluation.study import Study


def eval(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT or another installed kind, with labels")],
    results: Annotated[
        list[Path], typer.Argument(help="results in the dataset's form, or a folder of 'lcf3d run'; two with --compare")
    ],
    split: Annotated[str | None, typer.Option(help="split of the dataset; that of the run or the usual one")] = None,
    class_: Annotated[list[str] | None, typer.Option("--class", help="only this class; repeatable")] = None,
    iou: Annotated[
        list[str] | None, typer.Option(help="IoU threshold, Car=0.5 or Car:3d=0.5 for one measure; repeatable (KITTI)")
    ] = None,
    missing: Annotated[str, typer.Option(help="frames without results: error, or empty")] = "error",
    compare: Annotated[bool, typer.Option("--compare", help="two results side by side, with intervals")] = False,
    samples: Annotated[int, typer.Option(min=1, help="bootstrap resamples of --compare")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="seed of the resampling")] = 0,
    out: Annotated[Path | None, typer.Option(help="folder for metrics.json and report.html")] = None,
    worst: Annotated[int, typer.Option(min=0, help="frames with most errors in the report")] = 8,
    tables: Annotated[str | None, typer.Option(help="nuScenes: folder of tables; the only one if left out")] = None,
    front: Annotated[bool, typer.Option("--front", help="only what the front camera sees (not KITTI)")] = False,
    nds_hat: Annotated[bool, typer.Option("--nds-hat", help="NDS^: no velocity, no attributes")] = False,
    tracking: Annotated[
        bool, typer.Option("--tracking", help="tracks of 'lcf3d run --memory' or of another tracker")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the metrics as JSON")] = False,
) -> None:
    """Measure results against ground truth.

    Example: lcf3d eval kitti:KITTI fused --split val --out report

    Example: lcf3d eval kitti:KITTI --compare results/pointpillars fused

    Example: lcf3d eval nuscenes:NUSCENES results.json

    Example: lcf3d eval kitti:KITTI_TRACKING fused --tracking

    Example: lcf3d eval nuscenes:NUSCENES tracking.json --tracking
    """
    from time import monotonic

    from lcf3d.cli.console import console, print_json, print_table
    from lcf3d.datasets.base import require_missing
    from lcf3d.datasets.opening import open_dataset
    from lcf3d.evaluation.opening import open_evaluation
    from lcf3d.evaluation.protocol import EvaluationOptions
    from lcf3d.remote.places import local
    from lcf3d.run.conversion import as_files

    started = monotonic()
    _check(results, compare, out)
    if tracking and (compare or out is not None):
        raise ConfigError("--tracking measures one result and writes no report; leave out --compare and --out")
    require_missing(missing)
    options = EvaluationOptions(tuple(class_ or ()), tuple(iou or ()), front, nds_hat)
    places = [local(path) for path in results]
    split, frames, whole = _frames_of_run(places[0], split)
    data = open_dataset(dataset, split=split, version=tables)
    if tracking:
        from lcf3d.cli.eval_tracking import eval_tracking

        chosen = frames or (data.ids if whole or split is not None else None)
        eval_tracking(data, chosen, options, as_files(places[0], data), missing, json_)
        return
    evaluation = open_evaluation(data, frames or (data.ids if whole else None), options)
    names = result_names(results)
    sets = [evaluation.read(as_files(path, data), name, missing) for path, name in zip(places, names, strict=True)]
    rows = evaluation.compare(sets[0], sets[1], samples, seed) if compare else []
    studies = [one.study() for one in sets] if json_ or out is not None else []
    content: dict[str, Any] = {"results": [study.to_json() for study in studies]}
    if compare:
        content["comparison"] = {"samples": samples, "seed": seed, "rows": [_row_json(row) for row in rows]}
    if out is not None:
        origin = report_origin(data, dataset, places, options, monotonic() - started)
        _write(data, sets, studies, rows, content, local(out, new=True), worst, origin)
    if json_:
        print_json(content)
        return
    shown = [comparison_table(rows, names, samples)] if compare else [t for one in sets for t in one.tables()]
    for table in shown:
        print_table(table)
    if out is not None:
        console().print(f"wrote {out}/report.html and {out}/metrics.json", soft_wrap=True)


def _check(results: Sequence[Path], compare: bool, out: Path | None) -> None:
    if compare and len(results) != 2:
        raise ConfigError(f"--compare needs two results, got {len(results)}")
    if not compare and len(results) > 1:
        raise ConfigError(f"got {len(results)} results; give one, or two with --compare")
    if out is not None and out.exists() and not out.is_dir():
        raise ConfigError(f"--out needs a folder, {out} is a file")


def _frames_of_run(results: Path, split: str | None) -> tuple[str | None, tuple[str, ...] | None, bool]:
    """Split and frames that ``lcf3d run`` noted beside its results, and whether it ran on the whole dataset."""
    from lcf3d.run.folder import RunFolder

    folder = run_folder(results)
    if split is not None or not (folder / "run.json").is_file():
        return split, None, False
    request = RunFolder(folder).request()
    frames = tuple(str(frame_id) for frame_id in request.get("frames") or ())
    noted = request.get("split")
    noted = noted if isinstance(noted, str) else None
    return noted, frames or None, noted is None and not frames


def run_folder(results: Path) -> Path:
    """The folder above ``data``, where provenance and settings of a run lie."""
    return results.parent if results.name in ("data", "results.json", "results.feather") else results


def result_names(results: Sequence[Path]) -> list[str]:
    """Short, different names: the folder, without a trailing ``data``, or the whole path where those are equal."""
    names = [(run_folder(path) if path.name == "data" else path).resolve().name for path in results]
    return names if len(set(names)) == len(names) else [str(path) for path in results]


def _row_json(row: ComparisonRow) -> dict[str, Any]:
    """Plain JSON values of a row of a comparison."""
    from dataclasses import asdict

    intervals = {name: asdict(getattr(row, name)) for name in ("first", "second", "difference")}
    return {"class_name": row.class_name, "measure": row.measure, "difficulty": row.level, **intervals}


def comparison_table(rows: Sequence[ComparisonRow], names: Sequence[str], samples: int) -> TableData:
    """Two result sets side by side for people; sure differences carry a star."""
    from lcf3d.evaluation.protocol import TableData

    cells: list[tuple[str, ...] | None] = []
    for row in rows:
        sure = row.difference.low > 0 or row.difference.high < 0
        cells.append(
            (
                row.class_name,
                " ".join(filter(None, (row.measure, row.level))),
                f"{row.first.value:.2f}",
                f"{row.second.value:.2f}",
                f"{row.difference.value:+.2f}{'*' if sure else ' '}",
                f"{row.difference.low:+.2f} to {row.difference.high:+.2f}",
            )
        )
    note = f"intervals: {samples} resamples of the frames, the same for both; * where they leave out zero"
    columns = ("class", "", names[0], names[1], "difference", "95 % interval")
    return TableData("AP in percent", columns, cells, (note,))


def _write(
    data: Dataset,
    sets: Sequence[ResultSet],
    studies: Sequence[Study],
    rows: Sequence[ComparisonRow],
    content: dict[str, Any],
    out: Path,
    worst: int,
    origin: dict[str, str],
) -> None:
    """The report and its numbers."""
    from lcf3d.cli.console import strict
    from lcf3d.evaluation.report import html_report
    from lcf3d.files import write_json, write_text

    write_json(out / "metrics.json", strict(content))
    title = f"{studies[0].heading}: {' and '.join(study.name for study in studies)}"
    tables = [one.tables() for one in sets]
    write_text(out / "report.html", html_report(title, studies, tables, rows, data, worst, origin))
    details = getattr(sets[-1], "details_json", None)
    if details is not None:
        write_json(out / "metrics_summary.json", sets[-1].to_json())
        write_json(out / "metrics_details.json", details(), indent=None)


def report_origin(
    data: Dataset, dataset: str, results: Sequence[Path], options: EvaluationOptions, seconds: float | None = None
) -> dict[str, str]:
    """What made the report, for its foot."""
    import os
    import platform
    import shlex
    import sys
    from dataclasses import asdict
    from datetime import datetime, timezone

    from lcf3d import __version__

    asked = ", ".join(f"{name} {value}" for name, value in asdict(options).items() if value)
    rows = {
        "Version": f"lcf3d {__version__}, Python {platform.python_version()}",
        "Command": shlex.join(["lcf3d", *sys.argv[1:]]),
        "Dataset": dataset,
        "Protocol": data.evaluation.partition(":")[2] + (f", {asked}" if asked else ""),
        "Machine": f"{platform.system()} {platform.release()}, {platform.machine()}, {os.cpu_count()} processors",
        "Made": f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC"
        + ("" if seconds is None else f", measured in {seconds:.1f} s"),
    }
    for path in results:
        for name, title in (("run.json", "Run"), ("config.yaml", "Settings")):
            file = run_folder(path) / name
            if file.is_file():
                rows[f"{title} of {run_folder(path).name}"] = file.read_text(encoding="utf-8")
    return rows

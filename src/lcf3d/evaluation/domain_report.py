"""Tables and charts of a domain-shift experiment, as text, JSON and one HTML file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.evaluation.domain_shift import IOU_THRESHOLDS, ShiftMetrics
from lcf3d.evaluation.domain_tasks import LIDAR_ALONE, DomainTask, DomainTaskRunner, parse_task
from lcf3d.evaluation.svg import PALETTE, Line, line_chart
from lcf3d.files import write_json, write_text
from lcf3d.fusion.config import FusionConfig
from lcf3d.structures import KITTI_CLASSES

COLUMNS = ("NDS^", "mAP", "mATE", "mASE", "mAOE")
"""Columns of the paper's table; the first two are better when higher, the others when lower."""

Results = Sequence[tuple[DomainTask, Mapping[str, ShiftMetrics]]]
"""Tasks with the metrics of each method."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #0f172a; max-width: 1080px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #e2e8f0; }
table { border-collapse: collapse; margin: .8em 0; font-variant-numeric: tabular-nums; }
th, td { padding: .2em .8em; border-bottom: 1px solid #e2e8f0; text-align: right; } th { color: #475569; }
th:first-child, td:first-child, td.text { text-align: left; } tr.first td { border-top: 2px solid #94a3b8; }
.best { font-weight: 700; } .plots { display: flex; flex-wrap: wrap; gap: 1.5em; } figure { margin: 0; }
figcaption { font-weight: 600; } .note { color: #475569; max-width: 52em; }
"""
_NOTE = (
    "Front camera's view, in KITTI's classes; NDS^ = (3 mAP + the sum of 1 - min(1, error)) / 6 over mATE, mASE and "
    "mAOE, matching by centre distance as in nuScenes. Vans, people sitting and cycles without a rider count neither "
    "for nor against. The better of the methods of a task is bold."
)


def table_values(metrics: ShiftMetrics) -> tuple[float, ...]:
    """The numbers of `COLUMNS`."""
    errors = metrics.metrics.errors
    return (metrics.metrics.nds_hat, metrics.metrics.mean_ap, *(errors[k] for k in errors))


def best_cells(methods: Mapping[str, ShiftMetrics]) -> dict[str, list[bool]]:
    """By method, which of the `COLUMNS` are the best of their task (none where all are equal)."""
    values = np.array([table_values(metrics) for metrics in methods.values()]) * [1, 1, -1, -1, -1]
    best = (values == values.max(axis=0)) & (values != values.min(axis=0))
    return {method: row.tolist() for method, row in zip(methods, best, strict=True)}


def to_json(results: Results) -> list[dict[str, Any]]:
    """Everything measured, task by task, as plain JSON values."""
    return [
        {
            "trained": task.trained,
            "tested": task.tested,
            "dataset": task.dataset,
            "methods": {
                method: {**m.metrics.to_json(), "ap_over_iou": _curves_json(m)} for method, m in methods.items()
            },
        }
        for task, methods in results
    ]


def _curves_json(metrics: ShiftMetrics) -> dict[str, dict[str, float]]:
    return {
        name: {f"{t:.2f}": round(float(ap), 4) for t, ap in zip(IOU_THRESHOLDS, row, strict=True)}
        for name, row in zip(metrics.metrics.class_names, metrics.ap_over_iou, strict=True)
    }


def charts(results: Results) -> dict[tuple[str, str], str]:
    """AP over the IoU threshold, one ``<svg>`` by test data and class; LiDAR alone is dashed (paper, same figure)."""
    lines: dict[tuple[str, str], list[Line]] = {}
    # one colour a training set, in all charts
    trained = list(dict.fromkeys(task.trained for task, _ in results))
    for task, methods in results:
        color = PALETTE[trained.index(task.trained) % len(PALETTE)]
        for method, metrics in methods.items():
            for name, row in zip(metrics.metrics.class_names, metrics.ap_over_iou, strict=True):
                line = Line(f"{task.trained}, {method}", IOU_THRESHOLDS, row, color, dashed=method == LIDAR_ALONE)
                lines.setdefault((task.tested, name), []).append(line)
    span = (float(IOU_THRESHOLDS[0]), float(IOU_THRESHOLDS[-1]))
    return {
        place: line_chart(drawn, "3D IoU threshold", "AP in percent", span, (0.0, 100.0))
        for place, drawn in lines.items()
    }


def html_report(results: Results) -> str:
    """The table and the charts as the text of one HTML file that needs nothing else."""
    parts = ["<h1>Domain shift</h1>", f"<p class='note'>{escape(_NOTE)}</p>", _table(results)]
    drawn = charts(results)
    for tested in dict.fromkeys(task.tested for task, _ in results):
        figures = [
            f"<figure><figcaption>{escape(name)}</figcaption>{svg}</figure>"
            for (place, name), svg in drawn.items()
            if place == tested
        ]
        parts.append(f"<h2>Tested on {escape(tested)}</h2><div class='plots'>{''.join(figures)}</div>")
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Domain shift</title>"
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def standalone_svg(svg: str) -> str:
    """A chart as the text of a file of its own."""
    return svg.replace("<svg ", "<svg xmlns='http://www.w3.org/2000/svg' ", 1) + "\n"


def _table(results: Results) -> str:
    rows = []
    for task, methods in results:
        best = best_cells(methods)
        for i, (method, metrics) in enumerate(methods.items()):
            cells = [
                f"<td{' class=best' if is_best else ''}>{value:.3f}</td>"
                for value, is_best in zip(table_values(metrics), best[method], strict=True)
            ]
            head = f"<td>{escape(task.name) if i == 0 else ''}</td><td class='text'>{escape(method)}</td>"
            rows.append(f"<tr{' class=first' if i == 0 else ''}>{head}{''.join(cells)}</tr>")
    heading = "".join(f"<th>{name}</th>" for name in ("task", "method", *COLUMNS))
    return f"<table><tr>{heading}</tr>{''.join(rows)}</table>"


def run_tasks(
    texts: Sequence[str],
    settings: FusionConfig,
    out: Path,
    class_names: Sequence[str] = (),
    begin: Callable[[str, int], Callable[[], None]] = lambda name, frames: lambda: None,
) -> Results:
    """Run tasks and write settings, numbers, report and charts into a folder.

    Args:
        texts: tasks, see `lcf3d.evaluation.domain_tasks.parse_task`.
        settings: of the fusion, in KITTI's classes.
        out: the folder.
        class_names: classes to evaluate, KITTI's without them.
        begin: is told name and number of frames of each task and gives what to call after each frame.

    Raises:
        Lcf3dError: a task, its dataset or its detectors are wrong; everything is opened before anything is run.
    """
    names = tuple(class_names or KITTI_CLASSES)
    if unknown := [name for name in names if name not in KITTI_CLASSES]:
        raise ConfigError(f"--class takes {', '.join(KITTI_CLASSES)}, got {unknown[0]!r}")
    if out.is_file():
        raise ConfigError(f"{out} is a file; choose a folder for --out")
    tasks = [parse_task(text) for text in texts]
    if doubles := [t.name for i, t in enumerate(tasks) if t.name in {other.name for other in tasks[:i]}]:
        raise ConfigError(f"two tasks are named {doubles[0]!r}; tell them apart, for example as kitti-b->kitti")
    runners = [DomainTaskRunner(task, settings) for task in tasks]
    results = [(runner.task, runner(names, begin(runner.task.name, len(runner)))) for runner in runners]
    settings.dump(out / "config.yaml")
    write_json(out / "domain_shift.json", to_json(results))
    write_text(out / "report.html", html_report(results))
    for (tested, name), svg in charts(results).items():
        write_text(out / "charts" / f"{tested}_{name}.svg".replace("/", "_"), standalone_svg(svg))
    return results

"""What ``lcf3d eval kitti:ROOT RESULTS`` does."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from lcf3d.evaluation.kitti import KittiEvaluationConfig, KittiEvaluator, KittiMetrics
    from lcf3d.evaluation.kitti_breakdown import ComparisonRow


@dataclass(frozen=True)
class KittiQuestion:
    """What to evaluate.

    Attributes:
        root: KITTI tree.
        results: one folder of results, or two to compare.
        split: name of the list of frames, or None for the usual one.
        classes: classes to evaluate; empty for all.
        iou: ``CLASS=VALUE`` or ``CLASS:MEASURE=VALUE`` items.
        missing: ``error`` or ``empty``.
    """

    root: Path
    results: tuple[Path, ...]
    split: str | None = None
    classes: tuple[str, ...] = ()
    iou: tuple[str, ...] = ()
    missing: str = "error"


def eval_kitti(
    question: KittiQuestion,
    compare: bool = False,
    samples: int = 1000,
    seed: int = 0,
    out: Path | None = None,
    worst: int = 8,
    nds_hat: bool = False,
    json_: bool = False,
) -> None:
    """Evaluate one or two result sets, print tables or JSON, write the report.

    Raises:
        Lcf3dError: ground truth, results or options are wrong; one sentence says how.
    """
    from rich.console import Console

    if question.missing not in ("error", "empty"):
        raise ConfigError(f"--missing takes error or empty, got {question.missing!r}")
    if out is not None and out.exists() and not out.is_dir():
        raise ConfigError(f"--out needs a folder, {out} is a file")
    config = kitti_config(question.classes, question.iou)
    evaluators = [_open(question, path, config, quiet=json_) for path in question.results]
    console = Console()
    if nds_hat:
        _nds_hat(console, question, evaluators[0], out, json_)
        return
    rows: Sequence[ComparisonRow] = ()
    if compare:
        from lcf3d.evaluation.kitti_breakdown import compare as compare_results

        rows = compare_results(evaluators[0], evaluators[1], samples, seed)
    names = result_names(question.results)
    if out is not None or json_:
        resampling = {"samples": samples, "seed": seed} if compare else None
        _closer_look(question, names, evaluators, rows, resampling, out, worst, json_)
    if json_:
        return
    if compare:
        _print_comparison(console, rows, names, samples)
        for sentence in _covered_by_one(evaluators, names):
            console.print(sentence, soft_wrap=True)
    else:
        _print_metrics(console, evaluators[0].metrics())
    if out is not None:
        console.print(f"wrote {out}/report.html and {out}/metrics.json", soft_wrap=True)


def kitti_config(classes: Sequence[str], iou: Sequence[str]) -> KittiEvaluationConfig:
    """The benchmark's numbers, changed by ``--class`` and ``--iou`` values.

    Raises:
        ConfigError: an unknown class or measure, or a threshold that is no number in [0, 1).
    """
    from lcf3d.evaluation.kitti import KittiEvaluationConfig

    config = KittiEvaluationConfig()
    if classes:
        config = replace(config, classes=tuple(dict.fromkeys(classes)))
    for item in iou:
        target, equals, text = item.partition("=")
        class_name, _, measure = target.partition(":")
        try:
            value = float(text)
        except ValueError:
            equals = ""
        if not equals:
            raise ConfigError(f"--iou takes CLASS=VALUE or CLASS:MEASURE=VALUE, for example Car=0.5, got {item!r}")
        config = config.with_min_overlap(class_name, value, measure or None)
    return config


def _open(question: KittiQuestion, results: Path, config: KittiEvaluationConfig, quiet: bool) -> KittiEvaluator:
    """Ground truth and results, with a note about result files that are not of the split."""
    from lcf3d.evaluation.kitti import read_evaluator, result_folder

    split = question.split or _split_of_run(results)
    missing: Literal["error", "empty"] = "empty" if question.missing == "empty" else "error"
    evaluator = read_evaluator(question.root, results, split, config, missing)
    folder = result_folder(results)
    known = set(evaluator.truth.frame_ids)
    others = sorted(path.stem for path in folder.glob("*.txt") if path.stem not in known)
    if others and not quiet:
        typer.echo(
            f"note: {len(others)} result files in {folder} are of frames outside the split, first {others[0]}.txt; "
            "they are left out",
            err=True,
        )
    return evaluator


def _split_of_run(results: Path) -> str | None:
    """The split that ``lcf3d run`` noted beside its results, if it did."""
    from lcf3d.files import read_json

    note = _run_folder(results) / "run.json"
    if not note.is_file():
        return None
    content = read_json(note)
    split = content.get("split") if isinstance(content, dict) else None
    return split if isinstance(split, str) else None


def _run_folder(results: Path) -> Path:
    """The folder above ``data``, where provenance and settings of a run lie."""
    return results.parent if results.name == "data" else results


def result_names(results: Sequence[Path]) -> list[str]:
    """Short, different names: the folder, without a trailing ``data``, or the whole path where those are equal."""
    names = [_run_folder(path).resolve().name for path in results]
    return names if len(set(names)) == len(names) else [str(path) for path in results]


def _closer_look(
    question: KittiQuestion,
    names: Sequence[str],
    evaluators: Sequence[KittiEvaluator],
    rows: Sequence[ComparisonRow],
    resampling: dict[str, int] | None,
    out: Path | None,
    worst: int,
    json_: bool,
) -> None:
    """Write the report and its numbers to ``out``, and print the numbers as JSON if asked."""
    from lcf3d.evaluation.kitti_study import comparison_json, study

    folders = [_run_folder(path) for path in question.results]
    studies = [
        study(evaluator, name, folder, question.root)
        for evaluator, name, folder in zip(evaluators, names, folders, strict=True)
    ]
    content: dict[str, Any] = {"results": [one.to_json() for one in studies]}
    if resampling is not None:
        content["comparison"] = {**resampling, "rows": comparison_json(rows)}
    if json_:
        typer.echo(json.dumps(content, indent=2))
    if out is None:
        return
    from lcf3d.evaluation.kitti_pictures import worst_frame_pictures
    from lcf3d.evaluation.report import html_report
    from lcf3d.files import write_json, write_text

    pictures = worst_frame_pictures(studies[-1], question.root, worst)
    write_json(out / "metrics.json", content)
    write_text(out / "report.html", html_report(f"KITTI: {' and '.join(names)}", studies, rows, pictures))


def _nds_hat(
    console: Console, question: KittiQuestion, evaluator: KittiEvaluator, out: Path | None, json_: bool
) -> None:
    """NDS^ of the results in the left camera's view, which is all that KITTI annotates."""
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.evaluation.generalization import evaluate_generalization
    from lcf3d.files import write_json
    from lcf3d.formats.kitti import detections_3d

    data = KittiDataset(question.root)
    names = evaluator.config.classes
    cameras = [data.frame(frame_id).cameras[0] for frame_id in evaluator.truth.frame_ids]
    truth, found = (
        [detections_3d(o, c.camera_from_lidar, names) for o, c in zip(frames, cameras, strict=True)]
        for frames in (evaluator.truth, evaluator.results)
    )
    content = evaluate_generalization(truth, found, class_names=names, cameras=cameras).to_json()
    if out is not None:
        write_json(out / "nds_hat.json", content)
    if json_:
        typer.echo(json.dumps(content, indent=2))
        return
    console.print(_nds_hat_table(content, len(cameras)))


def _nds_hat_table(content: dict[str, Any], n_frames: int) -> Table:
    from rich.table import Table

    caption = f"NDS^ {100 * content['nds_hat']:.2f}, {n_frames} frames\nAP in percent; errors in m, 1 - IoU, rad"
    table = Table(title="NDS^ on KITTI", box=None, padding=(0, 2, 0, 0), caption=caption, caption_justify="left")
    table.add_column("class", no_wrap=True)
    for name in ("AP", "ATE", "ASE", "AOE"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, ap in content["mean_dist_aps"].items():
        errors = content["label_tp_errors"][name].values()
        table.add_row(name, f"{100 * ap:.2f}", *(f"{error:.3f}" for error in errors))
    means = content["tp_errors"].values()
    table.add_row("mean", f"{100 * content['mean_ap']:.2f}", *(f"{error:.3f}" for error in means), style="bold")
    return table


def _print_metrics(console: Console, metrics: KittiMetrics) -> None:
    """The table of all measures for people."""
    from rich.table import Table

    from lcf3d.evaluation.kitti import DIFFICULTIES, MEASURE_NAMES

    table = Table(title=f"KITTI, {metrics.frame_count} frames, AP in percent", box=None, padding=(0, 2, 0, 0))
    for name in ("class", "", "IoU"):
        table.add_column(name, no_wrap=True)
    for sampling in ("R40", "R11"):
        for difficulty in DIFFICULTIES:
            table.add_column(f"{difficulty}\n{sampling}", justify="right", no_wrap=True)
    for class_name in metrics.class_names:
        for measure in metrics.measures(class_name):
            threshold = metrics.config.min_overlap[class_name]["bbox" if measure == "aos" else measure]
            values = [
                f"{metrics.ap(class_name, measure, difficulty, sampling):.2f}"
                for sampling in ("R40", "R11")
                for difficulty in DIFFICULTIES
            ]
            first = measure == metrics.measures(class_name)[0]
            table.add_row(class_name if first else "", MEASURE_NAMES[measure], f"{threshold:g}", *values)
    console.print(table)
    for sentence in _remarks(metrics):
        console.print(sentence, soft_wrap=True)


def _remarks(metrics: KittiMetrics) -> list[str]:
    """What a reader of the table should know."""
    from lcf3d.evaluation.curves import SAMPLES
    from lcf3d.evaluation.kitti import DIFFICULTIES

    remarks = []
    absent = [name for name in metrics.config.classes if name not in metrics.class_names]
    if absent:
        remarks.append(f"no detections of {', '.join(absent)}: not evaluated, as in the official program")
    few = []
    for name in metrics.class_names:
        measure = metrics.measures(name)[0]
        counts = [metrics.curves[name, measure, difficulty].object_count for difficulty in DIFFICULTIES]
        if min(counts) < SAMPLES:
            few.append(f"{name} {' / '.join(map(str, counts))}")
    if few:
        listed = ", ".join(few)
        remarks.append(
            f"objects, {' / '.join(DIFFICULTIES)}: {listed}; with fewer than {SAMPLES} the official sampling cannot "
            "reach 100"
        )
    return remarks


def _print_comparison(console: Console, rows: Sequence[ComparisonRow], names: Sequence[str], samples: int) -> None:
    """Two result sets side by side for people."""
    from rich.table import Table

    from lcf3d.evaluation.kitti import MEASURE_NAMES

    table = Table(title="AP (R40) in percent", box=None, padding=(0, 2, 0, 0))
    for name in ("class", "", ""):
        table.add_column(name, no_wrap=True)
    for name in (*names, "difference"):
        table.add_column(name, justify="right", overflow="fold")
    table.add_column("95 % interval", justify="right", no_wrap=True)
    for row in rows:
        sure = row.difference.low > 0 or row.difference.high < 0
        color = ("green" if row.difference.value > 0 else "red") if sure else "default"
        table.add_row(
            row.class_name,
            MEASURE_NAMES[row.measure],
            row.difficulty,
            f"{row.first.value:.2f}",
            f"{row.second.value:.2f}",
            f"[{color}]{row.difference.value:+.2f}[/]",
            f"{row.difference.low:+.2f} to {row.difference.high:+.2f}",
        )
    console.print(table)
    console.print(
        f"intervals: {samples} resamples of the frames, the same for both; coloured where they leave out zero",
        soft_wrap=True,
    )


def _covered_by_one(evaluators: Sequence[KittiEvaluator], names: Sequence[str]) -> list[str]:
    """What cannot be compared, one sentence for each of the two result sets."""
    from lcf3d.evaluation.kitti import MEASURE_NAMES

    sentences = []
    for own, other, name in zip(evaluators, reversed(evaluators), names, strict=True):
        alone = [
            f"{class_name} {MEASURE_NAMES[measure]}"
            for class_name, measures in own.covered.items()
            for measure in measures
            if measure not in other.covered[class_name]
        ]
        if alone:
            sentences.append(f"only in {name}: {', '.join(alone)}")
    return sentences

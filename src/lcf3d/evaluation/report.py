"""One HTML file that shows an evaluation: tables, charts, every frame, with nothing loaded from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from lcf3d.datasets.base import Dataset
from lcf3d.evaluation.protocol import ComparisonRow, TableData
from lcf3d.evaluation.report_data import LIMIT_BYTES, report_data
from lcf3d.evaluation.study import Study

_OUTCOME_COLUMNS = ("matched", "recovered", "downweighted", "kept", "predicted", "unknown")


@dataclass(frozen=True)
class Section:
    """Tables under a heading.

    Attributes:
        heading: of the section.
        tables: below it.
        note: a sentence on all of them.
    """

    heading: str
    tables: list[TableData] = field(default_factory=list)
    note: str = ""


def html_report(
    title: str,
    studies: Sequence[Study],
    tables: Sequence[Sequence[TableData]],
    comparison: Sequence[ComparisonRow] = (),
    dataset: Dataset | None = None,
    worst: int = 8,
    origin: Mapping[str, str] | None = None,
    limit_bytes: int = LIMIT_BYTES,
) -> str:
    """The report as the text of an HTML file.

    Args:
        title: heading.
        studies: one result set, or two to be shown side by side.
        tables: the official numbers of each.
        comparison: rows of `lcf3d.evaluation.protocol.Evaluation.compare`, for two.
        dataset: where images and scans of the worst frames come from; none are shown without it.
        worst: frames of the last result set with pictures.
        origin: what made the report, for its foot: version, command and so on, by name.
        limit_bytes: the largest size; pictures are left out first.
    """
    data = report_data(studies, dataset, worst, limit_bytes)
    return render(title, studies, tables, comparison, data, origin or {}, limit_bytes)


def render(
    title: str,
    studies: Sequence[Study],
    tables: Sequence[Sequence[TableData]],
    comparison: Sequence[ComparisonRow],
    data: Mapping[str, Any],
    origin: Mapping[str, str],
    limit_bytes: int | None = None,
) -> str:
    """The page around what `report_data` gives; for the others see `html_report`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("lcf3d.evaluation", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    sections = [
        *(Section(f"Average precision{_of(s, studies)}", list(own)) for s, own in zip(studies, tables, strict=True)),
        *_distance_section(studies),
        Section("At the best F1", [_outcome_table(study, studies) for study in studies]),
        *_fusion_section(studies),
    ]
    return environment.get_template("report.html").render(
        title=title,
        introduction=_introduction(studies),
        sections=sections,
        body_of=_body,
        foot_of=_foot,
        names=[study.name for study in studies],
        comparison=comparison,
        reach=_reach(comparison),
        data=_script_json(data),
        left_out=data["left_out"],
        shown=len(data["frames"]),
        pictured=len(data["pictures"]),
        limit="" if limit_bytes is None else f"{limit_bytes / 1e6:g} MB",
        origin=origin,
        assets={name: asset(name) for name in ("report.css", "report.js", "scene.js", "uplot.css", "uplot.js")},
    )


def asset(name: str) -> str:
    """The text of a file that the page is made of."""
    return files("lcf3d.evaluation").joinpath("assets", name).read_text(encoding="utf-8")


def _script_json(value: Any) -> str:
    """JSON that no text in it can end the element of, wherever it comes from."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _introduction(studies: Sequence[Study]) -> str:
    measures = dict.fromkeys(part.measure for study in studies for part in study.classes)
    return (
        f"{studies[0].heading} over {len(studies[0].frame_ids)} frames, average precision in percent. The closer "
        f"looks below are measured as: {'; '.join(measures) or 'nothing'}."
    )


def _of(study: Study, studies: Sequence[Study]) -> str:
    return f" of {study.name}" if len(studies) > 1 else ""


def _reach(rows: Sequence[ComparisonRow]) -> float:
    """The largest difference that any interval reaches, for the bars that show them."""
    ends = [abs(value) for row in rows for value in (row.difference.low, row.difference.high) if np.isfinite(value)]
    return max([*ends, 1e-9])


def _distance_section(studies: Sequence[Study]) -> list[Section]:
    tables = []
    for study in studies:
        parts = [part for part in study.classes if part.distance]
        if not parts:
            continue
        ranges = [(row.near, row.far) for row in parts[0].distance]
        columns = ["class" + _of(study, studies)]
        columns += [f"{near:g} m and more" if far == float("inf") else f"{near:g} to {far:g} m" for near, far in ranges]
        rows: list[tuple[str, ...] | None] = [
            (part.class_name, *(f"{row.ap:.2f} ({row.objects})" if row.objects else "- (0)" for row in part.distance))
            for part in parts
        ]
        tables.append(TableData("", tuple(columns), rows))
    return [Section("By distance", tables, "In brackets the number of objects.")] if tables else []


def _outcome_table(study: Study, studies: Sequence[Study]) -> TableData:
    rows: list[tuple[str, ...] | None] = []
    for part in study.classes:
        hits, wrong, missed = part.counts.values()
        shares = _ratio(hits, hits + wrong), _ratio(hits, hits + missed)
        rows.append((part.class_name, f"{part.score_threshold:.3g}", *map(str, (hits, wrong, missed)), *shares))
    columns = ("class" + _of(study, studies), "score from", "right", "wrong", "missed", "precision", "recall")
    return TableData("", columns, rows)


def _fusion_section(studies: Sequence[Study]) -> list[Section]:
    tables = [t for study in studies for t in _fusion_tables(study, studies)]
    return [Section("What the fusion did", tables, _FUSION_NOTE)] if tables else []


_FUSION_NOTE = (
    "At the scores of the table above. Dropped rightly: the dropped LiDAR detection fits no object, or one that is "
    "reported anyway. Dropped wrongly: it fits an object that is now missed."
)


def _fusion_tables(study: Study, studies: Sequence[Study]) -> list[TableData]:
    """Reported detections, dropped ones and missed objects by what the fusion did; nothing without provenance."""
    parts = [(part.class_name, part.fusion) for part in study.classes if part.fusion is not None]
    if not parts:
        return []
    used = [c for c in _OUTCOME_COLUMNS if any(c in f.true_positives or c in f.false_positives for _, f in parts)]
    outputs = [
        (name, label, *(str(counts.get(column, 0)) for column in used))
        for name, fusion in parts
        for label, counts in (("right", fusion.true_positives), ("wrong", fusion.false_positives))
    ]
    dropped = [
        (
            name,
            reason.replace("_", " "),
            str(fusion.dropped_rightly.get(reason, 0)),
            str(fusion.dropped_wrongly.get(reason, 0)),
        )
        for name, fusion in parts
        for reason in sorted({*fusion.dropped_rightly, *fusion.dropped_wrongly})
    ]
    kinds = ("dropped", "below_threshold", "not_proposed")
    misses = [(name, *(str(fusion.misses.get(kind, 0)) for kind in kinds)) for name, fusion in parts]
    of = _of(study, studies)
    return [
        TableData(f"Reported detections{of}", ("class", "", *used), list(outputs)),
        TableData(f"Dropped LiDAR detections{of}", ("class", "reason", "rightly", "wrongly"), list(dropped)),
        TableData(
            f"Missed objects{of}",
            ("class", "dropped by the fusion", "reported with a lower score", "no detection fits"),
            list(misses),
        ),
    ]


def _body(table: TableData) -> list[tuple[str, ...]]:
    """Rows up to the one that sums up; a first cell left empty says what the row above says, so that rows can move."""
    rows: list[tuple[str, ...]] = []
    for row in table.rows:
        if row is None:
            break
        rows.append((rows[-1][0], *row[1:]) if rows and not row[0] else row)
    return rows


def _foot(table: TableData) -> list[tuple[str, ...]]:
    """The rows that sum up."""
    place = table.rows.index(None) if None in table.rows else len(table.rows)
    return [row for row in table.rows[place:] if row is not None]


def _ratio(count: int, total: int) -> str:
    return f"{count / total:.3f}" if total else "-"

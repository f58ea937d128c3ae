"""One HTML file that shows an evaluation: tables, plots, and the worst frames, with nothing loaded from elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from lcf3d.evaluation.protocol import ComparisonRow, TableData
from lcf3d.evaluation.study import ClassStudy, Study
from lcf3d.evaluation.svg import PALETTE, Line, line_chart

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #0f172a; max-width: 1080px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #e2e8f0; }
h3 { font-size: 1em; margin: 1.2em 0 .3em; }
table { border-collapse: collapse; margin: .8em 0; font-variant-numeric: tabular-nums; }
th, td { padding: .2em .8em; border-bottom: 1px solid #e2e8f0; text-align: right; } th { color: #475569; }
th:first-child, td:first-child, td.text { text-align: left; }
.plots { display: flex; flex-wrap: wrap; gap: 1.5em; } figure { margin: 0; } figcaption { font-weight: 600; }
.note { color: #475569; max-width: 46em; } .good { color: #047857; } .bad { color: #b91c1c; }
.picture { display: block; width: 1040px; max-width: 100%; margin-bottom: .5em; }
.key span { display: inline-block; margin-right: 1.2em; } .key i { display: inline-block; width: 1em; height: .7em;
  border: 2px solid; margin-right: .4em; }
"""

_OUTCOME_COLUMNS = ("matched", "recovered", "downweighted", "kept", "unknown")


def html_report(
    title: str,
    studies: Sequence[Study],
    tables: Sequence[Sequence[TableData]],
    comparison: Sequence[ComparisonRow] = (),
    pictures: Mapping[str, str] | None = None,
) -> str:
    """The report as the text of an HTML file.

    Args:
        title: heading.
        studies: one result set, or two to be shown side by side.
        tables: the official numbers of each.
        comparison: rows of `lcf3d.evaluation.protocol.Evaluation.compare`, for two.
        pictures: HTML of each of the worst frames, by heading, of the last result set.
    """
    main = studies[-1]
    parts = [f"<h1>{escape(title)}</h1>", f"<p class='note'>{_introduction(studies)}</p>"]
    for study, own in zip(studies, tables, strict=True):
        parts += [f"<h2>Average precision{_of(study, studies)}</h2>", *map(_official_table, own)]
    if comparison:
        parts += ["<h2>Side by side</h2>", _comparison_table(comparison, [study.name for study in studies])]
    parts += ["<h2>AP over the matching threshold, and precision over recall</h2>", _plots(studies)]
    if any(part.distance for part in main.classes):
        parts += ["<h2>By distance</h2>", *(_distance_table(study, studies) for study in studies), _DISTANCE_NOTE]
    parts += ["<h2>At the best F1</h2>", *(_outcome_table(study, studies) for study in studies)]
    fused = [study for study in studies if any(part.fusion for part in study.classes)]
    if fused:
        parts += ["<h2>What the fusion did</h2>", *(_fusion_tables(study, studies) for study in fused)]
    if pictures:
        parts += [f"<h2>Worst frames{_of(main, studies)}</h2>", _KEY]
        frames = (f"<div><h3>{escape(heading)}</h3>{body}</div>" for heading, body in pictures.items())
        parts += [f"<div class='plots'>{''.join(frames)}</div>"]
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>"
        f"<meta name='viewport' content='width=device-width'><style>{_STYLE}</style></head><body>"
        + "\n".join(parts)
        + "</body></html>\n"
    )


_DISTANCE_NOTE = "<p class='note'>In brackets the number of objects.</p>"
OUTCOME_COLORS = {"right": "#2563eb", "wrong": "#dc2626", "missed": "#d97706", "found": "#16a34a", "ignored": "#94a3b8"}
_KEY = (
    "<p class='key'>"
    + "".join(
        f"<span><i style='border-color:{OUTCOME_COLORS[name]};border-style:{style}'></i>{text}</span>"
        for name, style, text in (
            ("found", "dashed", "object, found"),
            ("missed", "dashed", "object, missed"),
            ("right", "solid", "detection, right"),
            ("wrong", "solid", "detection, wrong"),
            ("ignored", "solid", "does not count"),
        )
    )
    + "</p>"
)


def _introduction(studies: Sequence[Study]) -> str:
    measures = dict.fromkeys(part.measure for study in studies for part in study.classes)
    return (
        f"{escape(studies[0].heading)} over {len(studies[0].frame_ids)} frames, average precision in percent. The "
        f"closer looks below are measured as: {escape('; '.join(measures) or 'nothing')}."
    )


def _of(study: Study, studies: Sequence[Study]) -> str:
    return f" of {escape(study.name)}" if len(studies) > 1 else ""


def _official_table(table: TableData) -> str:
    rows = [list(row) for row in table.rows if row is not None]
    notes = "".join(f"<p class='note'>{escape(note)}</p>" for note in table.notes)
    return f"<h3>{escape(table.title)}</h3>{_table([c.replace(chr(10), ' ') for c in table.columns], rows)}{notes}"


def _comparison_table(rows: Sequence[ComparisonRow], names: Sequence[str]) -> str:
    body = []
    for row in rows:
        sure = row.difference.low > 0 or row.difference.high < 0
        style = ("good" if row.difference.value > 0 else "bad") if sure else "note"
        body.append(
            [
                escape(row.class_name),
                escape(row.measure),
                escape(row.level),
                f"{row.first.value:.2f}",
                f"{row.second.value:.2f}",
                f"<span class='{style}'>{row.difference.value:+.2f}</span>",
                f"{row.difference.low:+.2f} to {row.difference.high:+.2f}",
            ]
        )
    header = ["class", "measure", "level", *map(escape, names), "difference", "95 % interval"]
    note = (
        "The interval is that of the difference when the frames are drawn again with replacement, the same draw for "
        "both; a difference is coloured where the interval leaves out zero."
    )
    return _table(header, body, raw=True) + f"<p class='note'>{note}</p>"


def _plots(studies: Sequence[Study]) -> str:
    names = tuple(dict.fromkeys(part.class_name for study in studies for part in study.classes))
    colors = dict(zip(names, PALETTE, strict=False))
    over, curves = [], []
    for index, study in enumerate(studies):
        for part in study.classes:
            name = part.class_name
            label = name if len(studies) == 1 else f"{name}, {study.name}"
            dashed = index < len(studies) - 1
            color, thresholds = colors.get(name, PALETTE[0]), list(part.ap_over_threshold)
            over.append(Line(label, thresholds, list(part.ap_over_threshold.values()), color, dashed))
            curves.append(Line(label, part.recall, part.precision, color, dashed))
    kinds = dict.fromkeys(part.threshold_name for study in studies for part in study.classes)
    kind = " and ".join(kinds) or "threshold"
    reach = max((x for line in over for x in line.x), default=1.0)
    charts = {
        f"AP over the {kind}": line_chart(
            over, kind, "AP, %", (0, max(1.0, float(reach))), (0, 100), width=500, markers=True
        ),
        "Precision over recall": line_chart(curves, "recall", "precision", (0, 1), (0, 1), width=500),
    }
    figures = "".join(f"<figure><figcaption>{name}</figcaption>{svg}</figure>" for name, svg in charts.items())
    return f"<div class='plots'>{figures}</div>"


def _distance_table(study: Study, studies: Sequence[Study]) -> str:
    parts = [part for part in study.classes if part.distance]
    if not parts:
        return ""
    ranges = [(row.near, row.far) for row in parts[0].distance]
    header = ["class" + _of(study, studies)]
    header += [f"{near:g} m and more" if far == float("inf") else f"{near:g} to {far:g} m" for near, far in ranges]
    rows = [[escape(part.class_name), *(f"{row.ap:.2f} ({row.objects})" for row in part.distance)] for part in parts]
    return _table(header, rows, raw=True)


def _outcome_table(study: Study, studies: Sequence[Study]) -> str:
    rows = []
    for part in study.classes:
        counts = part.counts
        hits, wrong, missed = counts.values()
        precision, recall = _ratio(hits, hits + wrong), _ratio(hits, hits + missed)
        name = escape(part.class_name)
        rows.append([name, f"{part.score_threshold:.3g}", *map(str, (hits, wrong, missed)), precision, recall])
    header = ["class" + _of(study, studies), "score from", "right", "wrong", "missed", "precision", "recall"]
    return _table(header, rows, raw=True)


def _fusion_tables(study: Study, studies: Sequence[Study]) -> str:
    parts = [part for part in study.classes if part.fusion]
    reported = [p.fusion.true_positives | p.fusion.false_positives for p in parts if p.fusion]
    used = [column for column in _OUTCOME_COLUMNS if any(column in counts for counts in reported)]
    outputs = [row for part in parts for row in _output_rows(part, used)]
    dropped = [row for part in parts for row in _dropped_rows(part)]
    kinds = ("dropped", "below_threshold", "not_proposed")
    misses = [[p.class_name, *(str(p.fusion.misses[kind]) for kind in kinds)] for p in parts if p.fusion]
    note = (
        "At the scores of the table above. Dropped rightly: the dropped LiDAR detection fits no object, or one that is "
        "reported anyway. Dropped wrongly: it fits an object that is now missed."
    )
    title = f"<h3>{escape(study.name)}</h3>" if len(studies) > 1 else ""
    return (
        title
        + f"<p class='note'>{note}</p>"
        + _table(["reported detections", "", *used], outputs)
        + _table(["dropped LiDAR detections", "reason", "rightly", "wrongly"], dropped)
        + _table(
            ["missed objects", "dropped by the fusion", "reported with a lower score", "no detection fits"], misses
        )
    )


def _output_rows(part: ClassStudy, used: Sequence[str]) -> list[list[str]]:
    if part.fusion is None:
        return []
    groups = {"right": part.fusion.true_positives, "wrong": part.fusion.false_positives}
    return [
        [part.class_name, name, *(str(counts.get(column, 0)) for column in used)] for name, counts in groups.items()
    ]


def _dropped_rows(part: ClassStudy) -> list[list[str]]:
    if part.fusion is None:
        return []
    right, wrong = part.fusion.dropped_rightly, part.fusion.dropped_wrongly
    return [
        [part.class_name, reason.replace("_", " "), str(right.get(reason, 0)), str(wrong.get(reason, 0))]
        for reason in sorted({*right, *wrong})
    ]


def _ratio(part: int, whole: int) -> str:
    return f"{part / whole:.3f}" if whole else "–"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], raw: bool = False) -> str:
    """An HTML table, nothing without rows; ``raw`` cells are HTML already."""
    if not rows:
        return ""

    def cell(text: str) -> str:
        return text if raw else escape(text)

    head = "".join(f"<th>{cell(text)}</th>" for text in header)
    body = "".join("<tr>" + "".join(f"<td>{cell(text)}</td>" for text in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

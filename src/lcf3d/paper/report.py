"""A table of the paper beside what was measured: for people, and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lcf3d.evaluation.protocol import TableData
from lcf3d.paper.tables import Row, Table
from lcf3d.paper.workplace import Measured


def to_json(table: Table, rows: Sequence[Row], measured: Mapping[str, Measured]) -> dict[str, Any]:
    """Printed, measured and their difference, row by row, as plain JSON values."""
    content = []
    for row in rows:
        found = measured.get(row.name)
        values = found.values if found else (None,) * len(table.columns)
        content.append(
            {
                "name": row.name,
                "paper": dict(zip(table.columns, row.values, strict=True)),
                "measured": dict(zip(table.columns, values, strict=True)),
                "difference": {
                    c: None if p is None or m is None else round(m - p, 6)
                    for c, p, m in zip(table.columns, row.values, values, strict=True)
                },
                "frames": found.frames if found else 0,
                "quoted": bool(row.quoted) and not (found and found.frames),
                "notes": list(found.notes) if found else [],
            }
        )
    return {"table": table.name, "title": table.title, "place": table.place, "rows": content}


def table_data(table: Table, rows: Sequence[Row], measured: Mapping[str, Measured]) -> TableData:
    """Three lines a system: paper, measured, difference."""
    # proportions of nuScenes need a digit more than percent
    digits = 3 if max(v for row in table.rows for v in (*row.values, 0.0) if v is not None) < 2 else 2
    cells: list[tuple[str, ...] | None] = []
    for row in rows:
        found = measured.get(row.name)
        ran = found is not None and any(v is not None for v in found.values)
        values = found.values if found else (None,) * len(table.columns)
        mark = " (quoted)" if row.quoted and not ran else ""
        cells.append((row.name + mark, *("" for _ in row.values)))
        cells.append(("  paper", *(_number(v, digits) for v in row.values)))
        if ran:
            differences = [None if p is None or m is None else m - p for p, m in zip(row.values, values, strict=True)]
            cells.append(("  measured", *(_number(v, digits) for v in values)))
            cells.append(("  difference", *(_number(v, digits, sign=True) for v in differences)))
    return TableData(
        f"{table.name}: {table.title}", ("", "", *map(_short, table.columns)), cells, notes_of(rows, measured)
    )


def notes_of(rows: Sequence[Row], measured: Mapping[str, Measured]) -> tuple[str, ...]:
    """What is to be known of the rows; what holds for several is said once."""
    by_note: dict[str, list[str]] = {}
    for row in rows:
        found = measured.get(row.name)
        for note in found.notes if found else ():
            by_note.setdefault(note, []).append(row.name)
        if found and found.frames > 1:
            by_note.setdefault(f"measured on {found.frames} frames", []).append(row.name)
    every = [row.name for row in rows]
    # of a single row there is nothing to tell apart
    return tuple(
        f"{'all rows' if names == every and len(every) > 1 else ', '.join(names)}: {note}"
        for note, names in by_note.items()
    )


def markdown(data: TableData) -> str:
    """The table as Markdown."""
    columns = [column.replace("\n", " ") for column in data.columns]
    lines = [f"## {data.title}", "", f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    lines += [f"| {' | '.join(row)} |" for row in data.rows if row is not None]
    return "\n".join([*lines, "", *(f"- {note}" for note in data.notes)]) + "\n"


def _number(value: float | None, digits: int, sign: bool = False) -> str:
    return "-" if value is None else f"{value:{'+' if sign else ''}.{digits}f}"


def _short(column: str) -> str:
    """A heading of short lines."""
    return "\n".join(word if len(word) <= 5 else f"{word[:4]}." for word in column.replace("_", " ").split())

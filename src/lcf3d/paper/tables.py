"""The paper's tables as data: every number with its place, and what has to be run to measure a row anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import yaml

from lcf3d.errors import ConfigError


@dataclass(frozen=True)
class Row:
    """One system of a table.

    Attributes:
        name: as the paper calls it.
        values: printed numbers by column, None where the paper prints none.
        lidar: published name of the LiDAR branch's network; "" where nothing can be run.
        camera: of the camera branch's; "" for the LiDAR branch alone.
        localizer: of recovery's network; "" where the row recovers nothing or the default does.
        stereo: both cameras of the pair.
        lidar_used: False for a pure cascade: every 2D detection is lifted, no LiDAR detection is used.
        changes: settings on top of the paper's, ``name=value``.
        task: data trained on and tested on, of a row of the domain shift.
        quoted: why the row can only be quoted; "" if it can be measured.
        needs: what would have to be there to measure it; "" if ``lidar`` says it.
    """

    name: str
    values: tuple[float | None, ...]
    lidar: str = ""
    camera: str = ""
    localizer: str = ""
    stereo: bool = False
    lidar_used: bool = True
    changes: tuple[str, ...] = ()
    task: tuple[str, str] | None = None
    quoted: str = ""
    needs: str = ""

    @property
    def networks(self) -> tuple[str, ...]:
        """Published names of everything that it runs."""
        return tuple(name for name in (self.lidar, self.camera, self.localizer) if name)


@dataclass(frozen=True)
class Table:
    """A table or the curves of a figure.

    Attributes:
        name: ``table-N`` in the order of the paper's results, or ``figure-N``.
        title: what it shows.
        place: section and label in the paper.
        measure: how a row is measured, see `lcf3d.paper.measure`.
        columns: what the numbers are.
        rows: the systems.
        changes: settings of all rows on top of the paper's.
    """

    name: str
    title: str
    place: str
    measure: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    changes: tuple[str, ...] = ()

    @property
    def data(self) -> tuple[str, ...]:
        """Kinds of datasets that its rows are measured on."""
        if self.measure == "cost":
            return ()
        if self.measure.startswith("shift"):
            return ("kitti", "nuscenes")
        return ("nuscenes",) if self.measure == "nuscenes" else ("kitti",)


@lru_cache(maxsize=1)
def paper_tables() -> dict[str, Table]:
    """All tables and figures of results, by name."""
    content = yaml.safe_load(files("lcf3d.paper").joinpath("tables.yaml").read_text(encoding="utf-8"))
    return {name: _table(name, values) for name, values in content.items()}


def find_table(name: str) -> Table:
    """The table of that name.

    Raises:
        ConfigError: there is none.
    """
    tables = paper_tables()
    if name not in tables:
        raise ConfigError(f"the paper has no {name!r}; choose one of {', '.join(tables)}, or 'list'")
    return tables[name]


def find_row(table: Table, text: str) -> Row:
    """The row whose name begins with ``text``, case, spaces and signs aside.

    Raises:
        ConfigError: none or several do.
    """
    found = _rows_of(table, text)
    if len(found) != 1:
        names = ", ".join(repr(row.name) for row in found or table.rows)
        raise ConfigError(f"{text!r} names {len(found)} rows of {table.name}, expected one; choose from {names}")
    return found[0]


def find_rows(tables: Sequence[Table], texts: Sequence[str]) -> list[tuple[Table, tuple[Row, ...]]]:
    """The named rows by table, see `find_row`; all rows without names. Tables that have none of them are left out.

    Raises:
        ConfigError: a name fits no table, or several rows of one.
    """
    if not texts:
        return [(table, table.rows) for table in tables]
    for text in texts:
        if not any(_rows_of(table, text) for table in tables):
            if len(tables) == 1:
                find_row(tables[0], text)
            raise ConfigError(f"no table has a row {text!r}; 'lcf3d paper all --dry' names all rows")
    chosen = [(table, tuple(find_row(table, t) for t in texts if _rows_of(table, t))) for table in tables]
    return [(table, rows) for table, rows in chosen if rows]


def _rows_of(table: Table, text: str) -> list[Row]:
    wanted = _plain(text)
    exact = [row for row in table.rows if _plain(row.name) == wanted]
    return exact or [row for row in table.rows if wanted and _plain(row.name).startswith(wanted)]


def _plain(text: str) -> str:
    return "".join(c for c in text.lower() if c.isalnum() or c in "*>")


def _table(name: str, values: dict[str, Any]) -> Table:
    rows = []
    for row in values.pop("rows"):
        for key in ("values", "changes", "task"):
            if key in row:
                row[key] = tuple(row[key])
        rows.append(Row(**row))
    changes = tuple(values.pop("changes", ()))
    return Table(name, columns=tuple(values.pop("columns")), rows=tuple(rows), changes=changes, **values)

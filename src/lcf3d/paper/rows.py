"""The rows of a table: measured, those that cannot be with the reason; or what each would need."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcf3d.benchmark.fusion import bench_fusion
from lcf3d.errors import ConfigError, Lcf3dError
from lcf3d.paper.cost import cost_rows, measure_costs
from lcf3d.paper.estimates import DATA, about
from lcf3d.paper.measure import measure_row
from lcf3d.paper.networks import NeedsError
from lcf3d.paper.tables import Row, Table, find_row
from lcf3d.paper.workplace import Measured, Workplace, without_values

FAILED = "not measured:"
"""How the note of a row begins whose run failed."""


def measured_rows(table: Table, rows: tuple[Row, ...], place: Workplace) -> dict[str, Measured]:
    """All rows, those that cannot be measured with the reason.

    Args:
        table: which they are of.
        rows: those wanted.
        place: data, weights and folder.

    Raises:
        ConfigError: something that was asked for cannot be; all other errors become notes of their rows.
    """
    if table.measure == "cost":
        try:
            costs = measure_costs(_fusion_ms, place.uses, place.device)
        except NeedsError as error:
            return {row.name: without_values(table, f"needs {error}") for row in rows}
        return cost_rows(table, rows, costs, place.uses, place.device)
    measured, absent = {}, []
    for row in rows:
        try:
            measured[row.name] = measure_row(table, row, place)
        except NeedsError as error:
            told = row.quoted or row.needs
            measured[row.name] = without_values(table, *([told] if told else (f"needs {p}" for p in error.parts)))
            absent += [row] if row.networks else []
        except ConfigError:
            raise
        except Lcf3dError as error:
            measured[row.name] = without_values(table, f"{FAILED} {error}")
    for row in absent:
        # what all of them take together, since a network runs once for all rows
        measured[row.name] = without_values(table, *measured[row.name].notes, about(table, absent))
    return measured


def needed_rows(table: Table, rows: tuple[Row, ...]) -> dict[str, Measured]:
    """What each row would need."""
    found = {}
    for row in rows:
        kinds = ((row.task[1],) if row.task else table.data) if row.lidar else ()
        data = (f"needs --{kind} FOLDER: {DATA[kind]}" for kind in kinds)
        own = row.quoted or row.needs or f"needs {', '.join(row.networks) or 'no data'}"
        takes = (about(table, rows) if table.data else "minutes",) if not row.quoted and not row.needs else ()
        found[row.name] = without_values(table, own, *data, *takes)
    return found


def given_results(table: Table, items: Sequence[str]) -> dict[str, Path]:
    """Result files by name of the row.

    Args:
        table: which the rows are of.
        items: ``NAME=DIR``.

    Raises:
        ConfigError: another form, an unknown row, no such folder, or a table of other things than boxes.
    """
    found = {}
    for item in items:
        name, equals, path = item.partition("=")
        if not equals or not path:
            raise ConfigError(f"--results takes NAME=DIR, for example LoGoNet=results/logonet, got {item!r}")
        if table.measure not in ("kitti", "nuscenes"):
            raise ConfigError(f"{table.name} takes no --results: it needs more than boxes, or boxes of several runs")
        if not Path(path).expanduser().exists():
            raise ConfigError(f"--results {item}: there is no {path}")
        found[find_row(table, name).name] = Path(path).expanduser()
    return found


def _fusion_ms() -> dict[str, float]:

    found = {timing.name: timing.median_ms for timing in bench_fusion(0.5)}
    names = {
        "matching": "bounding box matching, 200 x 20",
        "recovery": "detection recovery, 5 frustums, network",
        "semantic": "semantic fusion, 40 matches",
    }
    return {short: found[name] for short, name in names.items()}

"""How the program speaks to people: consoles that take no user text for markup, progress bars, notes on stderr."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from lcf3d.evaluation.protocol import TableData

WIDTH = 80
"""Columns that every table has to fit into."""


def console() -> Console:
    """The console for results: text is printed as it is, never read as markup."""
    from rich.console import Console

    out = Console(markup=False, highlight=False)
    # a pipe or file has no width of its own: wide enough that no line of a table is folded
    return out if out.is_terminal else Console(markup=False, highlight=False, width=max(out.width, 140))


def print_table(table: TableData) -> None:
    """A table and the sentences below it, on stdout."""
    from rich.table import Table

    shown = Table(title=table.title, title_justify="left", box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for number, column in enumerate(table.columns):
        # where a terminal is too narrow, names are folded and numbers stay whole
        shown.add_column(column, justify="right" if number else "left", no_wrap=bool(number), overflow="fold")
    bold = False
    for row in table.rows:
        if row is None:
            bold = True
            continue
        shown.add_row(*row, style="bold" if bold else None)
    out = console()
    out.print(shown)
    for note in table.notes:
        out.print(note, soft_wrap=True)


def print_json(value: Any) -> None:
    """A value as JSON on stdout. JSON has no NaN and no infinity: they become null."""
    print(json.dumps(strict(value), indent=2))


def strict(value: Any) -> Any:
    """A value of dictionaries, sequences and numbers with None for every number that is not finite."""
    if isinstance(value, Mapping):
        return {key: strict(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [strict(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plain(indices: Sequence[int]) -> Iterator[int]:
    """The indices, without a progress bar."""
    return iter(indices)


def tracked(indices: Sequence[int]) -> Iterator[int]:
    """The indices under a progress bar on stderr."""
    from rich.console import Console
    from rich.progress import track

    return iter(track(indices, "working", transient=True, console=Console(stderr=True)))


def start_logging(verbose: bool) -> None:
    """Notes and warnings of the library as lines on stderr; with ``verbose`` everything that it does."""
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(name)s: %(message)s" if verbose else "note: %(message)s",
        force=True,
    )

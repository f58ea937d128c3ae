"""What the fuzzing knows of a reader of files."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from tests.fuzz.mutations import Mutation

BOXES = [[10.0, 1.0, -0.8, 4.0, 1.7, 1.5, 0.1], [20.0, -3.0, -0.8, 4.0, 1.7, 1.5, 0.1]]


class Reader(NamedTuple):
    """A reader.

    Attributes:
        file: name of its file, below the folder it works in.
        make: writes a good file.
        read: reads it; may raise nothing but lcf3d's errors.
        mutate: damages it.
        needs: packages that it cannot do without.
        cost: a slow reader gets this many times fewer damages.
    """

    file: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    mutate: Mutation
    needs: tuple[str, ...] = ()
    cost: int = 1


def call(where: str, *arguments: Any) -> Callable[[Path], Any]:
    """A function of the library by ``module:name``, called with the path and the arguments."""
    module, _, name = where.partition(":")
    return lambda path: getattr(import_module(module), name)(path, *arguments)

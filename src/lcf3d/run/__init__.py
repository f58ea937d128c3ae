"""A dataset through both branches and the fusion: setup, settings, frames, folder, sources, results.

``lcf3d.run`` is this package and, called, `lcf3d.api.run`: the name belongs to both.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _CallablePackage(ModuleType):
    """A package that can be called."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """`lcf3d.api.run`."""
        api = __import__("lcf3d.api", fromlist=["run"])
        return api.run(*arguments, **options)


sys.modules[__name__].__class__ = _CallablePackage

"""What a dataset's sanity checks report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a dataset.

    Attributes:
        id: number of the rule, for example ``NUS02``.
        severity: ``error`` (the dataset cannot be used as it is) or ``warning`` (part of it is left out).
        message: one sentence that names the file, record or frame.
    """

    id: str
    severity: Literal["error", "warning"]
    message: str

"""Timing of small functions on noisy machines."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Timing:
    """One measured figure.

    Attributes:
        name: what was measured.
        median_ms: median milliseconds a call.
        best_ms: least milliseconds a call.
        repeats: calls measured.
        budget_ms: what it is allowed to take, or None.
        reference_ms: median milliseconds of a plain reference in the same run, or None.
        items: frames that one call works on.
    """

    name: str
    median_ms: float
    best_ms: float
    repeats: int
    budget_ms: float | None = None
    reference_ms: float | None = None
    items: int = 1

    @property
    def speedup(self) -> float | None:
        """How many times faster than the reference, or None without one."""
        return None if self.reference_ms is None else self.reference_ms / self.median_ms


def measure(call: Callable[[], Any], seconds: float = 1.0, least: int = 5, most: int = 500) -> tuple[float, float, int]:
    """Median and least milliseconds of a call, and the number of calls, after one that warms up.

    Args:
        call: what to measure.
        seconds: for about how long.
        least: fewest calls.
        most: most calls.
    """
    call()
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < least or (time.perf_counter() - begin < seconds and len(times) < most):
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1e3)
    times.sort()
    return times[len(times) // 2], times[0], len(times)


def timed(
    name: str,
    call: Callable[[], Any],
    *,
    budget_ms: float | None = None,
    reference: Callable[[], Any] | None = None,
    seconds: float = 1.0,
    items: int = 1,
) -> Timing:
    """A `Timing` of ``call`` and, if given, of a reference that does the same."""
    median, best, repeats = measure(call, seconds)
    reference_ms = measure(reference, seconds, least=3)[0] if reference is not None else None
    return Timing(name, median, best, repeats, budget_ms, reference_ms, items)

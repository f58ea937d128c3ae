"""Batches of a training by step, prepared here or by other processes: each depends on the seed and its step alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np


def seed_of(*parts: int) -> int:
    """One seed made of several numbers."""
    return int(np.random.default_rng(list(parts)).integers(2**62))


def batches(task: Any, seed: int, numbers: range, workers: int, rank: int) -> Iterator[tuple[int, Any]]:
    """Number and batch of each step of ``numbers``, for the process of a rank.

    Args:
        task: a `lcf3d.training.loop.TrainingTask`.
        seed: of the training.
        numbers: steps.
        workers: processes that prepare batches; 0 prepares them here.
        rank: of this process among those that train together.
    """
    steps = _Steps(task, seed, rank)
    if workers == 0:
        for step in numbers:
            yield step, steps[step]
        return
    from lcf3d.networks.torch import torch

    loader = torch.utils.data.DataLoader(
        steps, batch_size=None, sampler=numbers, num_workers=workers, persistent_workers=True
    )
    yield from zip(numbers, loader, strict=True)


class _Steps:
    """Batches by step, as a map-style dataset."""

    def __init__(self, task: Any, seed: int, rank: int) -> None:
        self.task, self.seed, self.rank = task, seed, rank

    def __getitem__(self, step: int) -> Any:
        return self.task.batch(step, np.random.default_rng([self.seed, step, self.rank]))

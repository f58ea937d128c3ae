"""``lcf3d eval --tracking``: tracks against labels that have track numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcf3d.datasets.base import Dataset
    from lcf3d.evaluation.protocol import EvaluationOptions


def eval_tracking(
    dataset: Dataset,
    frame_ids: Sequence[str] | None,
    options: EvaluationOptions,
    results: Path,
    missing: str,
    as_json: bool,
) -> None:
    """Print the measures of the tracks of a run, or of another tracker in the dataset's form.

    Raises:
        Lcf3dError: labels without track numbers, no tracks, or tracks of other frames.
    """
    from lcf3d.cli.console import print_json, print_table
    from lcf3d.evaluation.opening import open_tracking

    measured = open_tracking(dataset, frame_ids, options).read(results, missing)
    if as_json:
        print_json(measured.to_json())
        return
    print_table(measured.table())

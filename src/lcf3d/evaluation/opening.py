"""Datasets name their evaluation (`lcf3d.datasets.base.Dataset.evaluation`): here it is found and made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module

from lcf3d.datasets.base import Dataset
from lcf3d.errors import DatasetError
from lcf3d.evaluation.distance import DistanceEvaluation
from lcf3d.evaluation.protocol import Evaluation, EvaluationOptions, TrackingEvaluation

DEFAULT = EvaluationOptions()


def open_evaluation(
    dataset: Dataset, frame_ids: Sequence[str] | None = None, options: EvaluationOptions = DEFAULT
) -> Evaluation:
    """The evaluation that a dataset names.

    Args:
        dataset: with labels.
        frame_ids: frames to evaluate; those that the protocol takes by itself without them.
        options: what was asked for.

    Raises:
        ConfigError: an option that the evaluation does not know.
        DatasetError: frames without labels.
    """
    module, _, name = dataset.evaluation.partition(":")
    kind = getattr(import_module(module), name)
    if options.nds_hat and not getattr(kind, "has_nds_hat", False):
        # NDS^ is measured in the front camera's view, which is all that KITTI annotates
        kind = DistanceEvaluation
        options = replace(options, front=True)
    evaluation: Evaluation = kind(dataset, frame_ids, options)
    return evaluation


def open_tracking(
    dataset: Dataset, frame_ids: Sequence[str] | None = None, options: EvaluationOptions = DEFAULT
) -> TrackingEvaluation:
    """The measure of tracks that a dataset names.

    Args:
        dataset: with labels that have track numbers.
        frame_ids: frames that count; those that the protocol takes by itself without them.
        options: what was asked for.

    Raises:
        ConfigError: an option or class that it does not know.
        DatasetError: the dataset has none, or no labels with track numbers.
    """
    name: str | None = getattr(dataset, "tracking", None)
    if name is None:
        raise DatasetError(
            f"--tracking needs labels with track numbers, and {type(dataset).__name__} offers none; KITTI's sequences "
            "(training/label_02) and nuScenes have them"
        )
    module, _, kind = name.partition(":")
    evaluation: TrackingEvaluation = getattr(import_module(module), kind)(dataset, frame_ids, options)
    return evaluation


def usual_frames(dataset: Dataset) -> tuple[str, ...]:
    """The frames that the protocol of a dataset takes by itself, for example those of KITTI's ``val``."""
    return open_evaluation(dataset).frame_ids

"""Training of CLOCs (`lcf3d.fusion.clocs`) on detections of two branches, and its cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.evaluation.calibration_study import CalibrationStudy
from lcf3d.fusion.calibration import natural_transform, transform_scores
from lcf3d.fusion.calibration_fit import fit_platt
from lcf3d.fusion.clocs import WIDTHS, ClocsFusion, ClocsNetwork, Pairs, ScoreScale, find_pairs
from lcf3d.structures import BoolArray, FloatArray, IntArray
from lcf3d.training.loop import TrainingSettings, train

SETTINGS = TrainingSettings(steps=1000, learning_rate=3e-3, weight_decay=1e-4, average=0.99, checkpoint_every=1000)
"""Of each class's network; the highest learning rate is that of the authors' release."""

FRAMES_A_BATCH = 32
GAMMA, ALPHA = 2.0, 0.25
"""Of the focal loss (Lin et al., ICCV 2017), which the authors train with."""

# a class with fewer right or wrong candidates than this gets no network
FEWEST = 20


class ClassSample(NamedTuple):
    """The candidates of one class on some frames.

    Attributes:
        pairs: of all frames, ``candidate`` counted over all of them.
        frames: (N,) frame of each 3D candidate.
        judged: (N,) whether the protocol judges it.
        right: (N,) 1 for a true positive, else 0.
        rows: (N,) its place among all LiDAR detections of the study.
    """

    pairs: Pairs
    frames: IntArray
    judged: BoolArray
    right: FloatArray
    rows: IntArray


@dataclass
class ClocsTask:
    """What `lcf3d.training.loop.train` trains: the network of one class.

    Attributes:
        sample: its candidates.
        frames: the frames to train on.
    """

    sample: ClassSample
    frames: IntArray

    def __post_init__(self) -> None:
        from lcf3d.networks.torch import torch

        self.features = torch.from_numpy(self.sample.pairs.features.astype(np.float32))
        self._pair_ends = np.searchsorted(self.sample.pairs.candidate, np.arange(len(self.sample.frames) + 1))

    def network(self) -> Any:
        """Convolutions of 1 x 1 over pairs, which are matrix products."""
        from lcf3d.networks.torch import nn

        layers: list[Any] = []
        for before, after in pairwise(WIDTHS):
            layers += [nn.Linear(before, after), nn.ReLU()]
        return nn.Sequential(*layers[:-1])

    def batch(self, step: int, rng: np.random.Generator) -> Any:
        """Features of the pairs of some frames, which candidate each is of, and what the candidates are."""
        from lcf3d.networks.torch import torch

        chosen = rng.choice(self.frames, min(FRAMES_A_BATCH, len(self.frames)), replace=False)
        rows = np.flatnonzero(np.isin(self.sample.frames, chosen) & self.sample.judged)
        counts = self._pair_ends[rows + 1] - self._pair_ends[rows]
        pairs = np.concatenate(
            [np.zeros(0, np.int64), *map(np.arange, self._pair_ends[rows], self._pair_ends[rows + 1])]
        )
        return (
            self.features[torch.from_numpy(pairs)],
            torch.from_numpy(np.repeat(np.arange(len(rows)), counts)),
            torch.from_numpy(self.sample.right[rows].astype(np.float32)),
        )

    def loss(self, network: Any, batch: Any) -> dict[str, Any]:
        """The focal loss of the highest output of every candidate."""
        from lcf3d.networks.torch import functional, torch

        features, candidate, right = batch
        if not len(right):
            return {"focal": network(features).sum() * 0.0}
        lowest = torch.full((len(right),), -torch.inf)
        best = lowest.scatter_reduce(0, candidate, network(features)[:, 0], "amax")
        p = best.sigmoid()
        wrong = torch.where(right > 0, 1 - p, p)
        share = torch.where(right > 0, torch.tensor(ALPHA), torch.tensor(1 - ALPHA))
        entropy = functional.binary_cross_entropy_with_logits(best, right, reduction="none")
        return {"focal": (share * wrong**GAMMA * entropy).sum() / right.sum().clamp(min=1.0)}

    def validate(self, network: Any) -> dict[str, float]:
        """Nothing: figures are cross-validated."""
        return {}

    def described(self) -> dict[str, Any]:
        """Which frames of how many candidates."""
        return {"frames": self.frames.tolist(), "candidates": len(self.sample.frames)}

    def starting(self, weights: dict[str, Any]) -> dict[str, Any]:
        """As they are: one network of one width."""
        return weights


def collect(study: CalibrationStudy, name: str) -> tuple[ClassSample, ScoreScale]:
    """All candidates of a class, and the scale of their scores.

    Raises:
        DatasetError: the LiDAR branch has none.
    """
    assessed = study.lidar
    label = study.config.class_names.index(name)
    rows = np.flatnonzero(assessed.labels == label)
    if not len(rows):
        raise DatasetError(f"the LiDAR results hold no {name}: nothing to train CLOCs on")
    transform = natural_transform(assessed.scores[rows])
    x = transform_scores(assessed.scores[rows], transform)
    scale = ScoreScale(transform, float(x.mean()), max(float(x.std()), 1e-6))
    features, candidates, start = [], [], 0
    for frame, found, seen in zip(study.frames, study.lidar_inputs, study.camera_inputs, strict=True):
        own = found[found.labels == label]
        if len(own):
            pairs = find_pairs(frame, own, seen, scale)
            order = np.argsort(pairs.candidate, kind="stable")
            features.append(pairs.features[order])
            candidates.append(start + pairs.candidate[order])
            start += len(own)
    joined = Pairs(np.concatenate(features), np.concatenate(candidates))
    return ClassSample(joined, assessed.frames[rows], assessed.judged[rows], assessed.right[rows], rows), scale


def train_class(
    sample: ClassSample, scale: ScoreScale, frames: IntArray, settings: TrainingSettings = SETTINGS
) -> ClocsNetwork:
    """The network of a class, trained on some frames, its outputs calibrated on the same.

    Raises:
        DatasetError: there are too few right or wrong candidates.
        MissingExtraError: torch is not installed.
    """
    rows = np.isin(sample.frames, frames) & sample.judged
    right = int(sample.right[rows].sum())
    if min(right, int(rows.sum()) - right) < FEWEST:
        raise DatasetError(
            f"CLOCs needs {FEWEST} right and {FEWEST} wrong candidates of a class to train on, got {right} and "
            f"{int(rows.sum()) - right}"
        )
    with TemporaryDirectory() as folder:
        trained = train(ClocsTask(sample, frames), settings, Path(folder))
    layers = [layer for layer in trained if hasattr(layer, "weight")]
    network = ClocsNetwork(
        tuple(layer.weight.detach().double().numpy().T.copy() for layer in layers),
        tuple(layer.bias.detach().double().numpy().copy() for layer in layers),
        scale,
    )
    outputs = network.outputs(sample.pairs, len(sample.frames))
    slope, level = fit_platt(outputs[rows], sample.right[rows])
    return replace(network, slope=slope, level=level)


def train_clocs(study: CalibrationStudy, settings: TrainingSettings = SETTINGS) -> tuple[ClocsFusion, dict[str, str]]:
    """Networks of all classes that both branches detect, trained on all frames; why others have none.

    Raises:
        DatasetError: no class can be trained.
    """
    networks: dict[str, ClocsNetwork] = {}
    absent: dict[str, str] = {}
    for name in study.config.class_names:
        if name not in study.camera_classes:
            absent[name] = "the camera branch detects none"
            continue
        try:
            sample, scale = collect(study, name)
            networks[name] = train_class(sample, scale, np.arange(len(study.frames)), settings)
        except DatasetError as error:
            absent[name] = str(error)
    if not networks:
        raise DatasetError(f"no class can be trained: {'; '.join(f'{k}: {v}' for k, v in absent.items())}")
    return ClocsFusion(networks), absent


def cross_validate(
    study: CalibrationStudy, class_names: Sequence[str], settings: TrainingSettings = SETTINGS
) -> dict[str, tuple[float, ...]]:
    """Figures of each class, every fold fused by networks that were trained on the other folds.

    See `lcf3d.evaluation.protocol.Evaluation.figures`; folds are put together as calibrated probabilities.
    """
    return {
        name: study.evaluation.figures(study.rescored(fuse_folds(study, name, settings)))[name] for name in class_names
    }


def fuse_folds(study: CalibrationStudy, name: str, settings: TrainingSettings = SETTINGS) -> FloatArray:
    """(N,) scores of the LiDAR detections of a class, each by a network trained on the other folds; NaN for others."""
    sample, scale = collect(study, name)
    scores = np.full(len(study.lidar.scores), np.nan)
    for fold in np.unique(study.folds):
        network = train_class(sample, scale, np.flatnonzero(study.folds != fold), settings)
        test = study.folds[sample.frames] == fold
        scores[sample.rows[test]] = network.scores(sample.pairs, len(sample.frames))[test]
    return scores

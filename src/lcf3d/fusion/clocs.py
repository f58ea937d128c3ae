"""CLOCs (Pang, Morris, Radha, IROS 2020): learned fusion of 3D and 2D candidates, a rival of the late-cascade fusion.

Every pair of a 3D candidate and a 2D candidate of its class that overlap in the image has four features: their IoU,
both scores, and the distance of the 3D candidate. Four convolutions of 1 x 1 turn them into one number a pair, and the
highest of a candidate's pairs is its new score. 3D candidates without any pair get one with IoU and 2D score -1. Boxes
and labels stay, nothing is recovered and nothing deleted. Plain numpy; `lcf3d.training.clocs` trains it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lcf3d.errors import FormatError
from lcf3d.files import read_json, write_json
from lcf3d.frame import Frame
from lcf3d.fusion.calibration import Transform, transform_scores
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.structures import Detections2D, Detections3D, FloatArray, IntArray

WIDTHS = (4, 18, 36, 36, 1)
"""Channels before, between and after the convolutions."""

FARTHEST_M = 82.0
"""Distances are divided by it."""

FORMAT = "lcf3d.clocs/1"


class Pairs(NamedTuple):
    """Pairs of a frame's 3D candidates with 2D candidates.

    Attributes:
        features: (P, 4) IoU, 2D score, 3D score, distance / `FARTHEST_M`; IoU and 2D score are -1 without a partner.
        candidate: (P,) row of the 3D candidate; every row occurs at least once.
    """

    features: FloatArray
    candidate: IntArray


class ScoreScale(NamedTuple):
    """How the 3D scores of a detector are brought to numbers around 0."""

    transform: Transform
    mean: float
    spread: float

    def __call__(self, scores: FloatArray) -> FloatArray:
        """(N,) transformed scores, of mean 0 and spread 1 where they were fitted."""
        return (transform_scores(scores, self.transform) - self.mean) / self.spread


@dataclass(frozen=True)
class ClocsNetwork:
    """The network of one class.

    Attributes:
        weights: (in, out) of each convolution.
        biases: (out,) of each convolution.
        scale: of the 3D scores.
        slope: of the log-odds of a fused score, fitted on the training frames.
        level: of the same.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]
    scale: ScoreScale
    slope: float = 1.0
    level: float = 0.0

    def outputs(self, pairs: Pairs, count: int) -> FloatArray:
        """(N,) the highest output among the pairs of each of ``count`` 3D candidates."""
        x = pairs.features
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = x @ weight + bias
            if i < len(self.weights) - 1:
                x = np.maximum(x, 0.0)
        best = np.full(count, -np.inf)
        np.maximum.at(best, pairs.candidate, x[:, 0])
        return best

    def scores(self, pairs: Pairs, count: int) -> FloatArray:
        """(N,) fused scores in (0, 1)."""
        log_odds = self.slope * self.outputs(pairs, count) + self.level
        return np.asarray(0.5 * (1 + np.tanh(log_odds / 2)))


@dataclass(frozen=True)
class ClocsFusion:
    """CLOCs with a network a class; classes without one keep their scores.

    Attributes:
        networks: by class name.
    """

    networks: Mapping[str, ClocsNetwork]

    def __call__(self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D]) -> Detections3D:
        """The 3D candidates with fused scores.

        Args:
            frame: has the cameras.
            lidar: 3D candidates in its LiDAR frame.
            camera: 2D candidates by camera name.
        """
        scores = lidar.scores.copy()
        for name, network in self.networks.items():
            if name not in lidar.class_names:
                continue
            own = np.flatnonzero(lidar.labels == lidar.class_names.index(name))
            if len(own):
                pairs = find_pairs(frame, lidar[own], camera, network.scale)
                scores[own] = network.scores(pairs, len(own))
        return replace(lidar, scores=scores)

    def dump(self, path: Path) -> None:
        """Write all networks as JSON, whole or not at all."""
        content = {
            name: {
                "weights": [w.tolist() for w in network.weights],
                "biases": [b.tolist() for b in network.biases],
                "scale": list(network.scale),
                "slope": network.slope,
                "level": network.level,
            }
            for name, network in self.networks.items()
        }
        write_json(path, {"format": FORMAT, "networks": content})

    @classmethod
    def load(cls, path: Path) -> ClocsFusion:
        """Read what `dump` wrote.

        Raises:
            FormatError: the file is not there, or holds something else.
        """
        content = read_json(path)
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise FormatError(f"{path} holds no CLOCs networks; expected a file of 'lcf3d train clocs'")
        try:
            return cls({name: _network(values) for name, values in content["networks"].items()})
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path} is damaged ({error!r}); train it again with 'lcf3d train clocs'") from None


def find_pairs(frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D], scale: ScoreScale) -> Pairs:
    """Pairs of 3D candidates of one class with the 2D candidates of that class that they overlap, over all cameras.

    Args:
        frame: has the cameras.
        lidar: (N,) 3D candidates, all of one class.
        camera: 2D candidates by camera name; those of other classes make no pair.
        scale: of the 3D scores.
    """
    n = len(lidar)
    scores = scale(lidar.scores)
    distances = np.hypot(lidar.boxes[:, 0], lidar.boxes[:, 1]) / FARTHEST_M
    name = lidar.class_names[lidar.labels[0]] if n else ""
    rows: list[IntArray] = []
    overlaps: list[FloatArray] = []
    partners: list[FloatArray] = []
    for seen_by, found in camera.items():
        if name not in found.class_names:
            continue
        own = found[found.labels == found.class_names.index(name)]
        projected, visible = project_boxes(lidar.boxes, frame.camera(seen_by))
        iou = image_iou(projected, own.boxes) * visible[:, None]
        row, column = np.nonzero(iou > 0)
        rows.append(row)
        overlaps.append(iou[row, column])
        partners.append(own.scores[column])
    alone = np.setdiff1d(np.arange(n), np.concatenate([*rows, np.zeros(0, np.int64)]))
    candidate = np.concatenate([*rows, alone]).astype(np.int64)
    missing = np.full(len(alone), -1.0)
    overlap, partner = np.concatenate([*overlaps, missing]), np.concatenate([*partners, missing])
    return Pairs(np.stack([overlap, partner, scores[candidate], distances[candidate]], axis=1), candidate)


def _network(values: dict[str, Any]) -> ClocsNetwork:
    weights = tuple(np.array(w, dtype=np.float64) for w in values["weights"])
    biases = tuple(np.array(b, dtype=np.float64) for b in values["biases"])
    if [w.shape for w in weights] != list(pairwise(WIDTHS)):
        raise ValueError(f"convolutions of shapes {[w.shape for w in weights]}")
    transform, mean, spread = values["scale"]
    scale = ScoreScale(transform, float(mean), float(spread))
    return ClocsNetwork(weights, biases, scale, float(values["slope"]), float(values["level"]))

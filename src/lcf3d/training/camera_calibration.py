"""Scores of the camera detector as probabilities: a slope and a shift of each class's logit, fitted after training.

Rare classes are shown more often in training than they occur, and a detection's score is the best of many cells; both
bend the scores. Two numbers a class put that right and leave the order of a class's detections, hence its AP, alone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from lcf3d.structures import BoolArray, FloatArray
from lcf3d.training.camera_evaluation import evaluate_detector
from lcf3d.training.camera_images import LabelledImage
from lcf3d.training.loop import import_torch

if TYPE_CHECKING:
    from lcf3d.detectors.camera.small_network import SmallDetector

# detections below are too unsure to tell anything about those that matter
LOWEST_SCORE = 0.03
# how firmly slope and shift are held at 1 and 0, in detections
PRIOR_WEIGHT = 2.0


def calibrate(network: SmallDetector, images: Sequence[LabelledImage]) -> None:
    """Fit the network's ``calibration`` on images that it did not learn from; done anew if it was fitted before."""
    from lcf3d.detectors.camera.onnx import OnnxDetector
    from lcf3d.detectors.camera.small_export import export_small

    torch = import_torch()
    classes = network.config.classes
    network.calibration.copy_(torch.tensor([[1.0, 0.0]] * classes))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.onnx"
        export_small(network, path)
        found = evaluate_detector(OnnxDetector(path, score_threshold=LOWEST_SCORE, threads=1), images)
    fits = [fit_logits(found.scores[found.labels == c], found.hits[found.labels == c, 0]) for c in range(classes)]
    network.calibration.copy_(torch.tensor(fits))


def fit_logits(scores: FloatArray, hits: BoolArray) -> tuple[float, float]:
    """Slope and shift of the logit that make scores the probability of a hit; slope stays above 0.

    Args:
        scores: (N,) in [0, 1].
        hits: (N,) whether each detection was right.
    """
    logits = logit(np.clip(scores, 1e-4, 1 - 1e-4))

    def cost(parameters: FloatArray) -> tuple[float, FloatArray]:
        slope = np.exp(parameters[0])
        values = slope * logits + parameters[1]
        error = expit(values) - hits
        loss = np.logaddexp(0, values).sum() - values[hits].sum() + PRIOR_WEIGHT * float((parameters**2).sum())
        gradient = np.array([slope * (error * logits).sum(), error.sum()]) + 2 * PRIOR_WEIGHT * parameters
        return float(loss), gradient

    fitted = minimize(cost, np.zeros(2), jac=True, method="L-BFGS-B").x
    return float(np.exp(fitted[0])), float(fitted[1])

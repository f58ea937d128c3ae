"""Semantic fusion: labels and scores of matched detections (paper section 4.1.5, Algorithm 1)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from lcf3d.structures import FloatArray, IntArray

Ensemble = Literal["probabilistic", "product"]

# scores are kept this far from 0 and 1 inside the ensemble, where both would be certain of opposite things
_MARGIN = 1e-6


def fuse_scores(
    lidar_scores: FloatArray, camera_scores: FloatArray, priors: FloatArray, method: Ensemble = "probabilistic"
) -> FloatArray:
    """Ensemble score of detections on whose label both branches agree.

    ``product`` is the paper's formula as printed, ``s3d * s2d / p``; it is not confined to [0, 1]. ``probabilistic`` is
    the same formula normalised over {class, not class}:
    ``a / (a + b)`` with ``a = s3d s2d / p`` and ``b = (1 - s3d)(1 - s2d) / (1 - p)``.

    Args:
        lidar_scores: (N,) in [0, 1].
        camera_scores: (N,) in [0, 1].
        priors: (N,) prior probability of each detection's class, in (0, 1).
        method: see above.
    """
    if method == "product":
        return lidar_scores * camera_scores / priors
    lidar = np.clip(lidar_scores, _MARGIN, 1 - _MARGIN)
    camera = np.clip(camera_scores, _MARGIN, 1 - _MARGIN)
    agree = lidar * camera / priors
    against = (1 - lidar) * (1 - camera) / (1 - priors)
    fused: FloatArray = agree / (agree + against)
    return fused


def semantic_fusion(
    lidar_scores: FloatArray,
    lidar_labels: IntArray,
    camera_scores: FloatArray,
    camera_labels: IntArray,
    priors: FloatArray,
    method: Ensemble = "probabilistic",
) -> tuple[FloatArray, IntArray]:
    """Scores and labels of N matched pairs (Algorithm 1).

    The label is the camera's. Where the labels agree the score is the ensemble of both, else it is the camera's.

    Args:
        lidar_scores: (N,) ``s3d``.
        lidar_labels: (N,) ``lambda3d``.
        camera_scores: (N,) ``s2d``.
        camera_labels: (N,) ``lambda2d``.
        priors: (L,) prior of each class.
        method: see `fuse_scores`.
    """
    agreed = fuse_scores(lidar_scores, camera_scores, priors[camera_labels], method)
    return np.where(lidar_labels == camera_labels, agreed, camera_scores), camera_labels

"""Scores of the LiDAR detector as probabilities: a slope and a shift of each class's logit, put into its last layer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from lcf3d.geometry.iou import bev_iou
from lcf3d.structures import BoolArray, Detections3D, FloatArray, IntArray
from lcf3d.training.camera_calibration import fit_logits
from lcf3d.training.lidar_scans import LabelledScan
from lcf3d.training.loop import import_torch

LOWEST_SCORE = 0.05
ENOUGH_OVERLAP = (0.5, 0.3, 0.3)
"""Bird's-eye-view IoU above which a detection counts as right, by class."""


def calibrate(network: Any, config: Any, scans: Iterable[LabelledScan]) -> list[tuple[float, float]]:
    """Fit the network's scores to the share of right detections in scans that it did not learn from.

    Args:
        network: `lcf3d.detectors.lidar.compact.CompactNetwork` on the CPU; its last layer is changed.
        config: its configuration.
        scans: as they come from the sensor, with the objects of the classes.

    Returns:
        Slope and shift of each class.
    """
    from lcf3d.training.lidar import trained_detector

    detector = trained_detector(network, config, nms="keep", score_threshold=LOWEST_SCORE)
    scores, labels, hits = [], [], []
    for scan in scans:
        found = detector(scan.points)
        right, counted = hits_of(found, scan)
        scores.append(found.scores[counted])
        labels.append(found.labels[counted])
        hits.append(right[counted])
    fits = fits_of(np.concatenate(scores), np.concatenate(labels), np.concatenate(hits), len(config.class_names))
    bend_scores(network, fits)
    return fits


def fits_of(scores: FloatArray, labels: IntArray, hits: BoolArray, classes: int) -> list[tuple[float, float]]:
    """Slope and shift of each class; those of a class without detections are 1 and 0."""
    return [fit_logits(scores[labels == c], hits[labels == c]) for c in range(classes)]


def hits_of(found: Detections3D, scan: LabelledScan) -> tuple[BoolArray, BoolArray]:
    """(N,) whether each detection finds an object of its class that no better one found, and whether it counts."""
    right, counted = np.zeros(len(found), dtype=bool), np.ones(len(found), dtype=bool)
    if not len(found) or not len(scan.boxes):
        return right, counted
    overlap = bev_iou(found.boxes, scan.boxes)
    free = np.ones(len(scan.boxes), dtype=bool)
    for row in np.argsort(-found.scores, kind="stable"):
        same = np.where(free & (scan.labels == found.labels[row]), overlap[row], 0.0)
        best = int(same.argmax())
        if same[best] > ENOUGH_OVERLAP[int(found.labels[row])]:
            right[row], free[best] = True, False
        elif (overlap[row, scan.labels < 0] > 0.1).any():
            counted[row] = False
    return right, counted


def bend_scores(network: Any, fits: Sequence[tuple[float, float]]) -> None:
    """Put slope and shift of each class's logit into the last layer of a `LightCenterHead` with one task."""
    torch = import_torch()
    head = network.bbox_head
    layer, classes = head.task_heads[0], head.maps[0]["heatmap"]
    with torch.no_grad():
        for k, (slope, shift) in enumerate(fits):
            row = layer.weight.shape[0] - classes + k
            layer.weight[row] *= slope
            layer.bias[row] = layer.bias[row] * slope + shift

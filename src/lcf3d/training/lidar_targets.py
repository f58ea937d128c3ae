"""What a centre head is to say about a scan, and how wrong it is (section 4.1 of the CenterPoint paper)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, IntArray

BOX_CHANNELS = 11
"""Regressed values: offset from the cell's corner along x and y in cells, z of the centre, logs of length, width and
height, sine and cosine of the yaw and of twice the yaw, and the weight of the cell (whose sum over the cells of an
object is 1)."""
AROUND = 1
"""Cells around an object's own, in each direction, that also learn its box: without suppression they give overlapping
boxes, which the fusion's clustering lives on."""
HEAT_SIGMA = 0.8
"""Standard deviation in cells of an object's heat, for small objects; long ones have a larger one."""
HEAT_REACH = 3
FRONT_SLOPE = 4.0
"""How sharply telling front from rear is judged."""
FRONT_WEIGHT = 0.5
"""Weight of the heading beside that of its axis, on which the overlap with the object depends."""


@dataclass(frozen=True, eq=False)
class CenterTargets:
    """Targets of a scan on the head's map.

    Attributes:
        heat: (K, H, W) float32 wanted heat by class, 1 at the centres.
        counted: (H, W) float32 0 where an object is neither to be found nor background, else 1.
        cells: (M,) int64 flat cells that learn a box.
        boxes: (M, BOX_CHANNELS) float32 what they learn.
    """

    heat: NDArray[np.float32]
    counted: NDArray[np.float32]
    cells: IntArray
    boxes: NDArray[np.float32]


def center_targets(boxes: FloatArray, labels: IntArray, config: LidarConfig) -> CenterTargets:
    """Targets for (A, 7) boxes with (A,) labels of classes, negative ones for ignored objects.

    Objects centred outside the map are not to be found. Where two objects share a cell, the nearer centre has it.
    """
    assert config.centers is not None
    nx, ny, _ = config.voxels.grid
    width, height = nx // config.centers.stride, ny // config.centers.stride
    step = np.array(config.voxels.size[:2]) * config.centers.stride
    low = np.array(config.voxels.area[:2])
    heat = np.zeros((len(config.class_names), height, width), np.float32)
    counted = np.ones((height, width), np.float32)
    owner = np.full((height, width), -1, np.int64)
    distance = np.full((height, width), np.inf)
    places = (boxes[:, :2] - low) / step
    for k in range(len(boxes)):
        x, y = places[k]
        if labels[k] < 0:
            _blank(counted, x, y, boxes[k, 3] / step[0] / 2, boxes[k, 4] / step[1] / 2, boxes[k, 6])
        elif 0 <= x < width and 0 <= y < height:
            sigma = max(HEAT_SIGMA, 0.15 * math.hypot(boxes[k, 3], boxes[k, 4]) / step[0])
            _warm(heat[labels[k]], owner, distance, k, x, y, sigma)
    # where something is to be found, nothing is ignored
    counted[(heat >= 1).any(axis=0)] = 1
    cells = np.flatnonzero(owner.ravel() >= 0)
    owners = owner.ravel()[cells]
    row, column = np.divmod(cells, width)
    values = np.empty((len(cells), BOX_CHANNELS), np.float32)
    values[:, :2] = places[owners] - np.stack([column, row], axis=1)
    values[:, 2] = boxes[owners, 2]
    values[:, 3:6] = np.log(boxes[owners, 3:6])
    values[:, 6], values[:, 7] = np.sin(boxes[owners, 6]), np.cos(boxes[owners, 6])
    values[:, 8], values[:, 9] = np.sin(2 * boxes[owners, 6]), np.cos(2 * boxes[owners, 6])
    off = values[:, :2].astype(np.float64) - 0.5
    near = np.exp(-(off**2).sum(axis=1) / (2 * HEAT_SIGMA**2))
    total = np.bincount(owners, near, minlength=len(boxes))
    values[:, -1] = near / total[owners]
    return CenterTargets(heat, counted, cells, values)


@kernel
def _warm(heat, owner, distance, k, x, y, sigma):  # type: ignore[no-untyped-def]
    """Add an object's heat around its own cell, and let it claim the cells next to it that are not nearer others."""
    height, width = heat.shape
    column, row = int(x), int(y)
    for r in range(max(row - HEAT_REACH, 0), min(row + HEAT_REACH + 1, height)):
        for c in range(max(column - HEAT_REACH, 0), min(column + HEAT_REACH + 1, width)):
            square = (r - row) ** 2 + (c - column) ** 2
            heat[r, c] = max(heat[r, c], math.exp(-square / (2 * sigma * sigma)))
            away = (r + 0.5 - y) ** 2 + (c + 0.5 - x) ** 2
            own = r == row and c == column
            if abs(r - row) <= AROUND and abs(c - column) <= AROUND and (own or away < distance[r, c]):
                owner[r, c] = k
                distance[r, c] = -1.0 if own else away


@kernel
def _blank(counted, x, y, half_length, half_width, yaw):  # type: ignore[no-untyped-def]
    """Leave the cells in and next to a box out of the loss."""
    height, width = counted.shape
    reach = int(math.hypot(half_length, half_width)) + 2
    cos, sin = math.cos(yaw), math.sin(yaw)
    for r in range(max(int(y) - reach, 0), min(int(y) + reach + 1, height)):
        for c in range(max(int(x) - reach, 0), min(int(x) + reach + 1, width)):
            dx, dy = c + 0.5 - x, r + 0.5 - y
            if abs(dx * cos + dy * sin) <= half_length + 1 and abs(dy * cos - dx * sin) <= half_width + 1:
                counted[r, c] = 0


def center_losses(maps: Mapping[str, Any], batch: Mapping[str, Any], box_weight: float) -> dict[str, Any]:
    """Loss terms ``heat``, ``place``, ``size``, ``heading``, ``front`` and ``axis`` of a centre head's maps.

    Args:
        maps: of one task, (N, C, H, W) each.
        batch: ``heat`` (N, K, H, W), ``counted`` (N, H, W), ``cells`` (M,) flat over the scans, ``boxes``
            (M, BOX_CHANNELS).
        box_weight: weight of the box terms.
    """
    from lcf3d.networks.torch import torch

    logits, heat = maps["heatmap"].float(), batch["heat"]
    wanted = (heat >= 1).float()
    objects = wanted.sum().clamp(min=1)
    # penalty-reduced focal loss (CornerNet, equation 1), from logits
    found = torch.sigmoid(logits)
    missed = wanted * (1 - found) ** 2 * torch.nn.functional.softplus(-logits)
    false = (1 - wanted) * (1 - heat) ** 4 * found**2 * torch.nn.functional.softplus(logits)
    heat_loss = ((missed + false) * batch["counted"][:, None]).sum() / objects
    flat = torch.cat([maps[name] for name in ("reg", "height", "dim", "rot", "axis")], dim=1).float()
    learned = flat.permute(0, 2, 3, 1).reshape(-1, BOX_CHANNELS - 1)[batch["cells"]]
    values, weight = batch["boxes"][:, :-1], batch["boxes"][:, -1:]
    error = (learned - values).abs() * weight * (box_weight / objects)
    # which of the two headings along the axis: the sign of the projection onto the true one
    ahead = (learned[:, 6:8] * values[:, 6:8]).sum(dim=1, keepdim=True)
    front = (torch.nn.functional.softplus(-FRONT_SLOPE * ahead) * weight).sum() * (FRONT_WEIGHT * box_weight / objects)
    return {
        "heat": heat_loss,
        "place": error[:, :3].sum(),
        "size": error[:, 3:6].sum(),
        "heading": error[:, 6:8].sum() * FRONT_WEIGHT,
        "front": front,
        "axis": error[:, 8:10].sum(),
    }

"""Two-stage detectors: proposals of the first stage, pooling in a region of interest, decoding of its refinement.

Regions are ``x y z length width height yaw`` with z at the bottom face, as in `lcf3d.detectors.lidar.decoding`.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.decoding import Map, decode_anchor_maps, decode_residuals, turn_by_direction
from lcf3d.detectors.lidar.suppression import NmsMode, bev_nms, suppression_threshold
from lcf3d.networks.torch import Tensor, nn, torch
from lcf3d.structures import FloatArray, IntArray


@dataclass(frozen=True)
class Proposals:
    """Regions of interest.

    Attributes:
        boxes: (R, 7), bottom centre.
        labels: (R,) class of each.
        scores: (R, K) score of every class.
    """

    boxes: FloatArray
    labels: IntArray
    scores: FloatArray


def propose(maps: Sequence[tuple[Map, Map, Map]], config: LidarConfig, nms: NmsMode = "keep") -> Proposals:
    """The best anchors of the first stage after suppression over all classes together."""
    spec, rule = config.anchors, config.proposals
    assert spec is not None
    assert rule is not None
    candidates = decode_anchor_maps(maps, spec, len(config.class_names), rule.candidates)
    best = candidates.scores.max(axis=1)
    passed = np.flatnonzero((best > rule.score_threshold) & np.isfinite(candidates.boxes).all(axis=1))
    kept = passed[bev_nms(candidates.boxes[passed], best[passed], suppression_threshold(nms, rule.iou_threshold))][
        : rule.max_boxes
    ]
    boxes = candidates.boxes[kept]
    boxes[:, 6] = turn_by_direction(boxes[:, 6], candidates.directions[kept], spec.direction_offset)
    return Proposals(boxes, candidates.scores[kept].argmax(axis=1), candidates.scores[kept])


def refine(regions: FloatArray, residuals: FloatArray) -> FloatArray:
    """(R, 7) boxes from regions and residuals in the frame of each region."""
    local = regions.copy()
    local[:, :3] = 0
    boxes = decode_residuals(local, residuals)
    cos, sin = np.cos(regions[:, 6]), np.sin(regions[:, 6])
    x, y = boxes[:, 0].copy(), boxes[:, 1].copy()
    boxes[:, 0] = x * cos - y * sin + regions[:, 0]
    boxes[:, 1] = x * sin + y * cos + regions[:, 1]
    boxes[:, 2] += regions[:, 2]
    return boxes


def pool_in_regions(regions: Tensor, positions: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Which points lie in which cell of which region (RoI-aware pooling, section 3.3 of the Part-A2 paper).

    Args:
        regions: (R, 7), bottom centre.
        positions: (N, 3).
        size: cells along each of length, width and height.

    Returns:
        (P,) index of the point and (P,) flat cell, ``((region * size + i) * size + j) * size + k`` with i along the
        length, j along the width and k upwards, for every point in a region.
    """
    offset = positions[None] - regions[:, None, :3]
    cos, sin = torch.cos(regions[:, 6, None]), torch.sin(regions[:, 6, None])
    x = offset[..., 0] * cos + offset[..., 1] * sin
    y = offset[..., 1] * cos - offset[..., 0] * sin
    length, width, height = (regions[:, axis, None] for axis in (3, 4, 5))
    z = offset[..., 2]
    inside = (x.abs() < length / 2) & (y.abs() < width / 2) & (z >= 0) & (z <= height)
    region, point = torch.nonzero(inside, as_tuple=True)
    cell = region
    for value, extent, shift in ((x, length, 0.5), (y, width, 0.5), (z, height, 0.0)):
        step = ((value / extent + shift) * size).long().clamp(0, size - 1)
        cell = cell * size + step[region, point]
    return point, cell


def pooled_maximum(features: Tensor, cells: Tensor, count: int) -> Tensor:
    """(count, C) maximum of the (P, C) features of each cell, 0 where there are none."""
    index = cells[:, None].expand(-1, features.shape[1])
    pooled = features.new_zeros(count, features.shape[1])
    return pooled.scatter_reduce(0, index, features, "amax", include_self=False)


def pooled_mean(features: Tensor, cells: Tensor, count: int) -> Tensor:
    """(count, C) mean of the (P, C) features of each cell, 0 where there are none."""
    sums = features.new_zeros(count, features.shape[1]).index_add_(0, cells, features)
    return sums / torch.bincount(cells, minlength=count).clamp(min=1)[:, None]


def region_grid(regions: Tensor, size: int) -> Tensor:
    """(R, size^3, 3) centres of the cells of (R, 7) regions, row-major along length, width, height."""
    steps = (torch.arange(size, device=regions.device) + 0.5) / size - 0.5
    grid = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1).reshape(1, -1, 3)
    local = grid * regions[:, None, 3:6]
    cos, sin = torch.cos(regions[:, 6, None]), torch.sin(regions[:, 6, None])
    x = local[..., 0] * cos - local[..., 1] * sin + regions[:, 0, None]
    y = local[..., 0] * sin + local[..., 1] * cos + regions[:, 1, None]
    z = local[..., 2] + regions[:, 2, None] + regions[:, 5, None] / 2
    return torch.stack([x, y, z], dim=-1)


class LinearModule(nn.Module):
    """A convolution of width 1 over a (N, C) matrix, as the published heads name and store it: ``conv``, ``bn``."""

    def __init__(self, in_channels: int, out_channels: int, axes: int, eps: float = 1e-5, norm: bool = True) -> None:
        super().__init__()
        kind = nn.Conv1d if axes == 1 else nn.Conv2d
        self.conv = kind(in_channels, out_channels, 1, bias=not norm)
        self.bn = (nn.BatchNorm1d if axes == 1 else nn.BatchNorm2d)(out_channels, eps=eps) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, 1[, 1]) -> (N, out, 1[, 1]), rectified unless it is the last layer."""
        x = self.conv(x)
        return x if self.bn is None else nn.functional.relu(self.bn(x))

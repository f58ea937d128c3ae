"""Pillar statistics and targets of a batch of scans as torch operations, for the device that trains.

The same numbers as `lcf3d.detectors.lidar.statistics` gives for one scan, which is quicker on a CPU.
"""

from __future__ import annotations

import math
from typing import Any

from lcf3d.detectors.lidar.config import LidarConfig, VoxelSpec
from lcf3d.detectors.lidar.statistics import FAR_M, QUARTERS, SLICES
from lcf3d.training.lidar_targets import AROUND, BOX_CHANNELS, HEAT_REACH, HEAT_SIGMA
from lcf3d.training.loop import import_torch

BLANK_REACH = 12
"""Cells around the centre of an ignored object within which it is left out of the loss."""


def statistics_of(points: Any, scan: Any, scans: int, spec: VoxelSpec) -> tuple[Any, Any]:
    """(Q, FEATURES) statistics of every pillar that holds a point, and its (Q,) flat cell over all scans.

    Args:
        points: (P, 4) x, y, z, intensity of all scans; those outside the volume are left out.
        scan: (P,) scan of each point.
        scans: number of scans.
        spec: pillar size and volume.
    """
    torch, device = import_torch(), points.device
    nx, ny, _ = spec.grid
    low, high = points.new_tensor(spec.area[:3]), points.new_tensor(spec.area[3:])
    rows = torch.nonzero(((points[:, :3] > low) & (points[:, :3] < high)).all(1))[:, 0]
    points, scan = points[rows], scan[rows]
    size = points.new_tensor(spec.size[:2])
    place = (points[:, :2] - low[:2]) / size
    column = place[:, 0].long().clamp(max=nx - 1)
    row = place[:, 1].long().clamp(max=ny - 1)
    cell = (scan * ny + row) * nx + column
    occupied = torch.zeros(scans * nx * ny, dtype=torch.bool, device=device)
    occupied[cell] = True
    cells = torch.nonzero(occupied)[:, 0]
    number = torch.zeros(scans * nx * ny, dtype=torch.long, device=device)
    number[cells] = torch.arange(len(cells), device=device)
    pillar = number[cell]
    offset = 2 * (place - torch.stack([column, row], dim=1)) - 1
    up = points[:, 2] - (spec.area[2] + spec.area[5]) / 2
    own = _own_statistics(pillar, offset, up, points[:, 3], len(cells), torch)
    middle = torch.stack([cells % nx, cells // nx % ny], dim=1) * size + low[:2] + size / 2
    own[9:9] = [torch.linalg.vector_norm(middle, dim=1) / FAR_M, middle[:, 0] / FAR_M, middle[:, 1] / FAR_M]
    quarter = pillar * QUARTERS + (offset[:, 0] >= 0) + 2 * (offset[:, 1] >= 0)
    height = ((points[:, 2] - spec.area[2]) * (SLICES / (spec.area[5] - spec.area[2]))).long().clamp(max=SLICES - 1)
    slices = _sums(pillar * SLICES + height, torch.ones_like(up)[:, None], SLICES * len(cells), torch)
    table = torch.cat(
        [
            torch.stack(own, dim=1),
            _quarters(quarter, up, points[:, 3], len(cells), torch),
            torch.log1p(slices.reshape(len(cells), SLICES)),
        ],
        dim=1,
    )
    return table, cells


def _sums(index: Any, values: Any, size: int, torch: Any) -> Any:
    return torch.zeros(size, values.shape[1], device=values.device).index_add_(0, index, values)


def _highest(index: Any, values: Any, size: int, start: float, torch: Any, how: str = "amax") -> Any:
    return torch.full((size,), start, device=values.device).scatter_reduce_(0, index, values, how)


def _own_statistics(pillar: Any, offset: Any, up: Any, intensity: Any, count: int, torch: Any) -> list[Any]:
    """Columns of the pillars as wholes but for those of the centre."""
    dx, dy = offset[:, 0], offset[:, 1]
    values = torch.stack([torch.ones_like(up), dx, dy, up, up * up, intensity, dx * dx, dy * dy, dx * dy], dim=1)
    sums = _sums(pillar, values, count, torch)
    n = sums[:, 0]
    mean = sums[:, 1:] / n[:, None]
    spread_x = (mean[:, 5] - mean[:, 0] ** 2).clamp(min=0).sqrt()
    spread_y = (mean[:, 6] - mean[:, 1] ** 2).clamp(min=0).sqrt()
    return [
        torch.log1p(n),
        mean[:, 0],
        mean[:, 1],
        mean[:, 2],
        _highest(pillar, up, count, 1e9, torch, "amin"),
        _highest(pillar, up, count, -1e9, torch),
        (mean[:, 3] - mean[:, 2] ** 2).clamp(min=0).sqrt(),
        mean[:, 4],
        _highest(pillar, intensity, count, 0.0, torch),
        spread_x,
        spread_y,
        (mean[:, 7] - mean[:, 0] * mean[:, 1]) / (spread_x * spread_y + 1e-2),
    ]


def _quarters(index: Any, up: Any, intensity: Any, count: int, torch: Any) -> Any:
    """(Q, 16) statistics of the four quarters of each pillar."""
    sums = _sums(index, torch.stack([torch.ones_like(up), up, intensity], dim=1), QUARTERS * count, torch)
    n = sums[:, 0]
    highest = torch.where(n > 0, _highest(index, up, QUARTERS * count, -1e9, torch), 0.0)
    some = n.clamp(min=1)
    return torch.stack([torch.log1p(n), sums[:, 1] / some, highest, sums[:, 2] / some], dim=1).reshape(count, -1)


def targets_of(boxes: Any, labels: Any, config: LidarConfig) -> dict[str, Any]:
    """``heat``, ``counted``, ``cells`` and ``boxes`` of `lcf3d.training.lidar_targets.center_losses`.

    Args:
        boxes: (B, A, 7) of each scan.
        labels: (B, A) classes; -2 and -1 for objects that are ignored, below for rows without an object.
        config: of the network.
    """
    assert config.centers is not None
    torch, device = import_torch(), boxes.device
    nx, ny, _ = config.voxels.grid
    width, height = nx // config.centers.stride, ny // config.centers.stride
    step = boxes.new_tensor(config.voxels.size[:2]) * config.centers.stride
    places = (boxes[..., :2] - boxes.new_tensor(config.voxels.area[:2])) / step
    scans, classes = len(boxes), len(config.class_names)
    within = (places >= 0).all(-1) & (places[..., 0] < width) & (places[..., 1] < height)
    counted = _counted(boxes, places, labels, (scans, height, width), step, torch)
    image, row = torch.nonzero(within & (labels >= 0), as_tuple=True)
    boxes, labels, places = boxes[image, row], labels[image, row], places[image, row]
    heat = torch.zeros(scans * classes * height * width, device=device)
    sigma = (0.15 * torch.hypot(boxes[:, 3], boxes[:, 4]) / step[0]).clamp(min=HEAT_SIGMA)
    dr, dc = _stamp(HEAT_REACH, device, torch)
    r, c = places[:, 1].long()[:, None] + dr, places[:, 0].long()[:, None] + dc
    value = torch.exp(-(dr**2 + dc**2) / (2 * sigma[:, None] ** 2))
    ok = (r >= 0) & (r < height) & (c >= 0) & (c < width)
    index = ((image[:, None] * classes + labels[:, None]) * height + r) * width + c
    heat.scatter_reduce_(0, index[ok], value[ok], "amax")
    heat = heat.reshape(scans, classes, height, width)
    counted = torch.maximum(counted, (heat >= 1).any(1).float())
    cells, owners = _owned(places, image, (scans, height, width), torch)
    return {"heat": heat, "counted": counted, **_learned(cells, owners, boxes, places, (height, width), torch)}


def _stamp(reach: int, device: Any, torch: Any) -> tuple[Any, Any]:
    """Row and column offsets, (1, (2 reach + 1)^2) each."""
    steps = torch.arange(-reach, reach + 1, device=device)
    rows, columns = torch.meshgrid(steps, steps, indexing="ij")
    return rows.reshape(1, -1), columns.reshape(1, -1)


def _counted(boxes: Any, places: Any, labels: Any, shape: tuple[int, int, int], step: Any, torch: Any) -> Any:
    """(B, H, W) 0 in and next to ignored objects, else 1."""
    scans, height, width = shape
    image, row = torch.nonzero((labels == -1) | (labels == -2), as_tuple=True)
    boxes, places = boxes[image, row], places[image, row]
    dr, dc = _stamp(BLANK_REACH, boxes.device, torch)
    r, c = places[:, 1].floor().long()[:, None] + dr, places[:, 0].floor().long()[:, None] + dc
    dx, dy = c + 0.5 - places[:, :1], r + 0.5 - places[:, 1:]
    cos, sin = torch.cos(boxes[:, 6:7]), torch.sin(boxes[:, 6:7])
    covered = ((dx * cos + dy * sin).abs() <= boxes[:, 3:4] / step[0] / 2 + 1) & (
        (dy * cos - dx * sin).abs() <= boxes[:, 4:5] / step[1] / 2 + 1
    )
    ok = covered & (r >= 0) & (r < height) & (c >= 0) & (c < width)
    counted = torch.ones(scans * height * width, device=boxes.device)
    counted[((image[:, None] * height + r) * width + c)[ok]] = 0
    return counted.reshape(shape)


def _owned(places: Any, image: Any, shape: tuple[int, int, int], torch: Any) -> tuple[Any, Any]:
    """Flat cells that learn an object, and which; an object's own cell first, then the nearest centre."""
    scans, height, width = shape
    dr, dc = _stamp(AROUND, places.device, torch)
    r, c = places[:, 1].long()[:, None] + dr, places[:, 0].long()[:, None] + dc
    away = (r + 0.5 - places[:, 1:]) ** 2 + (c + 0.5 - places[:, :1]) ** 2
    # ties are broken by the object's number, so that every cell has one owner
    away = torch.where((dr == 0) & (dc == 0), -1.0, away) + 1e-6 * torch.arange(len(places), device=r.device)[:, None]
    ok = (r >= 0) & (r < height) & (c >= 0) & (c < width)
    index = ((image[:, None] * height + r) * width + c)[ok]
    owner = torch.arange(len(places), device=r.device)[:, None].expand_as(r)[ok]
    nearest = torch.full((scans * height * width,), math.inf, device=r.device)
    nearest.scatter_reduce_(0, index, away[ok], "amin")
    won = torch.nonzero(away[ok] <= nearest[index])[:, 0]
    return index[won], owner[won]


def _learned(cells: Any, owners: Any, boxes: Any, places: Any, size: tuple[int, int], torch: Any) -> dict[str, Any]:
    """What the cells learn, as `lcf3d.training.lidar_targets.BOX_CHANNELS` says."""
    height, width = size
    inside = cells % (height * width)
    own = boxes[owners]
    values = torch.zeros(len(cells), BOX_CHANNELS, device=boxes.device)
    values[:, 0] = places[owners, 0] - inside % width
    values[:, 1] = places[owners, 1] - inside // width
    values[:, 2] = own[:, 2]
    values[:, 3:6] = torch.log(own[:, 3:6])
    values[:, 6], values[:, 7] = torch.sin(own[:, 6]), torch.cos(own[:, 6])
    values[:, 8], values[:, 9] = torch.sin(2 * own[:, 6]), torch.cos(2 * own[:, 6])
    near = torch.exp(-((values[:, :2] - 0.5) ** 2).sum(1) / (2 * HEAT_SIGMA**2))
    total = torch.zeros(len(boxes), device=boxes.device).index_add_(0, owners, near)
    values[:, -1] = near / total[owners]
    return {"cells": cells, "boxes": values}

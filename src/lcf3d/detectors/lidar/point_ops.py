"""Operations on point sets: sampling, neighbours, interpolation (PointNet++, section 3).

On a CPU, sampling and neighbour search are loops compiled by numba, which stop as soon as they have enough; elsewhere
they are vectorised in torch. Both give the same indices.
"""

from __future__ import annotations

import numpy as np

from lcf3d.kernels import kernel
from lcf3d.networks.torch import Tensor, torch

CHUNK = 4_000_000
"""Pairwise distances computed at once."""


@kernel
def _farthest(points, count):  # type: ignore[no-untyped-def]
    distance = np.full(len(points), np.inf, np.float32)
    chosen = np.zeros(count, np.int64)
    for i in range(1, count):
        x, y, z = points[chosen[i - 1]]
        best, farthest = np.float32(-1), 0
        for j in range(len(points)):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            distance[j] = min(distance[j], dx * dx + dy * dy + dz * dz)
            if distance[j] > best:
                best, farthest = distance[j], j
        chosen[i] = farthest
    return chosen


@kernel
def _first_within(centers, points, squared_radius, count):  # type: ignore[no-untyped-def]
    found = np.full((len(centers), count), -1, np.int64)
    for i in range(len(centers)):
        x, y, z = centers[i]
        n = 0
        for j in range(len(points)):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            if dx * dx + dy * dy + dz * dz < squared_radius:
                found[i, n] = j
                n += 1
                if n == count:
                    break
        for k in range(n, count):
            found[i, k] = found[i, 0]
    return found


def farthest_point_sampling(points: Tensor, count: int) -> Tensor:
    """(count,) indices: first 0, then always the point farthest from those chosen.

    Of fewer points than ``count``, all are taken and then repeated from the first.

    Args:
        points: (N, 3), at least one.
        count: how many to choose.
    """
    distinct = min(count, len(points))
    if points.device.type == "cpu":
        chosen = torch.from_numpy(_farthest(_array(points), distinct))
    else:
        chosen = farthest_in_torch(points, distinct)
    return chosen.repeat(-(-count // distinct))[:count]


def farthest_in_torch(points: Tensor, count: int) -> Tensor:
    """(count,) indices of at most N farthest points, see `farthest_point_sampling`."""
    chosen = torch.zeros(count, dtype=torch.int64, device=points.device)
    distance = torch.full((len(points),), float("inf"), device=points.device)
    columns = points.t().contiguous()
    for i in range(1, count):
        last = columns[:, chosen[i - 1], None]
        distance = torch.minimum(distance, (columns - last).square_().sum(dim=0))
        chosen[i] = distance.argmax()
    return chosen


def _array(points: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    array: np.ndarray[tuple[int, ...], np.dtype[np.float32]] = points.detach().float().contiguous().numpy()
    return array


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """(M, N) squared distances of (M, 3) and (N, 3) points, by differences (a product would lose digits)."""
    result = (a[:, 0, None] - b[None, :, 0]).square_()
    for axis in (1, 2):
        result += (a[:, axis, None] - b[None, :, axis]).square_()
    return result


def ball_query(centers: Tensor, points: Tensor, radius: float, count: int) -> Tensor:
    """(M, count) indices of the first points within ``radius`` of each center, -1 in all places where there is none.

    Fewer points than ``count`` are filled up with the first of them.
    """
    if points.device.type == "cpu":
        squared = np.float32(radius) * np.float32(radius)
        return torch.from_numpy(_first_within(_array(centers), _array(points), squared, count))
    return ball_query_in_torch(centers, points, radius, count)


def ball_query_in_torch(centers: Tensor, points: Tensor, radius: float, count: int) -> Tensor:
    """(M, count) indices, see `ball_query`."""
    rows = max(1, CHUNK // max(1, len(points)))
    taken = min(count, len(points))
    order = torch.arange(len(points), device=points.device, dtype=torch.int32)
    parts = []
    for chunk in centers.split(rows):
        near = squared_distances(chunk, points) < radius**2
        first = torch.where(near, order, len(points)).topk(taken, dim=1, largest=False, sorted=True).values
        parts.append(torch.where(first < len(points), first, first[:, :1]))
    found = torch.cat(parts).long()
    found = torch.where(found < len(points), found, -1)
    if taken < count:
        found = torch.cat([found, found[:, :1].expand(-1, count - taken)], dim=1)
    return found


def three_nn_interpolation(targets: Tensor, sources: Tensor, features: Tensor) -> Tensor:
    """(M, C) features at ``targets``: of the three nearest sources, weighted by the inverse of their distance.

    Args:
        targets: (M, 3).
        sources: (N, 3), at least one.
        features: (N, C).
    """
    squared, nearest = squared_distances(targets, sources).topk(min(3, len(sources)), dim=1, largest=False)
    weights = 1 / (squared.clamp(min=0).sqrt() + 1e-8)
    weights = weights / weights.sum(dim=1, keepdim=True)
    return (features[nearest] * weights[..., None]).sum(dim=1)


def bilinear(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """(N, C) values of a (C, H, W) map at (N,) positions in cells, without half-cell shift.

    At the last row and column the weights of the original implementation vanish, and so do these.
    """
    _, height, width = image.shape
    x0, y0 = x.floor().long(), y.floor().long()
    x0, x1 = x0.clamp(0, width - 1), (x0 + 1).clamp(0, width - 1)
    y0, y1 = y0.clamp(0, height - 1), (y0 + 1).clamp(0, height - 1)
    rows = image.permute(1, 2, 0)
    left, right, top, bottom = x1 - x, x - x0, y1 - y, y - y0
    return (
        rows[y0, x0] * (left * top)[:, None]
        + rows[y1, x0] * (left * bottom)[:, None]
        + rows[y0, x1] * (right * top)[:, None]
        + rows[y1, x1] * (right * bottom)[:, None]
    )

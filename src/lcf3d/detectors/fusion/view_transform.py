"""From camera maps to bird's-eye view: lift, splat, with the depth of LiDAR points as a hint (BEVFusion, section 3).

Every cell of a camera's feature map becomes a ray of points, one for each of `DEPTHS`; a network says how likely the
surface is at each; the cell's features, weighted so, are summed up in the cells of the bird's-eye view.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lcf3d.networks.torch import Tensor, nn, torch

IMAGE_SHAPE = (256, 704)
"""Rows and columns of the network's images."""
FEATURE_SHAPE = (32, 88)
"""Rows and columns of the camera maps that are lifted."""
DEPTHS = (1.0, 60.0, 0.5)
"""First, end and step of the depths along a ray, in metres."""
DEPTH_COUNT = 118
LOWER = (-54.0, -54.0, -10.0)
"""Corner of the bird's-eye view, x, y, z in metres."""
CELL = (0.3, 0.3, 20.0)
"""Size of its cells in metres."""
GRID = (360, 360, 1)
"""Cells along x, y, z."""
CHANNELS = 80
"""Of what is lifted."""


def frustum() -> Tensor:
    """(118, 32, 88, 3) column, row and depth of the points of every ray, in pixels and metres."""
    depths = torch.arange(*DEPTHS)[:, None, None].expand(-1, *FEATURE_SHAPE)
    rows = torch.linspace(0, IMAGE_SHAPE[0] - 1, FEATURE_SHAPE[0])[None, :, None].expand_as(depths)
    columns = torch.linspace(0, IMAGE_SHAPE[1] - 1, FEATURE_SHAPE[1])[None, None, :].expand_as(depths)
    return torch.stack([columns, rows, depths], dim=-1)


def constants() -> dict[str, Tensor]:
    """What checkpoints hold of the geometry, by name: cell size, first cell's centre, number of cells, `frustum`."""
    size = torch.tensor(CELL)
    return {"dx": size, "bx": torch.tensor(LOWER) + size / 2, "nx": torch.tensor(GRID), "frustum": frustum()}


def ray_points(image_from_camera: Tensor, lidar_from_camera: Tensor, resize: Tensor) -> Tensor:
    """(N, 118, 32, 88, 3) positions of all points of the rays of N cameras.

    Args:
        image_from_camera: (N, 3, 3) camera matrices of the original images.
        lidar_from_camera: (N, 4, 4).
        resize: (N, 3) scale, then column and row by which the network's image lies right of and below the original's.
    """
    points = frustum().to(resize.device)
    cameras = []
    turns = lidar_from_camera[:, :3, :3] @ torch.inverse(image_from_camera)
    for turn, origin, placed in zip(turns, lidar_from_camera[:, :3, 3], resize, strict=True):
        u, v = ((points[..., i] + placed[1 + i]) * (1 / placed[0]) * points[..., 2] for i in range(2))
        turned = u[..., None] * turn[:, 0] + v[..., None] * turn[:, 1] + points[..., 2:] * turn[:, 2]
        cameras.append(turned + origin)
    return torch.stack(cameras)


def bev_cells(points: Tensor) -> Tensor:
    """(...) int64 flat cell ``x * 360 + y`` of each of the (..., 3) points, -1 outside of the bird's-eye view.

    Positions are truncated toward zero, so that the first cell of an axis reaches one cell further out, as in training.
    """
    fixed = constants()
    size = fixed["dx"].to(points)
    cells = ((points - (fixed["bx"].to(points) - size / 2)) / size).long()
    inside = ((cells >= 0) & (cells < torch.tensor(GRID, device=points.device))).all(dim=-1)
    return torch.where(inside, cells[..., 0] * GRID[1] + cells[..., 1], -1)


def bev_pool(depth: Tensor, features: Tensor, cells: Tensor) -> Tensor:
    """(1, C, 360, 360) sums of features over the points that fall into each cell; rows are x, columns y.

    The points are never built: what reaches a cell from a pixel is its features times the sum of the weights of its
    points there, which is a sparse matrix times the features of all pixels.

    Args:
        depth: (N, D, h, w) weight of every point of every ray.
        features: (N, C, h, w) of every pixel.
        cells: (N, D, h, w) of `bev_cells`.
    """
    n, _, height, width = depth.shape
    pixels = torch.arange(n * height * width, device=depth.device).reshape(n, 1, height, width).expand_as(cells)
    inside = cells >= 0
    weights = torch.sparse_coo_tensor(
        torch.stack([cells[inside], pixels[inside]]),
        depth[inside],
        (GRID[0] * GRID[1], n * height * width),
        check_invariants=False,
    )
    flat = features.permute(0, 2, 3, 1).reshape(n * height * width, -1)
    return torch.sparse.mm(weights, flat).t().reshape(1, -1, *GRID[:2])


def depth_map(
    points: NDArray[np.float32], image_from_lidar: NDArray[np.float32], resize: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(1, 256, 704) depth of the LiDAR point at each pixel of the network's image, 0 without one; the last one counts.

    In single precision and term by term, as in training: a point on the border of two pixels falls into the same one.

    Args:
        points: (P, 3 or more).
        image_from_lidar: (3 or 4, 4) homogeneous pixels of the original image.
        resize: (3,) see `ray_points`.
    """
    x, y, z = (points[:, i : i + 1] for i in range(3))
    turn, origin = image_from_lidar[:3, :3].T, image_from_lidar[:3, 3]
    homogeneous = x * turn[0] + y * turn[1] + z * turn[2] + origin
    depth = homogeneous[:, 2]
    pixels = homogeneous[:, :2] / np.clip(depth, 1e-5, 1e5)[:, None] * resize[0] - resize[1:]
    inside = ((pixels >= 0) & (pixels < (IMAGE_SHAPE[1], IMAGE_SHAPE[0]))).all(axis=1)
    columns, rows = pixels[inside].astype(np.int64).T
    result = np.zeros((1, *IMAGE_SHAPE), np.float32)
    result[0, rows, columns] = depth[inside]
    return result


def _blocks(convolutions: list[nn.Module]) -> Iterator[nn.Module]:
    """Each convolution with its normalization and ReLU."""
    for convolution in convolutions:
        yield from (convolution, nn.BatchNorm2d(convolution.out_channels), nn.ReLU())


class DepthViewTransform(nn.Module):
    """Depths of rays from camera features and LiDAR depths, then `bev_pool`, then half the resolution."""

    def __init__(self, in_channels: int = 256) -> None:
        super().__init__()
        hints = [nn.Conv2d(1, 8, 1), nn.Conv2d(8, 32, 5, 4, 2), nn.Conv2d(32, 64, 5, 2, 2)]
        self.dtransform = nn.Sequential(*_blocks(hints))
        mixing = [nn.Conv2d(in_channels + 64, 256, 3, padding=1), nn.Conv2d(256, 256, 3, padding=1)]
        self.depthnet = nn.Sequential(*_blocks(mixing), nn.Conv2d(256, DEPTH_COUNT + CHANNELS, 1))
        reducing = [nn.Conv2d(CHANNELS, CHANNELS, 3, stride, 1, bias=False) for stride in (1, 2, 1)]
        self.downsample = nn.Sequential(*_blocks(reducing))

    def forward(self, maps: Tensor, depths: Tensor, cells: Tensor) -> Tensor:
        """(1, 80, 180, 180) bird's-eye view; rows are x, columns y.

        Args:
            maps: (N, in, 32, 88) of N cameras.
            depths: (N, 1, 256, 704) of `depth_map`.
            cells: (N, 118, 32, 88) of `bev_cells`.
        """
        mixed = self.depthnet(torch.cat([self.dtransform(depths), maps], dim=1))
        weights = mixed[:, :DEPTH_COUNT].softmax(dim=1)
        return self.downsample(bev_pool(weights, mixed[:, DEPTH_COUNT:], cells))

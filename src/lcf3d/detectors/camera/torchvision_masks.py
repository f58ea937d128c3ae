"""The mask head of Mask R-CNN (He et al., ICCV 2017) by the names of OpenMMLab's checkpoints, and masks as pixels."""

# mypy: allow-subclassing-any
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lcf3d.networks.torch import Tensor, functional, nn
from lcf3d.structures import FloatArray, InstanceMask

THRESHOLD = 0.5


class _Named(nn.Module):
    """A 3 x 3 convolution under the name ``conv``."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(256, 256, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, 256, H, W) -> the same shape, rectified."""
        return functional.relu(self.conv(x))


class MaskHead(nn.Module):
    """Four convolutions, a doubling of the grid, and a mask of every class."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.convs = nn.ModuleList([_Named() for _ in range(4)])
        self.upsample = nn.ConvTranspose2d(256, 256, 2, stride=2)
        self.conv_logits = nn.Conv2d(256, classes, 1)

    def forward(self, pooled: Tensor) -> Tensor:
        """(D, K, 28, 28) logits of (D, 256, 14, 14) features."""
        for conv in self.convs:
            pooled = conv(pooled)
        return self.conv_logits(functional.relu(self.upsample(pooled)))


def instance_masks(cells: NDArray[np.floating], boxes: FloatArray, height: int, width: int) -> tuple[InstanceMask, ...]:
    """The pixels of each object: where the probabilities of its box, interpolated to pixel centres, reach a half.

    Args:
        cells: (D, N, N) probabilities on a grid over each box.
        boxes: (D, 4) pixel boxes of the image.
        height: of the image, in pixels.
        width: of the image.
    """
    masks = []
    for values, (x1, y1, x2, y2) in zip(cells, boxes, strict=True):
        left, top = max(int(np.floor(x1)), 0), max(int(np.floor(y1)), 0)
        right, bottom = min(int(np.ceil(x2)), width), min(int(np.ceil(y2)), height)
        columns = (np.arange(left, right) + 0.5 - x1) / max(x2 - x1, 1e-6) * values.shape[1] - 0.5
        rows = (np.arange(top, bottom) + 0.5 - y1) / max(y2 - y1, 1e-6) * values.shape[0] - 0.5
        inside = _interpolated(values.astype(np.float64), rows, columns) >= THRESHOLD
        masks.append(InstanceMask(left, top, inside))
    return tuple(masks)


def _interpolated(values: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
    """(R, C) bilinear values of an (N, N) grid at rows and columns in cells; zero beyond the grid, as the original."""
    padded = np.pad(values, 1)
    result: FloatArray = _weights(rows, values.shape[0]) @ padded @ _weights(columns, values.shape[1]).T
    return result


def _weights(positions: FloatArray, count: int) -> FloatArray:
    """(P, count + 2) share of each cell of a grid with a border in each of (P,) positions."""
    cells = np.arange(-1, count + 1)
    shares: FloatArray = np.maximum(1 - np.abs(positions[:, None] - cells[None]), 0)
    return shares

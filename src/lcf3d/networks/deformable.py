"""Deformable attention and position encodings of detection transformers (Zhu et al., "Deformable DETR", ICLR 2021)."""

# mypy: allow-subclassing-any
from __future__ import annotations

import math
from collections.abc import Sequence

from lcf3d.networks.torch import Tensor, functional, nn, torch


class DeformableAttention(nn.Module):
    """Every query looks at a few places of every level, which it chooses itself (section 4.1); added to its input.

    Args:
        channels: of queries and values.
        heads: number of heads.
        levels: number of maps.
        points: places a head looks at in each map.
    """

    def __init__(self, channels: int, heads: int, levels: int, points: int) -> None:
        super().__init__()
        self.heads, self.levels, self.points = heads, levels, points
        self.sampling_offsets = nn.Linear(channels, heads * levels * points * 2)
        self.attention_weights = nn.Linear(channels, heads * levels * points)
        self.value_proj = nn.Linear(channels, channels)
        self.output_proj = nn.Linear(channels, channels)

    def forward(
        self, x: Tensor, position: Tensor, values: Tensor, references: Tensor, shapes: Sequence[tuple[int, int]]
    ) -> Tensor:
        """(Q, C) ``x`` plus what it gathers.

        Args:
            x: (Q, C) queries.
            position: (Q, C) their position, which helps to choose places and weights.
            values: (S, C) cells of all levels, row by row, level after level.
            references: (Q, 2) points or (Q, 4) boxes ``cx cy w h`` around which to look, in parts of the image.
            shapes: rows and columns of each level.
        """
        query = x + position
        # heads, query, level, point
        offsets = self.sampling_offsets(query).reshape(-1, self.heads, self.levels, self.points, 2).transpose(0, 1)
        weights = self.attention_weights(query).reshape(-1, self.heads, self.levels * self.points).transpose(0, 1)
        weights = weights.softmax(dim=-1).reshape(offsets.shape[:-1])
        center = references[None, :, None, :2]
        cells = self.value_proj(values).split([height * width for height, width in shapes])
        gathered = []
        for level, (height, width) in enumerate(shapes):
            if references.shape[1] == 2:
                step = offsets[:, :, level] / offsets.new_tensor([width, height])
            else:
                step = offsets[:, :, level] / self.points * references[None, :, None, 2:] * 0.5
            maps = cells[level].t().reshape(self.heads, -1, height, width)
            sampled = functional.grid_sample(maps, 2 * (center + step) - 1, align_corners=False)
            gathered.append((sampled * weights[:, None, :, level]).sum(dim=-1))
        return x + self.output_proj(sum(gathered[1:], gathered[0]).flatten(0, 1).t())


def sine_encoding(values: Tensor, channels: int, temperature: float) -> Tensor:
    """(..., channels) sines and cosines, in turn, of (...) angles at ever lower frequencies."""
    exponent = torch.arange(channels, device=values.device) // 2 * 2 / channels
    angles = values[..., None] / temperature**exponent
    return torch.stack([angles[..., 0::2].sin(), angles[..., 1::2].cos()], dim=-1).flatten(-2)


def map_positions(height: int, width: int, channels: int, temperature: float, like: Tensor) -> Tensor:
    """(H W, channels) encoding of the row, then of the column of every cell."""
    rows = (torch.arange(height, device=like.device, dtype=like.dtype) + 1) / (height + 1e-6) * (2 * math.pi)
    columns = (torch.arange(width, device=like.device, dtype=like.dtype) + 1) / (width + 1e-6) * (2 * math.pi)
    y = sine_encoding(rows, channels // 2, temperature)[:, None].expand(-1, width, -1)
    x = sine_encoding(columns, channels // 2, temperature)[None].expand(height, -1, -1)
    return torch.cat([y, x], dim=-1).flatten(0, 1)


def box_positions(boxes: Tensor, channels: int) -> Tensor:
    """(N, 2 channels) encoding of (N, 4) boxes ``cx cy w h`` in parts of the image, in the order y, x, w, h."""
    return sine_encoding(boxes[:, [1, 0, 2, 3]] * (2 * math.pi), channels // 2, 10000.0).flatten(1)


def inverse_sigmoid(x: Tensor, eps: float) -> Tensor:
    """Logits of probabilities, neither of which nor of their complements is taken to be below ``eps``."""
    x = x.clamp(0, 1)
    return torch.log(x.clamp(min=eps) / (1 - x).clamp(min=eps))

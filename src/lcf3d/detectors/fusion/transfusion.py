"""The query head of TransFusion (Bai et al., CVPR 2022) as BEVFusion uses it: peaks of a heat map become boxes."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.decoding import sigmoid
from lcf3d.networks.attention import Attention, FeedForward
from lcf3d.networks.convolution import ConvModule
from lcf3d.networks.torch import Tensor, functional, nn, torch
from lcf3d.structures import FloatArray, IntArray

QUERIES = 200
SMALL_CLASSES = (8, 9)
"""Classes (pedestrian, traffic cone) whose objects are no larger than a cell: each cell may become a query."""
VALUES = {"center": 2, "height": 1, "dim": 3, "rot": 2, "vel": 2}
"""Channels of the predicted values by name."""
CELL_M = 0.6
LOWER_M = -54.0
LIMITS = (-61.2, -61.2, -10.0, 61.2, 61.2, 10.0)
"""Lower, then upper corner that bottom centres of kept boxes lie in, in metres."""


class PositionEmbedding(nn.Module):
    """Two layers on a position."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.position_embedding_head = nn.Sequential(
            nn.Conv1d(2, channels, 1), nn.BatchNorm1d(channels), nn.ReLU(), nn.Conv1d(channels, channels, 1)
        )

    def forward(self, positions: Tensor) -> Tensor:
        """(N, P, C) of (N, P, 2) positions in cells."""
        return self.position_embedding_head(positions.transpose(1, 2)).transpose(1, 2)


class DecoderLayer(nn.Module):
    """Attention among queries, then to the map, then two linear layers, each normalized afterwards.

    Unlike in other transformers, the values have their position added too.
    """

    def __init__(self, channels: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.self_attn = Attention(channels, heads)
        self.cross_attn = Attention(channels, heads)
        self.ffn = FeedForward(channels, hidden, nn.ReLU())
        self.norms = nn.ModuleList([nn.LayerNorm(channels) for _ in range(3)])
        self.self_posembed = PositionEmbedding(channels)
        self.cross_posembed = PositionEmbedding(channels)

    def forward(self, queries: Tensor, keys: Tensor, query_positions: Tensor, key_positions: Tensor) -> Tensor:
        """(N, Q, C) queries after looking at one another and at the (N, K, C) keys; positions are (N, Q or K, 2)."""
        place = self.self_posembed(query_positions)
        placed = queries + place
        queries = self.norms[0](self.self_attn(queries, placed, placed, placed))
        keys = keys + self.cross_posembed(key_positions)
        queries = self.norms[1](self.cross_attn(queries, queries + place, keys, keys))
        return self.norms[2](self.ffn(queries))


class _Layer(nn.Module):
    """A 1 x 1 convolution with normalization and ReLU on queries."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(in_channels, out_channels, 1, bias=False)
        self.bn = nn.BatchNorm1d(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, Q) -> (N, out, Q)."""
        return functional.relu(self.bn(self.conv(x)))


class PredictionHeads(nn.Module):
    """Two layers to each value of the queries."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        for name, count in {**VALUES, "heatmap": classes}.items():
            self.add_module(name, nn.Sequential(_Layer(channels, 64), nn.Conv1d(64, count, 1)))

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """(N, C, Q) -> by name (N, channels, Q)."""
        return {name: module(x) for name, module in self.named_children()}


class TransFusionHead(nn.Module):
    """Heat map, queries at its peaks, a decoder layer, and their boxes (sections 3.1 and 3.2 of TransFusion)."""

    def __init__(self, in_channels: int, classes: int, channels: int = 128) -> None:
        super().__init__()
        self.classes = classes
        self.shared_conv = nn.Conv2d(in_channels, channels, 3, padding=1)
        self.heatmap_head = nn.Sequential(
            ConvModule(channels, channels, 3, eps=1e-5), nn.Conv2d(channels, classes, 3, padding=1)
        )
        self.class_encoding = nn.Conv1d(classes, channels, 1)
        self.decoder = nn.ModuleList([DecoderLayer(channels, heads=8, hidden=256)])
        self.prediction_heads = nn.ModuleList([PredictionHeads(channels, classes)])

    def forward(self, bev: Tensor) -> dict[str, Tensor]:
        """What `predict` returns for the peaks that `select` chooses, from an (1, in, H, W) map."""
        shared = self.shared_conv(bev)
        peaks = local_maxima(self.heatmap_head(shared).sigmoid())
        return self.predict(shared, peaks, select(peaks))

    def predict(self, shared: Tensor, peaks: Tensor, selection: Tensor) -> dict[str, Tensor]:
        """Values of the queries by name (Q, channels), ``heatmap`` (Q, K), their ``label`` and the peak's ``score``.

        Args:
            shared: (1, C, H, W) map.
            peaks: (1, K, H, W) of `local_maxima`.
            selection: (Q,) int64 of `select`.
        """
        height, width = shared.shape[-2:]
        label, cell = selection // (height * width), selection % (height * width)
        keys = shared.flatten(2).transpose(1, 2)
        places = cell_centers(height, width).to(shared)[None]
        one_hot = functional.one_hot(label, self.classes).to(shared).t()[None]
        queries = keys[:, cell] + self.class_encoding(one_hot).transpose(1, 2)
        decoded = self.decoder[0](queries, keys, places[:, cell], places).transpose(1, 2)
        values = {name: value[0].t() for name, value in self.prediction_heads[0](decoded).items()}
        values["center"] = values["center"] + places[0, cell]
        return {**values, "label": label, "score": peaks[0].flatten(1)[label, cell]}


def cell_centers(height: int, width: int) -> Tensor:
    """(H W, 2) centres of the cells of a map, row then column, in cells."""
    return torch.cartesian_prod(torch.arange(height) + 0.5, torch.arange(width) + 0.5)


def local_maxima(heat: Tensor) -> Tensor:
    """The (1, K, H, W) heat map with zero wherever a neighbour is higher, and on its border.

    The `SMALL_CLASSES` keep all their cells.
    """
    highest = functional.pad(functional.max_pool2d(heat, 3, 1), (1, 1, 1, 1))
    highest[:, SMALL_CLASSES] = heat[:, SMALL_CLASSES]
    return heat * (heat == highest)


def select(peaks: Tensor) -> Tensor:
    """(200,) int64 flat index, class by class, of the highest values of a (1, K, H, W) map, best first."""
    return peaks.flatten().topk(QUERIES).indices


def decode_queries(
    values: Mapping[str, NDArray[np.floating]], score_threshold: float = 0.0
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Boxes (N, 9) ``x y z l w h yaw vx vy`` with z at the bottom face, scores and labels of queries.

    Args:
        values: of `TransFusionHead.predict`.
        score_threshold: boxes need a higher score.
    """
    label = values["label"].astype(np.int64)
    scores = sigmoid(values["heatmap"])[np.arange(len(label)), label] * values["score"]
    boxes = np.empty((len(label), 9))
    boxes[:, :2] = values["center"].astype(np.float64) * CELL_M + LOWER_M
    boxes[:, 3:6] = np.exp(np.minimum(values["dim"].astype(np.float64), 88.0))
    boxes[:, 2] = values["height"][:, 0] - boxes[:, 5] / 2
    boxes[:, 6] = np.arctan2(values["rot"][:, 0], values["rot"][:, 1])
    boxes[:, 7:] = values["vel"]
    inside = ((boxes[:, :3] >= LIMITS[:3]) & (boxes[:, :3] <= LIMITS[3:])).all(axis=1)
    kept = inside & (scores > score_threshold)
    return boxes[kept], scores[kept], label[kept]

"""DDQ-DETR (Zhang et al., "Dense Distinct Query for End-to-End Object Detection", CVPR 2023).

Every cell proposes a box, near-copies are suppressed before each layer of the decoder, and nothing is suppressed at the
end. The forms are OpenMMLab's ``ddq-detr-4scale_r50_8xb2-12e_coco`` and ``ddq-detr-4scale_swinl_8xb2-30e_coco``, whose
checkpoints load, with 80 classes or others.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lcf3d.detectors.camera.checkpoint_detector import CheckpointDetector
from lcf3d.networks.attention import Attention, FeedForward
from lcf3d.networks.deformable import DeformableAttention, box_positions, inverse_sigmoid, map_positions
from lcf3d.networks.resnet import ResNet
from lcf3d.networks.swin import SwinTransformer
from lcf3d.networks.torch import Tensor, nn, torch, torchvision
from lcf3d.structures import FloatArray, IntArray

CHANNELS, HEADS, LEVELS, POINTS, HIDDEN, LAYERS = 256, 8, 4, 4, 2048, 6
QUERIES = 900
DISTINCT_IOU = 0.8
"""Of two queries whose boxes overlap by more, the one with the lower score is no distinct one."""
MAX_BOXES = 300
_TRAINING_ONLY = ("bbox_head.aux_", "bbox_head.cls_branches.7.", "bbox_head.reg_branches.7.", "dn_query_generator.")


class _Normed(nn.Module):
    """A convolution and group normalization under the names ``conv`` and ``gn``."""

    def __init__(self, in_channels: int, kernel: int, stride: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, CHANNELS, kernel, stride, kernel // 2, bias=False)
        self.gn = nn.GroupNorm(32, CHANNELS)

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, 256, H / stride, W / stride)."""
        return self.gn(self.conv(x))


class Neck(nn.Module):
    """Every map in 256 channels, and one more of half the resolution."""

    def __init__(self, in_channels: Sequence[int]) -> None:
        super().__init__()
        self.convs = nn.ModuleList([_Normed(count, 1, 1) for count in in_channels])
        self.extra_convs = nn.ModuleList([_Normed(in_channels[-1], 3, 2)])

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """One map more than came in."""
        return [*(conv(x) for conv, x in zip(self.convs, maps, strict=True)), self.extra_convs[0](maps[-1])]


class EncoderLayer(nn.Module):
    """Deformable attention among the cells of all levels, and two linear layers."""

    def __init__(self) -> None:
        super().__init__()
        self.self_attn = DeformableAttention(CHANNELS, HEADS, LEVELS, POINTS)
        self.ffn = FeedForward(CHANNELS, HIDDEN, nn.ReLU())
        self.norms = nn.ModuleList([nn.LayerNorm(CHANNELS) for _ in range(2)])

    def forward(self, x: Tensor, positions: Tensor, centers: Tensor, shapes: Sequence[tuple[int, int]]) -> Tensor:
        """(S, 256) cells, their (S, 256) positions and (S, 2) centres -> (S, 256)."""
        x = self.norms[0](self.self_attn(x, positions, x, centers, shapes))
        return self.norms[1](self.ffn(x))


class DecoderLayer(nn.Module):
    """Attention among queries, deformable attention to the cells, and two linear layers."""

    def __init__(self) -> None:
        super().__init__()
        self.self_attn = Attention(CHANNELS, HEADS)
        self.cross_attn = DeformableAttention(CHANNELS, HEADS, LEVELS, POINTS)
        self.ffn = FeedForward(CHANNELS, HIDDEN, nn.ReLU())
        self.norms = nn.ModuleList([nn.LayerNorm(CHANNELS) for _ in range(3)])

    def forward(
        self,
        x: Tensor,
        positions: Tensor,
        memory: Tensor,
        boxes: Tensor,
        shapes: Sequence[tuple[int, int]],
        apart: Tensor | None,
    ) -> Tensor:
        """(Q, 256) queries at (Q, 4) boxes; the (Q, Q) bool ``apart`` says which do not see one another."""
        placed = (x + positions)[None]
        x = self.norms[0](self.self_attn(x[None], placed, placed, x[None], apart)[0])
        x = self.norms[1](self.cross_attn(x, positions, memory, boxes, shapes))
        return self.norms[2](self.ffn(x))


class _Stack(nn.Module):
    """Layers under the name ``layers``."""

    def __init__(self, layers: Sequence[nn.Module]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(layers)


class _Decoder(_Stack):
    """The decoder's parameters."""

    def __init__(self) -> None:
        super().__init__([DecoderLayer() for _ in range(LAYERS)])
        self.ref_point_head = _Stack([nn.Linear(2 * CHANNELS, CHANNELS), nn.Linear(CHANNELS, CHANNELS)])
        self.norm = nn.LayerNorm(CHANNELS)


class _Head(nn.Module):
    """Class logits and box residuals: branches 0 to 5 for the layers of the decoder, 6 for the cells."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.cls_branches = nn.ModuleList([nn.Linear(CHANNELS, classes) for _ in range(LAYERS + 1)])
        self.reg_branches = nn.ModuleList([_box_branch() for _ in range(LAYERS + 1)])


def _box_branch() -> nn.Module:
    hidden = [nn.Linear(CHANNELS, CHANNELS), nn.ReLU(), nn.Linear(CHANNELS, CHANNELS), nn.ReLU()]
    return nn.Sequential(*hidden, nn.Linear(CHANNELS, 4))


class Decoded(NamedTuple):
    """What the decoder makes of the queries.

    Attributes:
        states: (Q, 256) normalized queries after each layer.
        references: (Q, 4) boxes ``cx cy w h`` in parts of the image that entered each layer, and the last ones.
        distinct: (Q,) bool queries found distinct after each layer but the last.
        candidates: (Q,) bool queries that may become detections.
    """

    states: list[Tensor]
    references: list[Tensor]
    distinct: list[Tensor]
    candidates: Tensor


class DDQNetwork(nn.Module):
    """The whole network, for one image at a time."""

    def __init__(self, swin: bool, classes: int) -> None:
        super().__init__()
        self.swin = swin
        if swin:
            self.backbone = SwinTransformer(192, (2, 2, 18, 2), (6, 12, 24, 48), window=12, outputs=(1, 2, 3))
        else:
            self.backbone = ResNet(50, caffe=False)
        self.neck = Neck((384, 768, 1536) if swin else (512, 1024, 2048))
        self.level_embed = nn.Parameter(torch.zeros(LEVELS, CHANNELS))
        self.encoder = _Stack([EncoderLayer() for _ in range(LAYERS)])
        self.memory_trans_fc = nn.Linear(CHANNELS, CHANNELS)
        self.memory_trans_norm = nn.LayerNorm(CHANNELS)
        self.query_map = nn.Linear(CHANNELS, CHANNELS)
        self.decoder = _Decoder()
        self.bbox_head = _Head(classes)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(N, K) scores and (N, 4) boxes ``cx cy w h`` in parts of the image, from a (1, 3, H, W) image."""
        memory, shapes = self.encode(image)
        logits, boxes = self.propose(memory, shapes)
        chosen = distinct_boxes(boxes, logits.max(dim=1).values.sigmoid())[:QUERIES]
        decoded = self.decode(self.query_map(memory)[chosen], boxes[chosen], memory, shapes)
        scores, final = self.predict(decoded, LAYERS - 1)
        return scores[decoded.candidates].sigmoid(), final[decoded.candidates]

    def encode(self, image: Tensor) -> tuple[Tensor, list[tuple[int, int]]]:
        """(S, 256) cells of all levels after the encoder, and rows and columns of each level."""
        maps = self.backbone(image)
        maps = self.neck(maps if self.swin else maps[1:])
        shapes = [(x.shape[2], x.shape[3]) for x in maps]
        x = torch.cat([level[0].flatten(1).t() for level in maps])
        positions = torch.cat(
            [
                map_positions(*shape, CHANNELS, 20.0, x) + embedding
                for shape, embedding in zip(shapes, self.level_embed, strict=True)
            ]
        )
        centers = cell_boxes(shapes, x)[:, :2]
        for layer in self.encoder.layers:
            x = layer(x, positions, centers, shapes)
        return x, shapes

    def propose(self, memory: Tensor, shapes: Sequence[tuple[int, int]]) -> tuple[Tensor, Tensor]:
        """(S, K) class logits and (S, 4) boxes of every cell; those near the border are of no use."""
        cells = cell_boxes(shapes, memory)
        useful = ((cells > 0.01) & (cells < 0.99)).all(dim=1, keepdim=True)
        start = torch.log(cells / (1 - cells)).masked_fill(~useful, float("inf"))
        hidden = self.memory_trans_norm(self.memory_trans_fc(memory * useful))
        residuals = self.bbox_head.reg_branches[LAYERS](hidden)
        return self.bbox_head.cls_branches[LAYERS](hidden), (residuals + start).sigmoid()

    def decode(
        self,
        queries: Tensor,
        boxes: Tensor,
        memory: Tensor,
        shapes: Sequence[tuple[int, int]],
        distinct: Sequence[Tensor] | None = None,
    ) -> Decoded:
        """The queries after each layer of the decoder.

        Args:
            queries: (Q, 256).
            boxes: (Q, 4) where they start.
            memory: (S, 256) cells.
            shapes: of the levels.
            distinct: (Q,) bool after each layer but the last, instead of the network's own.
        """
        candidates = torch.ones(len(queries), dtype=torch.bool, device=queries.device)
        decoded = Decoded([], [boxes], [], candidates)
        apart = None
        hidden, place = self.decoder.ref_point_head.layers
        for i, layer in enumerate(self.decoder.layers):
            positions = place(hidden(box_positions(boxes, CHANNELS)).relu())
            queries = layer(queries, positions, memory, boxes, shapes, apart)
            residuals = self.bbox_head.reg_branches[i](queries)
            boxes = (residuals + inverse_sigmoid(boxes, 1e-3)).sigmoid()
            decoded.states.append(self.decoder.norm(queries))
            decoded.references.append(boxes)
            if i == LAYERS - 1:
                break
            if distinct is None:
                scores = self.bbox_head.cls_branches[i](queries).max(dim=1).values.sigmoid()
                index = candidates.nonzero()[:, 0]
                kept = torch.zeros_like(candidates)
                kept[index[distinct_boxes(boxes[index], scores[index])]] = True
            else:
                kept = distinct[i]
            decoded.distinct.append(kept)
            apart = ~(kept[:, None] | kept[None])
            # as in the original: all are candidates again when the first query is distinct
            candidates = ~apart[0]
        return decoded._replace(candidates=candidates)

    def predict(self, decoded: Decoded, layer: int) -> tuple[Tensor, Tensor]:
        """(Q, K) class logits and (Q, 4) boxes after a layer of the decoder."""
        state = decoded.states[layer]
        start = inverse_sigmoid(decoded.references[layer], 1e-5)
        boxes = (self.bbox_head.reg_branches[layer](state) + start).sigmoid()
        return self.bbox_head.cls_branches[layer](state), boxes


def cell_boxes(shapes: Sequence[tuple[int, int]], like: Tensor) -> Tensor:
    """(S, 4) a box ``cx cy w h`` around the centre of each cell of all levels, twice as large from level to level."""
    levels = []
    for level, (height, width) in enumerate(shapes):
        rows = (torch.arange(height, device=like.device) + 0.5) / height
        columns = (torch.arange(width, device=like.device) + 0.5) / width
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        size = torch.full_like(x, 0.05 * 2**level)
        levels.append(torch.stack([x, y, size, size], dim=-1).flatten(0, 1))
    return torch.cat(levels)


def corners(boxes: Tensor) -> Tensor:
    """(N, 4) ``x1 y1 x2 y2`` of boxes ``cx cy w h``."""
    return torch.cat([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], dim=1)


def distinct_boxes(boxes: Tensor, scores: Tensor) -> Tensor:
    """Indices of the (N, 4) boxes ``cx cy w h`` that overlap no better one by more than `DISTINCT_IOU`, best first."""
    kept: Tensor = torchvision().ops.nms(corners(boxes), scores, DISTINCT_IOU)
    return kept


class DDQDetector(CheckpointDetector):
    """DDQ-DETR with ResNet-50 or Swin-L; see `CheckpointDetector` for its settings."""

    name = "DDQ-DETR"
    marks = ("bbox_head.cls_branches.0.weight", "query_map.weight")

    @classmethod
    def build(cls, state: Mapping[str, Any]) -> nn.Module:
        """The network that a checkpoint is for."""
        return DDQNetwork("backbone.patch_embed.projection.weight" in state, cls.class_count(state))

    @classmethod
    def class_count(cls, state: Mapping[str, Any]) -> int:
        """Number of a checkpoint's classes."""
        return len(state[cls.marks[0]])

    @classmethod
    def own_parameters(cls, state: Mapping[str, Any]) -> dict[str, Any]:
        """Without those that only training needs, and without constants."""
        return {
            name: value
            for name, value in state.items()
            if not name.startswith(_TRAINING_ONLY) and not name.endswith("relative_position_index")
        }

    def find(self, image: Tensor, width: int, height: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """The best pairs of a query and a class; see `CheckpointDetector.find`."""
        scores, boxes = self.network(image)
        return best_pairs(scores, boxes, width, height)


def best_pairs(scores: Tensor, boxes: Tensor, width: int, height: int) -> tuple[FloatArray, FloatArray, IntArray]:
    """Boxes in pixels, scores and labels of the best pairs of a query and a class, at most `MAX_BOXES`.

    Args:
        scores: (N, K).
        boxes: (N, 4) ``cx cy w h`` in parts of the image.
        width: of the image in pixels.
        height: likewise.
    """
    best = scores.flatten().topk(min(MAX_BOXES, scores.numel()))
    pixels = corners(boxes[best.indices // scores.shape[1]]).cpu().numpy() * np.tile([width, height], 2)
    labels: IntArray = (best.indices % scores.shape[1]).cpu().numpy()
    return np.clip(pixels, 0, np.tile([width, height], 2)), best.values.cpu().numpy(), labels

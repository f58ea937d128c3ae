"""DDQ-DETR (Zhang et al., "Dense Distinct Query for End-to-End Object Detection", CVPR 2023).

Every cell proposes a box, near-copies are suppressed before each layer of the decoder, and nothing is suppressed at the
end. The forms are OpenMMLab's ``ddq-detr-4scale_r50_8xb2-12e_coco`` and ``ddq-detr-4scale_swinl_8xb2-30e_coco``, whose
checkpoints load, with 80 classes or others.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lcf3d.detectors.base import Image
from lcf3d.detectors.classes import COCO_CLASSES, to_classes
from lcf3d.detectors.resizing import fitted_size, resize_bilinear
from lcf3d.errors import ConfigError, DetectorError, ShapeError
from lcf3d.networks.attention import Attention, FeedForward
from lcf3d.networks.checkpoints import load_parameters, read_state_dict
from lcf3d.networks.deformable import (
    DeformableAttention,
    box_positions,
    inverse_sigmoid,
    map_positions,
)
from lcf3d.networks.resnet import ResNet
from lcf3d.networks.swin import SwinTransformer
from lcf3d.networks.torch import Tensor, nn, torch, torch_device, torchvision
from lcf3d.structures import KITTI_CLASSES, Detections2D

IMAGE_SIZE = (1333, 800)
"""Longer and shorter side that an image is brought into, in pixels."""
MEAN = np.array([123.675, 116.28, 103.53], np.float32)
STD = np.array([58.395, 57.12, 57.375], np.float32)
"""Of the image's channels red, green, blue."""
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


class DDQDetector:
    """DDQ-DETR with ResNet-50 or Swin-L from an OpenMMLab checkpoint; a `CameraDetector`.

    Args:
        path: checkpoint file; no code in it is executed.
        class_names: classes the detections shall have, mapped by name; the network's own without it.
        score_threshold: boxes need a higher score.
        classes: the checkpoint's own classes, comma-separated, where they are not COCO's or KITTI's.
        device: torch device.

    Raises:
        DetectorError: the file cannot be read, or is no such network.
        ConfigError: another number of classes than the checkpoint's, or unknown device.
    """

    def __init__(
        self,
        path: Path | str,
        class_names: Sequence[str] | None = None,
        score_threshold: float = 0.05,
        classes: str = "",
        device: str = "cpu",
    ) -> None:
        self._setup(read_state_dict(Path(path)), class_names, score_threshold, classes, device)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], **options: Any) -> DDQDetector:
        """The detector with given weights; options as of the class."""
        detector = cls.__new__(cls)
        settings = {"class_names": None, "score_threshold": 0.05, "classes": "", "device": "cpu", **options}
        detector._setup(state, **settings)
        return detector

    def _setup(
        self,
        state: Mapping[str, Any],
        class_names: Sequence[str] | None,
        score_threshold: float,
        classes: str,
        device: str,
    ) -> None:
        torchvision()
        name = "bbox_head.cls_branches.0.weight"
        if name not in state or "query_map.weight" not in state:
            raise DetectorError(f"the checkpoint is no DDQ-DETR of OpenMMLab: it lacks {name} or query_map.weight")
        self.network_classes = network_classes(len(state[name]), classes)
        swin = "backbone.patch_embed.projection.weight" in state
        with torch.device("meta"):
            network = DDQNetwork(swin, len(self.network_classes))
        load_parameters(network, own_parameters(state), f"the checkpoint for DDQ-DETR ({'Swin-L' if swin else 'R-50'})")
        self.device = torch_device(device)
        self.network = network.eval().requires_grad_(False).to(self.device)
        self.class_names = self.network_classes if class_names is None else tuple(class_names)
        self.score_threshold = score_threshold

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detections in (H, W, 3) uint8 RGB images."""
        return [self._detect(image) for image in images]

    def _detect(self, image: Image) -> Detections2D:
        with torch.inference_mode():
            scores, boxes = self.network(self.prepare(image))
        found = best_detections(scores, boxes, (image.shape[1], image.shape[0]), self.network_classes)
        return to_classes(found[found.scores > self.score_threshold], self.class_names)

    def prepare(self, image: Image, image_size: tuple[int, int] | None = IMAGE_SIZE) -> Tensor:
        """(1, 3, H, W) input of the network; None for ``image_size`` leaves the image at its size.

        Raises:
            ShapeError: not an RGB image.
        """
        if image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ShapeError(f"an image must have shape (H, W, 3), got {image.shape}")
        if image_size is not None:
            image = resize_bilinear(image, *fitted_size(image.shape[1], image.shape[0], image_size))
        normalized = ((image - MEAN) / STD).transpose(2, 0, 1)[None]
        return torch.from_numpy(np.ascontiguousarray(normalized)).to(self.device)


def best_detections(scores: Tensor, boxes: Tensor, size: tuple[int, int], classes: tuple[str, ...]) -> Detections2D:
    """The best pairs of a query and a class, at most `MAX_BOXES`.

    Args:
        scores: (N, K).
        boxes: (N, 4) ``cx cy w h`` in parts of the image.
        size: width and height of the image in pixels.
        classes: names of the K classes.
    """
    best = scores.flatten().topk(min(MAX_BOXES, scores.numel()))
    scale = np.tile(np.array(size, np.float64), 2)
    pixels = corners(boxes[best.indices // len(classes)]).cpu().numpy() * scale
    labels = (best.indices % len(classes)).cpu().numpy()
    return Detections2D(np.clip(pixels, 0, scale), best.values.cpu().numpy(), labels, classes)


def network_classes(count: int, names: str) -> tuple[str, ...]:
    """Names of a checkpoint's classes: those given, or COCO's 80 or KITTI's 3.

    Raises:
        ConfigError: neither, or another number of names.
    """
    if names:
        given = tuple(name.strip() for name in names.split(","))
        if len(given) != count:
            raise ConfigError(f"the checkpoint has {count} classes, {len(given)} are named")
        return given
    for known in (COCO_CLASSES, KITTI_CLASSES):
        if len(known) == count:
            return known
    raise ConfigError(f"the checkpoint has {count} classes: name them in their order, ?classes=Car,Pedestrian,...")


def own_parameters(state: Mapping[str, Any]) -> dict[str, Any]:
    """A checkpoint's parameters without those that only training needs, and without constants."""
    return {
        name: value
        for name, value in state.items()
        if not name.startswith(_TRAINING_ONLY) and not name.endswith("relative_position_index")
    }

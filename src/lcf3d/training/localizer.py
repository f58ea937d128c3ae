"""Training of a frustum network: batches from a pool of frustums, losses (Qi et al. 2018, section 4.4), validation."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.geometry.iou import bev_iou, iou_3d
from lcf3d.localizers.spec import HEADING_UNIT_RAD, LocalizerSpec, decode_boxes, split_outputs
from lcf3d.structures import FloatArray, IntArray
from lcf3d.training.frustum_batch import NO_AUGMENTATION, Augmentation, FrustumSample, assemble, draw
from lcf3d.training.frustums import PooledFrustum, labels_of
from lcf3d.training.loop import import_torch

OPEN_SHAPES = frozenset({"Pedestrian", "Cyclist", "pedestrian", "bicycle", "motorcycle"})
DISTANCES_M = (0.0, 20.0, 40.0, np.inf)
GOOD_IOUS = (0.25, 0.5, 0.7)
VALIDATION_BATCH = 128


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms; those of the heading's and size's residuals and of the T-Net are the LCF3D authors'."""

    mask: float = 1.0
    coarse: float = 2.0
    centre: float = 2.0
    size_class: float = 0.2
    size: float = 5.0
    heading: float = 1.0
    heading_residual: float = 5.0
    corners: float = 1.0
    quality: float = 1.0


class LocalizerTask:
    """A frustum network on a pool of frustums; a `lcf3d.training.loop.TrainingTask`.

    Args:
        spec: the network.
        pool: training frustums.
        validation: held-out frustums.
        batch_size: frustums a step.
        augmentation: of the training frustums.
        shares: share of each class in the batches, by name; those left out are drawn as often as they occur.
        weights: of the losses.
        data: what the frustums are from, in words.

    Raises:
        ConfigError: a batch of fewer than two frustums, or shares of unknown classes.
    """

    def __init__(
        self,
        spec: LocalizerSpec,
        pool: Sequence[PooledFrustum],
        validation: Sequence[PooledFrustum],
        batch_size: int = 64,
        augmentation: Augmentation | None = None,
        shares: Mapping[str, float] | None = None,
        weights: LossWeights | None = None,
        data: str = "",
    ) -> None:
        if batch_size < 2:
            raise ConfigError(f"a batch needs two frustums or more for its statistics, got {batch_size}")
        unknown = sorted(set(shares or {}) - set(spec.class_names))
        if unknown:
            raise ConfigError(f"shares name {unknown[0]!r}, which is none of {', '.join(spec.class_names)}")
        self.spec, self.pool, self.validation, self.batch_size = spec, pool, validation, batch_size
        self.augmentation = augmentation or Augmentation()
        self.weights = weights or LossWeights()
        self.data, self.shares = data, dict(shares or {})
        self._chances = _chances(labels_of(pool), spec.class_names, shares or {})

    def network(self) -> Any:
        """The network with random weights."""
        return build_network(self.spec)

    def described(self) -> dict[str, Any]:
        """What batches depend on, as plain data."""
        told = {"data": self.data, "frustums": len(self.pool), "classes": self.spec.class_names, "form": self.spec.form}
        return {**told, "batch_size": self.batch_size, "shares": self.shares, **asdict(self.augmentation)}

    def starting(self, weights: dict[str, Any]) -> dict[str, Any]:
        """Weights to begin with, as they are."""
        return weights

    def batch(self, step: int, rng: np.random.Generator) -> dict[str, Any]:
        """Arrays of `lcf3d.training.frustum_batch.assemble` as tensors."""
        chosen = rng.choice(len(self.pool), self.batch_size, p=self._chances)
        samples = [self._draw(self.pool[k], self.augmentation, rng) for k in chosen]
        return _tensors(assemble(samples, self.spec, rng))

    def _draw(self, frustum: PooledFrustum, how: Augmentation, rng: np.random.Generator) -> FrustumSample:
        return draw(frustum, self.spec.class_names[frustum.label] in OPEN_SHAPES, how, rng)

    def loss(self, network: Any, batch: dict[str, Any]) -> dict[str, Any]:
        """Weighted terms of `LossWeights`."""
        device = next(network.parameters()).device
        batch = {name: value.to(device) for name, value in batch.items()}
        return frustum_losses(network(batch["points"], batch["context"]), batch, self.spec, self.weights)

    def validate(self, network: Any) -> dict[str, float]:
        """Mean 3D IoU and the shares above `GOOD_IOUS`, by class and by class and distance."""
        if not self.validation:
            return {}
        boxes, truth, labels, _ = self.predict(network, [f for f in self.validation if not f.empty])
        overlap = paired_iou(boxes, truth)
        distance = np.hypot(truth[:, 0], truth[:, 1])
        figures: dict[str, float] = {}
        for k, name in enumerate(self.spec.class_names):
            rows = labels == k
            figures |= _shares(name, overlap[rows])
            for low, high in itertools.pairwise(DISTANCES_M):
                reach = f"{name} {low:.0f}-{high:.0f} m" if high < np.inf else f"{name} over {low:.0f} m"
                figures |= _shares(reach, overlap[rows & (distance >= low) & (distance < high)])
        return figures

    def predict(
        self, network: Any, frustums: Sequence[PooledFrustum], how: Augmentation = NO_AUGMENTATION, seed: int = 0
    ) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
        """(F, 7) boxes, (F, 7) true boxes, (F,) labels, (F,) qualities of pooled frustums."""
        torch = import_torch()
        device = next(network.parameters()).device
        boxes, truth, quality = [], [], []
        for first in range(0, len(frustums), VALIDATION_BATCH):
            rng = np.random.default_rng([seed, first])
            samples = [self._draw(f, how, rng) for f in frustums[first : first + VALIDATION_BATCH]]
            arrays = assemble(samples, self.spec, rng)
            inputs = (torch.from_numpy(arrays[name]).to(device) for name in ("points", "context"))
            with torch.inference_mode():
                outputs = network(*inputs)
            centres = arrays["reference"] + outputs.centre.double().cpu().numpy()
            boxes.append(decode_boxes(centres, outputs.box.double().cpu().numpy(), self.spec))
            quality.append(torch.sigmoid(outputs.quality).cpu().numpy())
            truth.append(np.array([s.box for s in samples]))
        return np.concatenate(boxes), np.concatenate(truth), labels_of(frustums), np.concatenate(quality)


def build_network(spec: LocalizerSpec) -> Any:
    """The torch module of a specification, with random weights."""
    if spec.form == "v2":
        from lcf3d.localizers.pointnet2 import FrustumPointNet2

        return FrustumPointNet2(spec)
    from lcf3d.localizers.pointnet import FrustumPointNet

    return FrustumPointNet(spec)


def _chances(labels: IntArray, names: Sequence[str], shares: Mapping[str, float]) -> FloatArray:
    """(F,) chance of every frustum to be drawn."""
    chances = np.ones(len(labels))
    for k, name in enumerate(names):
        rows = labels == k
        if name in shares and rows.any():
            chances[rows] = shares[name] * len(labels) / rows.sum()
    chances /= chances.sum()
    return chances


def _tensors(arrays: Mapping[str, Any]) -> dict[str, Any]:
    torch = import_torch()
    return {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}


def _shares(name: str, overlap: FloatArray) -> dict[str, float]:
    if not len(overlap):
        return {}
    return {f"{name} IoU": float(overlap.mean())} | {
        f"{name} >{limit}": float((overlap > limit).mean()) for limit in GOOD_IOUS
    }


def paired_iou(boxes: FloatArray, others: FloatArray, bev: bool = False) -> FloatArray:
    """(K,) IoU of (K, 7) boxes with as many others, row by row; in bird's-eye view if asked."""
    function = bev_iou if bev else iou_3d
    pairs = [function(a[None], b[None])[0, 0] for a, b in zip(boxes, others, strict=True)]
    return np.array(pairs, dtype=np.float64)


def frustum_losses(outputs: Any, batch: Mapping[str, Any], spec: LocalizerSpec, weights: LossWeights) -> dict[str, Any]:
    """Weighted terms for `FrustumOutputs`; frustums of nothing teach mask and quality only."""
    torch = import_torch()
    functional = torch.nn.functional
    from lcf3d.localizers.pointnet import smooth_l1

    real, label, device = batch["real"], batch["label"], batch["label"].device
    rows = torch.arange(len(label), device=device)
    share = real / real.sum().clamp(min=1)
    templates = torch.tensor(spec.templates, dtype=torch.float32, device=device)[label]
    _, size_residual, size_score, heading_residual, heading_score = split_outputs(outputs.box, len(spec.class_names))
    wanted_residual = batch["size"] / templates - 1
    own_size = size_residual[rows, label]
    own_heading = heading_residual[rows, batch["heading"]]
    size = templates * (1 + own_size)
    headings = torch.tensor(spec.headings, dtype=torch.float32, device=device)
    yaw = headings[batch["heading"]] + own_heading * HEADING_UNIT_RAD
    corners = corner_distance(outputs.centre, size, yaw, batch["centre"], batch["size"], batch["yaw"])
    entropy = functional.cross_entropy
    terms = {
        "mask": functional.binary_cross_entropy_with_logits(outputs.mask, batch["mask"]),
        "coarse": (smooth_l1(outputs.coarse - batch["centre"]).sum(dim=1) * share).sum(),
        "centre": (smooth_l1(outputs.centre - batch["centre"], 0.5).sum(dim=1) * share).sum(),
        "size_class": (entropy(size_score, label, reduction="none") * share).sum(),
        "size": (smooth_l1(own_size - wanted_residual, 0.2).sum(dim=1) * share).sum(),
        "heading": (entropy(heading_score, batch["heading"], reduction="none") * share).sum(),
        "heading_residual": (smooth_l1(own_heading - batch["heading_residual"]) * share).sum(),
        "corners": (corners * share).sum(),
        "quality": functional.binary_cross_entropy_with_logits(outputs.quality, _true_quality(outputs, batch, spec)),
    }
    return {name: getattr(weights, name) * value for name, value in terms.items()}


def corner_distance(centre: Any, size: Any, yaw: Any, true_centre: Any, true_size: Any, true_yaw: Any) -> Any:
    """(K,) mean Huber distance of the eight corners; a box turned by half a turn is as good (Qi et al., eq. 2)."""
    torch = import_torch()

    def corners(middle: Any, extent: Any, heading: Any) -> Any:
        signs = middle.new_tensor([[x, y, z] for x in (1.0, -1.0) for y in (1.0, -1.0) for z in (1.0, -1.0)])
        local = signs[None] * extent[:, None] / 2
        cos, sin = heading.cos()[:, None], heading.sin()[:, None]
        turned = [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1], local[..., 2]]
        return torch.stack(turned, dim=-1) + middle[:, None]

    found, true = corners(centre, size, yaw), corners(true_centre, true_size, true_yaw)
    turned = corners(true_centre, true_size, true_yaw + np.pi)

    def distance(other: Any) -> Any:
        return torch.nn.functional.huber_loss(found, other, reduction="none", delta=1.0).sum(dim=2).mean(dim=1)

    return torch.minimum(distance(true), distance(turned))


def _true_quality(outputs: Any, batch: Mapping[str, Any], spec: LocalizerSpec) -> Any:
    """(K,) 3D IoU of the boxes that the network would give now with the true ones; 0 where there is nothing."""
    torch = import_torch()
    centre, box = (value.detach().double().cpu().numpy() for value in (outputs.centre, outputs.box))
    found = decode_boxes(centre, box, spec)
    found[:, 3:6] = np.maximum(found[:, 3:6], 0.05)
    true = torch.cat([batch["centre"], batch["size"], batch["yaw"][:, None]], dim=1).double().cpu().numpy()
    return torch.from_numpy(paired_iou(found, true)).float().to(batch["real"].device) * batch["real"]

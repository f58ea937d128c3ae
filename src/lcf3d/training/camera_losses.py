"""What the camera detector is taught: which cell answers for which object, and how wrong its answer is.

Cells are chosen by what they already predict, the product of score and overlap, as in task-aligned learning (Feng et
al., TOOD, ICCV 2021): an object is learned by the cells that see it best, and a cell's score is taught to be high where
its box is good.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lcf3d.detectors.camera.onnx_layouts import STRIDES
from lcf3d.detectors.camera.small_network import PROTOTYPE_STRIDE, SmallOutputs
from lcf3d.networks.torch import Tensor, functional, torch
from lcf3d.training.camera_images import IGNORED

# cells that learn an object, and the powers of score and overlap in their choice
MOST_CELLS, SCORE_POWER, OVERLAP_POWER = 10, 0.5, 4.0
# score taught to an object's best cell before its box is any good; without it small objects are hardly ever begun
FLOOR = 0.5
# pixels around an object's centre in which a cell may answer for it however small it is
REACH = 6.0
BOX_WEIGHT, MASK_WEIGHT = 4.0, 1.5
# masks learned a batch; more cost time and say the same
MOST_MASKS, MASKS_AN_IMAGE = 32, 4


@dataclass(frozen=True)
class Targets:
    """Objects of a batch, as many rows an image as the fullest has.

    Attributes:
        boxes: (B, N, 4) corners in pixels of the input.
        visible: (B, N, 4) bounds of what can be seen.
        labels: (B, N) classes, `IGNORED` for objects to ignore, `ABSENT` for rows without one.
        owner: (B, H, W) number of the object in each pixel, or None without masks.
        numbers: (B, N) numbers of the objects in ``owner``.
    """

    boxes: Tensor
    visible: Tensor
    labels: Tensor
    owner: Tensor | None
    numbers: Tensor


@dataclass(frozen=True)
class Assignment:
    """Which cells learn which objects.

    Attributes:
        owned: (B, M) bool, cells that answer for an object.
        objects: (B, M) row of the object of each, 0 for none.
        quality: (B, M) the score each shall have, 0 to 1.
        ignored: (B, M) bool, cells whose scores are not taught.
    """

    owned: Tensor
    objects: Tensor
    quality: Tensor
    ignored: Tensor


def losses(outputs: SmallOutputs, targets: Targets, size: tuple[int, int]) -> dict[str, Any]:
    """Weighted loss terms of a batch.

    Args:
        outputs: of the network in training mode.
        targets: the objects.
        size: (height, width) of the input.
    """
    assigned = assign(outputs, targets, cell_centres(size, outputs.boxes))
    labels = targets.labels.clamp(min=0).gather(1, assigned.objects)
    wanted = torch.zeros_like(outputs.logits).scatter_(2, labels[..., None], assigned.quality[..., None])
    total = wanted.sum().clamp(min=1.0)
    scores = functional.binary_cross_entropy_with_logits(outputs.logits, wanted, reduction="none")
    true = targets.boxes.gather(1, assigned.objects[..., None].expand(-1, -1, 4))
    shift = 1 - generalized_iou(outputs.boxes.flatten(0, 1), true.flatten(0, 1)).reshape(assigned.quality.shape)
    # where nothing is to be learned the true box is another object's, or none
    shift = torch.where(assigned.owned, shift, torch.zeros_like(shift))
    terms = {
        "score": (scores * ~assigned.ignored[..., None]).sum() / total,
        "box": BOX_WEIGHT * (shift * assigned.quality).sum() / total,
    }
    if targets.owner is not None and outputs.prototypes is not None:
        terms["mask"] = MASK_WEIGHT * mask_loss(outputs, targets, assigned)
    return terms


def cell_centres(size: tuple[int, int], like: Tensor) -> Tensor:
    """(M, 2) x and y of the centres of all cells in pixels of the input, in the order of the network's outputs."""
    parts = []
    for stride in STRIDES:
        down, across = torch.meshgrid(
            torch.arange(size[0] // stride, device=like.device),
            torch.arange(size[1] // stride, device=like.device),
            indexing="ij",
        )
        parts.append((torch.stack([across, down], dim=-1).flatten(0, 1) + 0.5) * stride)
    return torch.cat(parts).to(like.dtype)


def assign(outputs: SmallOutputs, targets: Targets, centres: Tensor) -> Assignment:
    """Cells for the objects of every image; a cell answers for one object at most."""
    with torch.no_grad():
        visible, labels = targets.visible, targets.labels
        middle, half = (visible[..., :2] + visible[..., 2:]) / 2, (visible[..., 2:] - visible[..., :2]) / 2
        near = ((centres - middle[:, :, None]).abs() < half.clamp(min=REACH)[:, :, None]).all(dim=3)
        ignored = (near & (labels == IGNORED)[..., None]).any(dim=1)
        near = near & (labels >= 0)[..., None]
        overlap = pairwise_iou(targets.boxes, outputs.boxes) * near
        of_class = labels.clamp(min=0)[..., None].expand(-1, -1, outputs.logits.shape[1])
        scores = outputs.logits.sigmoid().transpose(1, 2).gather(1, of_class)
        alignment = scores**SCORE_POWER * overlap**OVERLAP_POWER
        best = alignment.topk(min(MOST_CELLS, alignment.shape[2]), dim=2).indices
        chosen = torch.zeros_like(near).scatter_(2, best, value=True) & (alignment > 0)
        # a cell that several objects want goes to the one it overlaps most
        objects = (overlap * chosen).argmax(dim=1)
        owned = chosen.any(dim=1)
        rows = torch.arange(labels.shape[1], device=labels.device)[None, :, None]
        own = chosen & (rows == objects[:, None])
        aligned = alignment * own
        highest = aligned.amax(dim=2, keepdim=True).clamp(min=1e-9)
        reached = (overlap * own).amax(dim=2, keepdim=True)
        quality = (aligned / highest * (FLOOR + (1 - FLOOR) * reached)).sum(dim=1)
        return Assignment(owned, objects, quality, ignored & ~owned)


def pairwise_iou(a: Tensor, b: Tensor) -> Tensor:
    """(..., N, M) IoU of (..., N, 4) and (..., M, 4) boxes."""
    low = torch.maximum(a[..., :, None, :2], b[..., None, :, :2])
    high = torch.minimum(a[..., :, None, 2:], b[..., None, :, 2:])
    common = (high - low).clamp(min=0).prod(dim=-1)
    total = (a[..., 2:] - a[..., :2]).prod(dim=-1)[..., :, None] + (b[..., 2:] - b[..., :2]).prod(dim=-1)[..., None, :]
    iou: Tensor = common / (total - common).clamp(min=1e-6)
    return iou


def generalized_iou(a: Tensor, b: Tensor) -> Tensor:
    """(N,) IoU of pairs of boxes, less the share of their common hull that neither covers; -1 to 1."""
    low, high = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    common = (high - low).clamp(min=0).prod(dim=1)
    total = (a[:, 2:] - a[:, :2]).prod(dim=1) + (b[:, 2:] - b[:, :2]).prod(dim=1) - common
    hull = (torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])).prod(dim=1).clamp(min=1e-6)
    value: Tensor = common / total.clamp(min=1e-6) - (hull - total) / hull
    return value


def mask_loss(outputs: SmallOutputs, targets: Targets, assigned: Assignment) -> Tensor:
    """Cross-entropy and overlap (dice) of masks inside their boxes, over a random part of the cells with an object."""
    assert outputs.prototypes is not None
    assert targets.owner is not None
    images, cells = assigned.owned.shape
    most = min(max(MOST_MASKS, MASKS_AN_IMAGE * images), images * cells)
    # random cells with an object first, then cells without, which do not count
    drawn = (torch.rand(images * cells, device=assigned.owned.device) * assigned.owned.flatten()).topk(most).indices
    counted = assigned.owned.flatten()[drawn].to(outputs.prototypes.dtype)
    image, cell = drawn // cells, drawn % cells
    rows = assigned.objects[image, cell]
    logits = torch.einsum("nk,nkhw->nhw", outputs.coefficients[image, cell], outputs.prototypes[image])
    of_object = (targets.owner[image] == targets.numbers[image, rows][:, None, None]).to(logits.dtype)
    wanted = functional.avg_pool2d(of_object[:, None], PROTOTYPE_STRIDE)[:, 0]
    inside = box_masks(targets.boxes[image, rows] / PROTOTYPE_STRIDE, logits.shape[1:], logits)
    area = inside.sum(dim=(1, 2)).clamp(min=1.0)
    entropy = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none") * inside
    shares, wanted = logits.sigmoid() * inside, wanted * inside
    dice = 1 - (2 * (shares * wanted).sum(dim=(1, 2)) + 1) / ((shares + wanted).sum(dim=(1, 2)) + 1)
    total: Tensor = ((entropy.sum(dim=(1, 2)) / area + dice) * counted).sum() / counted.sum().clamp(min=1.0)
    return total


def box_masks(boxes: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
    """(N, h, w) 1 in cells that (N, 4) boxes in cells touch, else 0."""
    rows = torch.arange(shape[0], device=like.device)[None, :, None]
    columns = torch.arange(shape[1], device=like.device)[None, None, :]
    low, high = boxes[:, :2].floor(), boxes[:, 2:].ceil()
    across = (columns >= low[:, 0, None, None]) & (columns < high[:, 0, None, None])
    down = (rows >= low[:, 1, None, None]) & (rows < high[:, 1, None, None])
    return (across & down).to(like.dtype)

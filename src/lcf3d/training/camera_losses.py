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

# cells that learn an object, and the powers of score and overlap in their choice
MOST_CELLS, SCORE_POWER, OVERLAP_POWER = 10, 0.5, 4.0
# score taught to an object's best cell before its box is any good; without it small objects are hardly ever begun
FLOOR = 0.5
# pixels around an object's centre in which a cell may answer for it however small it is
REACH = 6.0
BOX_WEIGHT, MASK_WEIGHT = 4.0, 1.5
# masks learned a batch; more cost time and say the same
MOST_MASKS = 32


@dataclass(frozen=True)
class Targets:
    """Objects of a batch, of all images one after the other.

    Attributes:
        image: (N,) image of each object in the batch.
        boxes: (N, 4) corners in pixels of the input.
        visible: (N, 4) bounds of what can be seen.
        labels: (N,) classes, below zero for objects to ignore.
        owner: (B, H, W) uint8 number of the object in each pixel, or None without masks.
        numbers: (N,) uint8 numbers of the objects in ``owner``.
    """

    image: Tensor
    boxes: Tensor
    visible: Tensor
    labels: Tensor
    owner: Tensor | None
    numbers: Tensor


@dataclass(frozen=True)
class Assignment:
    """Which cells of an image learn which objects.

    Attributes:
        cells: (P,) cells that answer for an object.
        objects: (P,) the object of each.
        quality: (P,) the score each shall have, 0 to 1.
        ignored: (M,) bool, cells whose scores are not taught.
    """

    cells: Tensor
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
    centres = cell_centres(size, outputs.boxes)
    wanted = torch.zeros_like(outputs.logits)
    taught = torch.ones_like(outputs.logits[..., :1])
    found: list[tuple[int, Assignment, Tensor]] = []
    for index in range(len(outputs.logits)):
        rows = torch.nonzero(targets.image == index)[:, 0]
        if not len(rows):
            continue
        assigned = assign(outputs, targets, index, rows, centres)
        taught[index, assigned.ignored] = 0
        labels = targets.labels[rows[assigned.objects]]
        wanted[index, assigned.cells, labels] = assigned.quality
        found.append((index, assigned, rows[assigned.objects]))
    total = wanted.sum().clamp(min=1.0)
    scores = functional.binary_cross_entropy_with_logits(outputs.logits, wanted, reduction="none")
    terms = {"score": (scores * taught).sum() / total, "box": outputs.boxes.sum() * 0}
    if found:
        predicted = torch.cat([outputs.boxes[index, a.cells] for index, a, _ in found])
        true = torch.cat([targets.boxes[objects] for _, _, objects in found])
        weights = torch.cat([a.quality for _, a, _ in found])
        terms["box"] = BOX_WEIGHT * ((1 - generalized_iou(predicted, true)) * weights).sum() / total
    if targets.owner is not None and outputs.prototypes is not None:
        terms["mask"] = MASK_WEIGHT * mask_loss(outputs, targets, found)
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


def assign(outputs: SmallOutputs, targets: Targets, index: int, rows: Tensor, centres: Tensor) -> Assignment:
    """Cells of image ``index`` for the objects ``rows`` of the targets; a cell answers for one object at most."""
    with torch.no_grad():
        visible, labels = targets.visible[rows], targets.labels[rows]
        middle, half = (visible[:, :2] + visible[:, 2:]) / 2, (visible[:, 2:] - visible[:, :2]) / 2
        near = ((centres[None] - middle[:, None]).abs() < half.clamp(min=REACH)[:, None]).all(dim=2)
        objects = torch.nonzero(labels >= 0)[:, 0]
        ignored = near[labels < 0].any(dim=0)
        if not len(objects):
            return Assignment(objects, objects, centres.new_zeros(0), ignored)
        near = near[objects]
        overlap = pairwise_iou(targets.boxes[rows[objects]], outputs.boxes[index]) * near
        scores = outputs.logits[index].sigmoid().T[labels[objects]]
        alignment = scores**SCORE_POWER * overlap**OVERLAP_POWER * near
        best = alignment.topk(min(MOST_CELLS, alignment.shape[1]), dim=1).indices
        chosen = torch.zeros_like(alignment).scatter_(1, best, 1.0) * (alignment > 0)
        # a cell that several objects want goes to the one it overlaps most
        winner = (overlap * chosen).argmax(dim=0)
        cells = torch.nonzero(chosen.any(dim=0))[:, 0]
        owners = winner[cells]
        aligned = torch.zeros_like(alignment)
        aligned[owners, cells] = alignment[owners, cells]
        highest = aligned.amax(dim=1).clamp(min=1e-9)
        reached = torch.zeros_like(highest).scatter_reduce_(0, owners, overlap[owners, cells], "amax")
        quality = aligned[owners, cells] / highest[owners] * (FLOOR + (1 - FLOOR) * reached[owners])
        ignored[cells] = False
        return Assignment(cells, objects[owners], quality, ignored)


def pairwise_iou(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) IoU of (N, 4) and (M, 4) boxes."""
    low = torch.maximum(a[:, None, :2], b[None, :, :2])
    high = torch.minimum(a[:, None, 2:], b[None, :, 2:])
    common = (high - low).clamp(min=0).prod(dim=2)
    total = (a[:, 2:] - a[:, :2]).prod(dim=1)[:, None] + (b[:, 2:] - b[:, :2]).prod(dim=1)[None] - common
    iou: Tensor = common / total.clamp(min=1e-6)
    return iou


def generalized_iou(a: Tensor, b: Tensor) -> Tensor:
    """(N,) IoU of pairs of boxes, less the share of their common hull that neither covers; -1 to 1."""
    low, high = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    common = (high - low).clamp(min=0).prod(dim=1)
    total = (a[:, 2:] - a[:, :2]).prod(dim=1) + (b[:, 2:] - b[:, :2]).prod(dim=1) - common
    hull = (torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])).prod(dim=1).clamp(min=1e-6)
    value: Tensor = common / total.clamp(min=1e-6) - (hull - total) / hull
    return value


def mask_loss(outputs: SmallOutputs, targets: Targets, found: list[tuple[int, Assignment, Tensor]]) -> Tensor:
    """Cross-entropy and overlap (dice) of masks inside their boxes, over a random part of the cells with an object."""
    assert outputs.prototypes is not None
    assert targets.owner is not None
    terms = [outputs.prototypes.sum() * 0]
    count = sum(len(a.cells) for _, a, _ in found)
    share = min(1.0, MOST_MASKS / max(1, count))
    for index, assigned, objects in found:
        drawn = torch.randperm(len(objects))[: max(1, round(share * len(objects)))].to(objects.device)
        logits = torch.einsum(
            "nk,khw->nhw", outputs.coefficients[index, assigned.cells[drawn]], outputs.prototypes[index]
        )
        rows = objects[drawn]
        of_object = (targets.owner[index][None] == targets.numbers[rows][:, None, None]).to(logits.dtype)
        wanted = functional.avg_pool2d(of_object[:, None], PROTOTYPE_STRIDE)[:, 0]
        inside = box_masks(targets.boxes[rows] / PROTOTYPE_STRIDE, logits.shape[1:], logits)
        area = inside.sum(dim=(1, 2)).clamp(min=1.0)
        entropy = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none") * inside
        shares, wanted = logits.sigmoid() * inside, wanted * inside
        dice = 1 - (2 * (shares * wanted).sum(dim=(1, 2)) + 1) / ((shares + wanted).sum(dim=(1, 2)) + 1)
        terms.append((entropy.sum(dim=(1, 2)) / area + dice).sum() / max(1.0, count * share))
    total: Tensor = torch.stack(terms).sum()
    return total


def box_masks(boxes: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
    """(N, h, w) 1 in cells that (N, 4) boxes in cells touch, else 0."""
    rows = torch.arange(shape[0], device=like.device)[None, :, None]
    columns = torch.arange(shape[1], device=like.device)[None, None, :]
    low, high = boxes[:, :2].floor(), boxes[:, 2:].ceil()
    across = (columns >= low[:, 0, None, None]) & (columns < high[:, 0, None, None])
    down = (rows >= low[:, 1, None, None]) & (rows < high[:, 1, None, None])
    return (across & down).to(like.dtype)

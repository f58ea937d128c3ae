"""Labelled images kept on a device, and batches of views of them made there: nothing but the images comes from the CPU.

A view is a window of an image, magnified and perhaps mirrored. Two views may become one: side by side (a mosaic), or
with the people of the second pasted into the first, masks and all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lcf3d.detectors.camera.onnx_images import PADDING
from lcf3d.errors import ConfigError
from lcf3d.training.camera_augmentation import LEAST_LEFT, LOWEST_HEIGHT, LOWEST_WIDTH
from lcf3d.training.camera_images import ABSENT, IGNORED, LabelledImage
from lcf3d.training.loop import import_torch

MOST_OBJECTS = 48
"""Objects of an image that are kept, the largest; and of a view."""
NUMBERS = 256
HIDDEN_SHARE = 0.7
"""People of whom less was visible before are not pasted."""


@dataclass(frozen=True)
class DeviceViews:
    """How views are drawn on the device.

    Attributes:
        scales: smallest and largest factor on the image's size.
        as_it_is: share of the views at the image's own scale.
        sought: share of the views that hold a chosen pedestrian or cyclist.
        mosaic: share of the views that are two side by side.
        pasted: share of the views into which people of another are pasted.
    """

    scales: tuple[float, float] = (0.5, 2.2)
    as_it_is: float = 0.35
    sought: float = 0.45
    mosaic: float = 0.25
    pasted: float = 0.3


class ImageStore:
    """Images of one size on a device, more of which may be added at any time.

    Args:
        device: torch's name of the device.
        masks: whether to keep the owner of each pixel.
    """

    def __init__(self, device: str, masks: bool = True) -> None:
        self.torch = import_torch()
        self.device, self.masks = device, masks
        self._new: list[dict[str, Any]] = []
        self._parts: list[dict[str, Any]] = []
        self.count = 0

    def __len__(self) -> int:
        return self.count

    def add(self, image: LabelledImage) -> None:
        """Take an image, which must have the others' size."""
        sides = image.boxes[:, 2:] - image.boxes[:, :2]
        kept = np.argsort(-sides.prod(axis=1), kind="stable")[:MOST_OBJECTS]
        rows = len(kept)
        row: dict[str, Any] = {
            "image": image.image.transpose(2, 0, 1),
            "boxes": np.zeros((MOST_OBJECTS, 4), np.float32),
            "visible": np.zeros((MOST_OBJECTS, 4), np.float32),
            "labels": np.full(MOST_OBJECTS, ABSENT, np.int64),
            "numbers": np.zeros(MOST_OBJECTS, np.int64),
            "area": np.zeros(MOST_OBJECTS, np.float32),
        }
        row["boxes"][:rows], row["visible"][:rows] = image.boxes[kept], image.visible[kept]
        row["labels"][:rows], row["numbers"][:rows] = image.labels[kept], image.numbers[kept]
        if self.masks:
            if image.owner is None:
                raise ConfigError("these images have no instance masks to learn from; train without masks")
            row["owner"] = image.owner
            row["area"][:rows] = np.bincount(image.owner.ravel(), minlength=NUMBERS)[row["numbers"][:rows]]
        self._new.append(row)

    def commit(self) -> None:
        """Make what was added ready to be drawn."""
        if not self._new:
            return
        torch = self.torch
        part = {
            name: torch.from_numpy(np.stack([row[name] for row in self._new])).to(self.device) for name in self._new[0]
        }
        self._parts.append(part)
        self.count += len(self._new)
        self._new = []
        # images stay where they are, the small tables are joined
        small = [name for name in part if name not in ("image", "owner")]
        self.table = {name: torch.cat([p[name] for p in self._parts]) for name in small}
        self._starts = np.cumsum([0, *(len(p["labels"]) for p in self._parts)])
        rare = (self.table["labels"] > 0).any(1)
        self._rare = torch.nonzero(rare)[:, 0]

    def draw(self, count: int, sought: float, rng: Any) -> Any:
        """(count,) random images, more often such with pedestrians or cyclists."""
        torch = self.torch
        chosen = torch.randint(self.count, (count,), generator=rng, device=self.device)
        if len(self._rare):
            pick = torch.randint(len(self._rare), (count,), generator=rng, device=self.device)
            wanted = torch.rand(count, generator=rng, device=self.device) < sought
            chosen = torch.where(wanted, self._rare[pick], chosen)
        return chosen

    def pixels(self, chosen: Any, name: str) -> Any:
        """``image`` or ``owner`` of the chosen images."""
        rows = chosen.tolist()
        part = np.searchsorted(self._starts, rows, side="right") - 1
        return self.torch.stack(
            [self._parts[p][name][r - int(self._starts[p])] for p, r in zip(part.tolist(), rows, strict=True)]
        )


def draw_views(store: ImageStore, count: int, size: tuple[int, int], how: DeviceViews, rng: Any) -> dict[str, Any]:
    """A batch of views.

    Args:
        store: the images; `ImageStore.commit` must have been called.
        count: views.
        size: (height, width) of the views.
        how: how they are drawn.
        rng: torch generator of the store's device.

    Returns:
        ``pixels`` (count, 3, H, W) float32 in 0 to 1, ``boxes``, ``visible`` (count, N, 4), ``labels``, ``numbers``
        (count, N) and, with masks, ``owner`` (count, H, W).
    """
    torch = store.torch
    first = _window(store, count, size, how, rng)
    if not store.masks:
        return _finished(first, None, size, torch)
    # the partner of each view is another view of the same batch, as a whole batch of its own would cost twice as much
    partner = (torch.arange(count, device=store.device) + 1) % count
    kind = torch.rand(count, generator=rng, device=store.device)
    second = {name: value[partner] for name, value in first.items()}
    people = (second["labels"] > 0) & (second["share"] > HIDDEN_SHARE)
    table = torch.zeros(count, NUMBERS, dtype=torch.bool, device=store.device)
    table.scatter_(1, second["numbers"], people)
    table[:, 0] = False
    wearing = table.gather(1, second["owner"].flatten(1)).reshape(second["owner"].shape)
    cut = (torch.rand(count, generator=rng, device=store.device) * 0.5 + 0.25) * size[1]
    right = torch.arange(size[1], device=store.device)[None] >= cut[:, None]
    mosaic, pasted = kind < how.mosaic, (kind >= how.mosaic) & (kind < how.mosaic + how.pasted)
    taken = (right[:, None] & mosaic[:, None, None]) | (wearing & pasted[:, None, None])
    pixels = torch.where(taken[:, None], second["pixels"], first["pixels"])
    owner = torch.where(taken, second["owner"] + NUMBERS, first["owner"])
    second["numbers"] = second["numbers"] + NUMBERS
    present = mosaic[:, None] | (pasted[:, None] & people)
    second["labels"] = torch.where(present, second["labels"], ABSENT)
    for part, low, high in ((first, torch.zeros_like(cut), cut), (second, cut, torch.full_like(cut, size[1]))):
        low, high = torch.where(mosaic, low, 0.0), torch.where(mosaic, high, float(size[1]))
        for name in ("boxes", "visible"):
            part[name] = part[name].clone()
            part[name][..., 0::2] = part[name][..., 0::2].clamp(low[:, None, None], high[:, None, None])
    tables = ("boxes", "visible", "labels", "numbers", "full")
    both = {name: torch.cat([first[name], second[name]], dim=1) for name in tables}
    return _finished({**both, "pixels": pixels, "owner": owner}, owner, size, torch)


def _window(store: ImageStore, count: int, size: tuple[int, int], how: DeviceViews, rng: Any) -> dict[str, Any]:
    """Windows of random images; ``full`` is the number of pixels that each object would have if nothing were cut."""
    torch, device = store.torch, store.device

    def uniform(low: float = 0.0, high: float = 1.0) -> Any:
        return torch.rand(count, generator=rng, device=device) * (high - low) + low

    chosen = store.draw(count, how.sought, rng)
    image = store.pixels(chosen, "image")
    height, width = image.shape[2:]
    rows = {name: values[chosen] for name, values in store.table.items()}
    span = np.log(how.scales)
    scale = torch.where(uniform() < how.as_it_is, 1.0, torch.exp(uniform(float(span[0]), float(span[1]))))
    corner = _corners(rows, scale, (height, width), size, how, uniform, torch)
    mirrored = torch.where(uniform() < 0.5, -1.0, 1.0)
    column = torch.arange(size[1], device=device) + 0.5
    across = torch.where(mirrored[:, None] < 0, size[1] - column, column) / scale[:, None] + corner[:, :1]
    down = (torch.arange(size[0], device=device) + 0.5)[None] / scale[:, None] + corner[:, 1:]
    grid = torch.stack(
        [
            (across * (2 / width) - 1)[:, None].expand(-1, size[0], -1),
            (down * (2 / height) - 1)[:, :, None].expand(-1, -1, size[1]),
        ],
        dim=-1,
    )
    sample = torch.nn.functional.grid_sample
    pixels = sample(image.float() - PADDING, grid, "bilinear", "zeros", align_corners=False)
    result = {"pixels": (pixels + PADDING) / 255, "labels": rows["labels"], "numbers": rows["numbers"]}
    if store.masks:
        owner = store.pixels(chosen, "owner").float()[:, None]
        result["owner"] = sample(owner, grid, "nearest", "zeros", align_corners=False)[:, 0].long()
    shift = torch.cat([corner, corner], dim=1)[:, None]
    for name in ("boxes", "visible"):
        moved = (rows[name] - shift) * scale[:, None, None]
        turned = torch.stack([size[1] - moved[..., 2], moved[..., 1], size[1] - moved[..., 0], moved[..., 3]], dim=-1)
        result[name] = torch.where((mirrored < 0)[:, None, None], turned, moved)
    whole = (rows["visible"][..., 2:] - rows["visible"][..., :2]).prod(-1).clamp(min=1)
    result["share"] = rows["area"] / whole / 0.5
    result["full"] = rows["area"] * scale[:, None] ** 2
    if not store.masks:
        result["full"] = whole * scale[:, None] ** 2
    return result


def _corners(
    rows: dict[str, Any],
    scale: Any,
    image: tuple[int, int],
    size: tuple[int, int],
    how: DeviceViews,
    uniform: Any,
    torch: Any,
) -> Any:
    """(B, 2) x and y in the images where the windows begin; a sought object lies inside."""
    rare = rows["labels"] > 0
    some = rare.any(1) & (uniform() < how.sought)
    weight = rare.float() * torch.rand(rare.shape, device=rare.device)
    box = rows["visible"][torch.arange(len(rare), device=rare.device), weight.argmax(1)]
    corners = []
    for axis in (0, 1):
        window = size[1 - axis] / scale
        room = image[1 - axis] - window
        low, high = room.clamp(max=0), room.clamp(min=0)
        middle = (box[:, axis] + box[:, axis + 2]) / 2
        near, far = (middle - 0.9 * window).clamp(low, high), (middle - 0.1 * window).clamp(low, high)
        low, high = torch.where(some, near, low), torch.where(some, far, high)
        corners.append(low + uniform() * (high - low))
    return torch.stack(corners, dim=1)


def _finished(view: dict[str, Any], owner: Any, size: tuple[int, int], torch: Any) -> dict[str, Any]:
    """The view with boxes clipped, objects of which too little is seen ignored, and the fullest rows kept."""
    bounds = view["boxes"].new_tensor([size[1], size[0]] * 2)
    boxes = torch.minimum(view["boxes"].clamp(min=0), bounds)
    visible = torch.minimum(view["visible"].clamp(min=0), bounds)
    sides, seen = boxes[..., 2:] - boxes[..., :2], visible[..., 2:] - visible[..., :2]
    if owner is None:
        left = seen.clamp(min=0).prod(-1) / view["full"].clamp(min=1e-6)
    else:
        counts = torch.zeros(len(owner), 2 * NUMBERS, device=owner.device)
        counts.scatter_add_(1, owner.flatten(1), torch.ones_like(owner.flatten(1), dtype=torch.float32))
        left = counts.gather(1, view["numbers"]) / view["full"].clamp(min=1e-6)
    labels = view["labels"]
    poor = (left < LEAST_LEFT) | (sides[..., 1] < LOWEST_HEIGHT) | (sides[..., 0] < LOWEST_WIDTH)
    labels = torch.where((labels >= 0) & poor, IGNORED, labels)
    gone = (sides <= 0).any(-1) | (seen <= 0).any(-1)
    labels = torch.where(gone, ABSENT, labels)
    order = torch.sort(labels, dim=1, descending=True, stable=True).indices[:, :MOST_OBJECTS]
    wide = order[..., None].expand(-1, -1, 4)
    result = {
        "pixels": view["pixels"],
        "boxes": boxes.gather(1, wide),
        "visible": visible.gather(1, wide),
        "labels": labels.gather(1, order),
        "numbers": view["numbers"].gather(1, order),
    }
    return result if owner is None else {**result, "owner": owner}

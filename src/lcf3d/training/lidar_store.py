"""Labelled scans kept on a device, and batches of changed scans made there: nothing but indices comes from the CPU.

The same changes as in `lcf3d.training.lidar_augmentation`, for whole scans at once, and two that tell a network not to
trust its sensor: beams that are missing, and a ground that was measured a little wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.training.lidar_augmentation import LEAST_POINTS_OF_OBJECT, MOST_OBSTACLES, cut_out
from lcf3d.training.lidar_scans import IGNORED, LabelledScan
from lcf3d.training.loop import import_torch

ABSENT = -3
"""Label of unused rows."""
MOST_BOXES = 64
BEAM_DEG = 0.42
BEAMS = 80
LOWEST_BEAM_DEG = -26.0
FEWEST_LEFT = 4.0
"""Returns that must be left of an object for it to be demanded."""
RARE_WEIGHT = 4.0


@dataclass(frozen=True)
class DeviceAugmentation:
    """How far scans are changed on the device.

    Attributes:
        angles: the best of so many random turns is taken.
        scale: largest relative change of size.
        drop: largest share of the points that is left out.
        thinned: share of the scans of which beams are missing.
        jitter_m: largest standard deviation of what is added to every coordinate.
        heave_m: standard deviation of the error of the ground's height.
        slope: standard deviation of the error of its slopes.
        gain: largest logarithm of the factor on intensities.
        offset: largest value that is added to them.
        blind: share of the scans whose intensities say nothing.
        paste: objects of each class that are pasted at most.
        azimuth: largest azimuth in radians of a pasted object.
    """

    angles: int = 3
    scale: float = 0.06
    drop: float = 0.35
    thinned: float = 0.25
    jitter_m: float = 0.02
    heave_m: float = 0.05
    slope: float = 0.003
    gain: float = 0.7
    offset: float = 0.12
    blind: float = 0.1
    paste: tuple[int, ...] = (3, 5, 5)
    azimuth: float = 0.85


class ScanStore:
    """Scans of simulated streets on a device, more of which may be added at any time.

    Args:
        config: of the network, for its classes.
        device: torch's name of the device.
        bank: objects to paste that are kept, by class.
        seed: of the choice of objects.
    """

    def __init__(self, config: LidarConfig, device: str, bank: int = 2500, seed: int = 0) -> None:
        self.torch = import_torch()
        self.config, self.device, self.bank_size = config, device, bank
        self.points: list[Any] = []
        self._rows: list[tuple[Any, Any, Any]] = []
        self._bank: list[list[tuple[Any, Any]]] = [[] for _ in config.class_names]
        self._rng = np.random.default_rng([seed, 7])
        self.boxes: Any = None
        self.labels: Any = None
        self.counts: Any = None
        self.objects: Any = None

    def __len__(self) -> int:
        return len(self.points)

    def add(self, scan: LabelledScan, beams: Any) -> None:
        """Take a scan (levelled where the network wants it so) with the (N,) beam of each point; see `beam_of`."""
        points = np.column_stack([scan.points[:, :4], beams]).astype(np.float32)
        self.points.append(self.torch.from_numpy(points).to(self.device))
        near = np.argsort(np.hypot(scan.boxes[:, 0], scan.boxes[:, 1]))[:MOST_BOXES]
        boxes, labels = np.zeros((MOST_BOXES, 7), np.float32), np.full(MOST_BOXES, ABSENT, np.int64)
        counts = np.zeros(MOST_BOXES, np.float32)
        boxes[: len(near)], labels[: len(near)], counts[: len(near)] = (
            scan.boxes[near],
            scan.labels[near],
            scan.counts[near],
        )
        self._rows.append(tuple(self.torch.from_numpy(value) for value in (boxes, labels, counts)))
        for k in np.flatnonzero((scan.labels >= 0) & (scan.counts >= LEAST_POINTS_OF_OBJECT)):
            own = self._bank[int(scan.labels[k])]
            entry = (cut_out(points, scan.boxes[k]), scan.boxes[k].astype(np.float32))
            if len(own) < self.bank_size:
                own.append(entry)
            else:
                own[int(self._rng.integers(len(own)))] = entry

    def commit(self) -> None:
        """Make what was added ready to be drawn."""
        torch = self.torch
        self.boxes, self.labels, self.counts = (
            torch.stack(values).to(self.device) for values in zip(*self._rows, strict=True)
        )
        entries = [entry for own in self._bank for entry in own]
        if not entries:
            self.objects = None
            return
        lengths = np.array([len(points) for points, _ in entries])
        first = np.cumsum([0, *(len(own) for own in self._bank)])
        self.objects = {
            "points": torch.from_numpy(np.concatenate([points for points, _ in entries])).to(self.device),
            "start": torch.from_numpy(np.cumsum(lengths) - lengths).to(self.device),
            "length": torch.from_numpy(lengths).to(self.device),
            "boxes": torch.from_numpy(np.stack([box for _, box in entries])).to(self.device),
            "members": [(int(first[k]), len(own)) for k, own in enumerate(self._bank)],
        }


def beam_of(points: Any) -> Any:
    """(N,) number of the beam that a point of a scan comes from, by its elevation; before the scan is levelled."""
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    return np.clip((elevation - LOWEST_BEAM_DEG) / BEAM_DEG, 0, BEAMS - 1).astype(np.int64)


def changed_scans(store: ScanStore, count: int, how: DeviceAugmentation, rng: Any) -> tuple[Any, Any, Any, Any]:
    """A batch of ``count`` random scans, changed.

    Args:
        store: where from; `ScanStore.commit` must have been called.
        count: scans.
        how: how far they are changed.
        rng: torch generator of the store's device.

    Returns:
        (P, 4) points of all scans, (P,) scan of each, (count, A, 7) boxes and (count, A) labels.
    """
    torch, area = store.torch, store.config.voxels.area
    chosen = torch.randint(len(store), (count,), generator=rng, device=store.device)
    rows = chosen.tolist()
    points = torch.cat([store.points[i] for i in rows])
    lengths = torch.tensor([len(store.points[i]) for i in rows], device=store.device)
    scan = torch.repeat_interleave(torch.arange(count, device=store.device), lengths, output_size=len(points))
    boxes, labels = store.boxes[chosen].clone(), store.labels[chosen].clone()

    def uniform(low: float, high: float, *shape: int) -> Any:
        return torch.rand(*(shape or (count,)), generator=rng, device=store.device) * (high - low) + low

    left, kept = _thinned(points, scan, how, rng, uniform, torch)
    angle = _best_turn(boxes, labels, area, uniform(-math.pi, math.pi, count, how.angles), torch)
    flip = torch.where(uniform(0, 1) < 0.5, 1.0, -1.0)
    xy = _turn(points[:, :2], angle[scan], torch)
    xy[:, 1] *= flip[scan]
    boxes[..., :2] = _turn(boxes[..., :2], angle[:, None], torch)
    boxes[..., 1] *= flip[:, None]
    boxes[..., 6] = (boxes[..., 6] + angle[:, None]) * flip[:, None]
    reach = 1 + how.scale
    inside = (xy[:, 0] > area[0]) & (xy[:, 0] < area[3] * reach) & (xy[:, 1].abs() < area[4] * reach)
    rows = torch.nonzero(kept & inside)[:, 0]
    points = torch.cat([xy[rows], points[rows, 2:4]], dim=1)
    scan = scan[rows]
    labels[(labels >= 0) & (store.counts[chosen] * left[:, None] < FEWEST_LEFT)] = IGNORED
    if store.objects is not None:
        points, scan, boxes, labels = _paste(store, points, scan, boxes, labels, how, rng)
    scale = uniform(1 - how.scale, 1 + how.scale)
    points[:, :3] *= scale[scan][:, None]
    boxes[..., :6] *= scale[:, None, None]
    points, boxes = _wrong_ground(points, scan, boxes, how, rng, torch)
    points[:, 3] = _intensities(points[:, 3], scan, how, rng, uniform, torch)
    outside = ((boxes[..., :2] <= boxes.new_tensor(area[:2])) | (boxes[..., :2] >= boxes.new_tensor(area[3:5]))).any(-1)
    labels[outside & (labels >= 0)] = IGNORED
    return points, scan, boxes, labels


def _turn(places: Any, angle: Any, torch: Any) -> Any:
    """(..., 2) places turned by angles of the leading shape."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = places[..., 0], places[..., 1]
    return torch.stack([x * cos - y * sin, x * sin + y * cos], dim=-1)


def _best_turn(boxes: Any, labels: Any, area: tuple[float, ...], angles: Any, torch: Any) -> Any:
    """(B,) of (B, T) angles, the one that brings most objects into the area; rare classes weigh more."""
    weights = torch.where(labels > 0, RARE_WEIGHT, 1.0) * (labels >= 0)
    places = _turn(boxes[:, None, :, :2], angles[:, :, None], torch)
    inside = (places[..., 0] > area[0]) & (places[..., 0] < area[3]) & (places[..., 1].abs() < area[4])
    value = (inside * weights[:, None]).sum(-1)
    return angles.gather(1, value.argmax(1, keepdim=True))[:, 0]


def _thinned(points: Any, scan: Any, how: DeviceAugmentation, rng: Any, uniform: Any, torch: Any) -> tuple[Any, Any]:
    """(B,) share of the points that is left of each scan, and (P,) whether each point is."""
    drop, missing = uniform(0, how.drop), uniform(0, 1)
    count = len(drop)
    beams = torch.arange(BEAMS, device=points.device)[None]
    every = torch.randint(2, 4, (count, 1), generator=rng, device=points.device)
    first = torch.randint(0, 4, (count, 1), generator=rng, device=points.device)
    regular = (beams + first) % every == 0
    random = uniform(0, 1, count, BEAMS) < uniform(0, 0.4)[:, None]
    gone = torch.where((missing < how.thinned / 2)[:, None], regular, random) & (missing < how.thinned)[:, None]
    kept = torch.rand(len(points), generator=rng, device=points.device) >= drop[scan]
    kept &= ~gone[scan, points[:, 4].long()]
    return (1 - drop) * (1 - gone.float().mean(1)), kept


def _wrong_ground(points: Any, scan: Any, boxes: Any, how: DeviceAugmentation, rng: Any, torch: Any) -> tuple[Any, Any]:
    """Points and boxes on a ground whose height and slopes are a little off, and points that are a little off."""
    count, device = len(boxes), points.device
    heave = how.heave_m * torch.randn(count, generator=rng, device=device)
    slopes = how.slope * torch.randn(count, 2, generator=rng, device=device)
    spread = how.jitter_m * torch.rand(count, generator=rng, device=device)
    points[:, 2] += heave[scan] + (points[:, :2] * slopes[scan]).sum(1)
    boxes[..., 2] += heave[:, None] + (boxes[..., :2] * slopes[:, None]).sum(-1)
    points[:, :3] += torch.randn(len(points), 3, generator=rng, device=device) * spread[scan][:, None]
    return points, boxes


def _intensities(values: Any, scan: Any, how: DeviceAugmentation, rng: Any, uniform: Any, torch: Any) -> Any:
    """(P,) other intensities."""
    gain = torch.exp(uniform(-how.gain, how.gain))
    power, offset = torch.exp(uniform(-0.4, 0.4)), uniform(0, how.offset)
    noise = 0.05 * torch.randn(len(values), generator=rng, device=values.device)
    changed = values.clamp(min=1e-4) ** power[scan] * gain[scan] + offset[scan] + noise
    blind = uniform(0, 1) < how.blind
    return torch.where(blind[scan], offset[scan] * 2 + noise, changed).clamp(0, 1)


def _paste(
    store: ScanStore, points: Any, scan: Any, boxes: Any, labels: Any, how: DeviceAugmentation, rng: Any
) -> tuple[Any, Any, Any, Any]:
    """The scans with objects at their own distance and a random azimuth, where there is room."""
    torch, objects, count, device = store.torch, store.objects, len(boxes), points.device
    picks, kinds = [], []
    for label, most in enumerate(how.paste):
        first, members = objects["members"][label]
        if not most or not members:
            continue
        wanted = torch.randint(0, most + 1, (count, 1), generator=rng, device=device)
        pick = torch.randint(first, first + members, (count, most), generator=rng, device=device)
        picks.append(torch.where(torch.arange(most, device=device)[None] < wanted, pick, -1))
        kinds += [label] * most
    if not picks:
        return points, scan, boxes, labels
    pick = torch.cat(picks, dim=1)
    kind = torch.tensor(kinds, device=device).expand(count, -1)
    own = objects["boxes"][pick.clamp(min=0)]
    azimuth = (2 * torch.rand(pick.shape, generator=rng, device=device) - 1) * how.azimuth
    angle = azimuth - torch.atan2(own[..., 1], own[..., 0])
    placed = own.clone()
    placed[..., :2] = _turn(own[..., :2], angle, torch)
    placed[..., 6] += angle
    accepted = (pick >= 0) & _free(placed, boxes, labels, store.config.voxels.area, pick >= 0, torch)
    inside, above = _in_boxes(points, scan, placed, torch)
    obstacles = torch.zeros(count, pick.shape[1], device=device).index_add_(0, scan, above.float())
    accepted &= obstacles <= MOST_OBSTACLES
    rows = torch.nonzero(~(inside & accepted[scan]).any(1))[:, 0]
    which, slot = torch.nonzero(accepted, as_tuple=True)
    chosen = pick[which, slot]
    lengths = objects["length"][chosen]
    owner = torch.repeat_interleave(torch.arange(len(chosen), device=device), lengths)
    offset = torch.arange(len(owner), device=device) - (torch.cumsum(lengths, 0) - lengths)[owner]
    added = objects["points"][objects["start"][chosen][owner] + offset][:, :4].clone()
    added[:, :2] = _turn(added[:, :2], angle[which, slot][owner], torch)
    points = torch.cat([points[rows], added])
    scan = torch.cat([scan[rows], which[owner]])
    boxes = torch.cat([boxes, placed], dim=1)
    labels = torch.cat([labels, torch.where(accepted, kind, ABSENT)], dim=1)
    return points, scan, boxes, labels


def _free(placed: Any, boxes: Any, labels: Any, area: tuple[float, ...], active: Any, torch: Any) -> Any:
    """(B, K) whether a place is in the area and clear of the scan's objects and of those placed before it."""
    radius = 0.5 * torch.hypot(placed[..., 3], placed[..., 4])
    others = 0.5 * torch.hypot(boxes[..., 3], boxes[..., 4])
    distance = torch.cdist(placed[..., :2], boxes[..., :2])
    near = (distance < radius[:, :, None] + others[:, None]) & (labels > ABSENT)[:, None]
    between = torch.cdist(placed[..., :2], placed[..., :2])
    close = (between < radius[:, :, None] + radius[:, None]) & active[:, None]
    earlier = torch.ones(placed.shape[1], placed.shape[1], dtype=torch.bool, device=placed.device).tril(-1)
    low, high = placed.new_tensor(area[:2]), placed.new_tensor(area[3:5])
    within = ((placed[..., :2] > low) & (placed[..., :2] < high)).all(-1)
    return within & ~near.any(2) & ~(close & earlier).any(2)


def _in_boxes(points: Any, scan: Any, boxes: Any, torch: Any) -> tuple[Any, Any]:
    """(P, K) whether each point lies in each box of its scan, and whether it does so well above the ground."""
    own = boxes[scan]
    dx, dy = points[:, :1] - own[..., 0], points[:, 1:2] - own[..., 1]
    cos, sin = torch.cos(own[..., 6]), torch.sin(own[..., 6])
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    up = points[:, 2:3] - own[..., 2] + own[..., 5] / 2
    flat = (along.abs() < own[..., 3] / 2) & (across.abs() < own[..., 4] / 2)
    return flat & (up > -0.1) & (up < own[..., 5]), flat & (up > 0.3) & (up < own[..., 5])

"""What happens to a scan before a LiDAR detector learns from it: turned, mirrored, scaled, objects pasted, thinned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import VoxelSpec
from lcf3d.geometry.boxes import points_in_boxes, wrap_angle
from lcf3d.geometry.iou import bev_iou
from lcf3d.structures import BoolArray, FloatArray
from lcf3d.training.lidar_scans import IGNORED, LabelledScan, ScanSource

MOST_POINTS_OF_OBJECT = 3000
LEAST_POINTS_OF_OBJECT = 8
"""Objects with fewer returns are not worth pasting."""
GROUND_M = 0.3
"""Points less than this above the bottom of a box may be the ground it stands on."""
MOST_OBSTACLES = 5
"""A place with more points than this above the ground is taken."""
TILT_REACH_M = 15.0
RARE_WEIGHT = 4.0
"""How much more an object of another class than the first, which is the commonest, counts in choosing what to see."""
ANYWHERE = 0.2
"""Share of the windows that are laid anywhere."""
MARGIN_M = 0.3
"""Pasted objects keep this distance from others, roughly."""


@dataclass(frozen=True)
class AugmentationSettings:
    """How far scans are changed.

    Attributes:
        angles: a turned scan shows one part of its surroundings; the best of so many random ones is taken.
        scale: largest relative change of size.
        tilt: largest roll and pitch in radians; a scan is also raised or lowered, by as much as such a tilt does
            `TILT_REACH_M` away, so that the height of a box must come from its points; 0 for flat ground.
        drop: largest share of the points that is left out.
        intensity_gain: largest relative change of all intensities of a scan.
        intensity_offset: largest value that is added to all of them.
        intensity_noise: standard deviation of what is added to each.
        paste: objects of each class that are pasted at most.
        paste_azimuth: largest azimuth in radians of a pasted object.
    """

    angles: int = 3
    scale: float = 0.05
    tilt: float = 0.0
    drop: float = 0.3
    intensity_gain: float = 0.4
    intensity_offset: float = 0.1
    intensity_noise: float = 0.04
    paste: tuple[int, ...] = (4, 6, 6)
    paste_azimuth: float = 0.9


@dataclass(frozen=True, eq=False)
class ObjectDatabase:
    """Objects cut out of scans, to be pasted into others.

    Attributes:
        points: (K, 4) float32 of each object, LiDAR frame of its scan.
        boxes: (O, 7) LiDAR frame of its scan.
        members: indices into both by class.
    """

    points: tuple[NDArray[np.float32], ...]
    boxes: FloatArray
    members: tuple[NDArray[np.int64], ...]


def collect_objects(
    source: ScanSource, classes: int, limit: int, numbers: Sequence[int] | None = None
) -> ObjectDatabase:
    """The objects of the scans of a source, at most ``limit`` of each of ``classes`` classes, in order.

    ``numbers`` are the scans to look into, all if left out.
    """
    kept: list[tuple[NDArray[np.float32], FloatArray, int]] = []
    found = [0] * classes
    for number in range(source.count) if numbers is None else numbers:
        if min(found) >= limit:
            break
        scan = source.read(number)
        for k in np.flatnonzero((scan.labels >= 0) & (scan.counts >= LEAST_POINTS_OF_OBJECT)):
            label = int(scan.labels[k])
            if found[label] < limit:
                found[label] += 1
                kept.append((cut_out(scan.points, scan.boxes[k]), scan.boxes[k], label))
    labels = np.array([label for _, _, label in kept], dtype=np.int64)
    boxes = np.array([box for _, box, _ in kept], dtype=np.float64).reshape(-1, 7)
    members = tuple(np.flatnonzero(labels == label) for label in range(classes))
    return ObjectDatabase(tuple(points for points, _, _ in kept), boxes, members)


def augment(
    scan: LabelledScan,
    area: tuple[float, ...],
    turn: float,
    objects: ObjectDatabase | None,
    settings: AugmentationSettings,
    rng: np.random.Generator,
) -> LabelledScan:
    """A changed scan, cut to the (6,) ``area``.

    Args:
        scan: as it was.
        area: lower, then upper corner of the volume that is kept.
        turn: largest angle by which the scan may be turned.
        objects: to be pasted; None for none.
        settings: how far to change.
        rng: source of everything random.
    """
    scan = turned(scan, _best_angle(scan, area, turn, settings.angles, rng))
    scan = crop(mirrored(scan) if rng.random() < 0.5 else scan, area)
    if objects is not None:
        scan = _paste(scan, area, objects, settings, rng)
    scan = scaled(scan, float(rng.uniform(1 - settings.scale, 1 + settings.scale)))
    if settings.tilt > 0:
        roll, pitch, heave = rng.uniform(-settings.tilt, settings.tilt, 3)
        scan = tilted(scan, roll, pitch, heave * TILT_REACH_M)
    kept = rng.random(len(scan.points)) >= rng.uniform(0, settings.drop)
    points = scan.points[kept]
    gain = rng.uniform(1 - settings.intensity_gain, 1 + settings.intensity_gain)
    offset = rng.uniform(0, settings.intensity_offset)
    noise = rng.normal(0, settings.intensity_noise, len(points))
    # nuScenes counts to 255
    top = 1.0 if points[:, 3].max(initial=0) <= 1 else 255.0
    points[:, 3] = np.clip(points[:, 3] * gain + (offset + noise) * top, 0, top)
    return crop(replace(scan, points=points), area)


def choose_window(
    scan: LabelledScan, spec: VoxelSpec, stride: int, shape: tuple[int, int], rng: np.random.Generator
) -> VoxelSpec:
    """A part of the voxelised volume to learn from: mostly near an object, rare classes four times as often.

    A step on windows of several scans costs as much as one on a single whole scan, and shows much more.

    Args:
        scan: with the boxes that windows are laid around.
        spec: the whole volume.
        stride: windows start at multiples of so many pillars, like the cells of the head's map.
        shape: pillars along x and y; no more than there are.
        rng: source of everything random.
    """
    size, low = np.array(spec.size[:2]), np.array(spec.area[:2])
    room = np.array(spec.grid[:2]) - shape
    first = rng.uniform(0, 1, 2) * (room + 1)
    weights = np.where(scan.labels < 0, 0.0, np.where(scan.labels > 0, RARE_WEIGHT, 1.0))
    if weights.sum() > 0 and rng.random() >= ANYWHERE:
        chosen = int(rng.choice(len(weights), p=weights / weights.sum()))
        first = (scan.boxes[chosen, :2] - low) / size - rng.uniform(0.1, 0.9, 2) * shape
    start = np.clip(first // stride * stride, 0, room // stride * stride) * size + low
    end = start + np.array(shape) * size
    area = (float(start[0]), float(start[1]), spec.area[2], float(end[0]), float(end[1]), spec.area[5])
    return replace(spec, area=area)


def turned(scan: LabelledScan, angle: float) -> LabelledScan:
    """The scan turned by ``angle`` about the LiDAR's vertical axis."""
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.array([[cos, sin], [-sin, cos]])
    points, boxes = scan.points.copy(), scan.boxes.copy()
    points[:, :2] = points[:, :2] @ rotation.astype(np.float32)
    boxes[:, :2] = boxes[:, :2] @ rotation
    boxes[:, 6] = wrap_angle(boxes[:, 6] + angle)
    return replace(scan, points=points, boxes=boxes)


def mirrored(scan: LabelledScan) -> LabelledScan:
    """The scan with left and right exchanged."""
    points, boxes = scan.points.copy(), scan.boxes.copy()
    points[:, 1] *= -1
    boxes[:, 1] *= -1
    boxes[:, 6] = wrap_angle(-boxes[:, 6])
    return replace(scan, points=points, boxes=boxes)


def scaled(scan: LabelledScan, factor: float) -> LabelledScan:
    """The scan with all lengths multiplied by ``factor``."""
    points, boxes = scan.points.copy(), scan.boxes.copy()
    points[:, :3] *= factor
    boxes[:, :6] *= factor
    return replace(scan, points=points, boxes=boxes)


def tilted(scan: LabelledScan, roll: float, pitch: float, heave: float) -> LabelledScan:
    """The scan on ground that rises to the left (roll) and ahead (pitch), small angles in radians, raised by metres.

    Things stay upright: heights change, and nothing else.
    """
    points, boxes = scan.points.copy(), scan.boxes.copy()
    points[:, 2] += points[:, :2] @ np.array([pitch, roll], np.float32) + np.float32(heave)
    boxes[:, 2] += boxes[:, :2] @ np.array([pitch, roll]) + heave
    return replace(scan, points=points, boxes=boxes)


def crop(scan: LabelledScan, area: tuple[float, ...]) -> LabelledScan:
    """The points inside the (6,) ``area`` and the boxes that reach into it; those centred outside are ignored."""
    inside = np.ones(len(scan.points), dtype=bool)
    for axis in range(3):
        inside &= (scan.points[:, axis] > area[axis]) & (scan.points[:, axis] < area[axis + 3])
    reach = np.hypot(scan.boxes[:, 3], scan.boxes[:, 4])[:, None] / 2
    centers, low, high = scan.boxes[:, :2], np.array(area[:2]), np.array(area[3:5])
    near = ((centers > low - reach) & (centers < high + reach)).all(axis=1)
    labels = np.where(_centered(scan.boxes, area), scan.labels, IGNORED)
    return LabelledScan(scan.points[inside], scan.boxes[near], labels[near], scan.counts[near])


def _centered(boxes: FloatArray, area: tuple[float, ...]) -> BoolArray:
    """(A,) whether the centre of each box lies in the area, seen from above."""
    inside: BoolArray = np.all((boxes[:, :2] > area[:2]) & (boxes[:, :2] < area[3:5]), axis=1)
    return inside


def _best_angle(
    scan: LabelledScan, area: tuple[float, ...], turn: float, tries: int, rng: np.random.Generator
) -> float:
    """The angle of a few random ones that brings most objects into the area; rare classes weigh more."""
    angles = rng.uniform(-turn, turn, max(1, tries))
    weights = np.where(scan.labels < 0, 0.0, np.where(scan.labels > 0, RARE_WEIGHT, 1.0))
    best, best_value = float(angles[0]), -1.0
    distance = np.hypot(scan.boxes[:, 0], scan.boxes[:, 1])
    azimuth = np.arctan2(scan.boxes[:, 1], scan.boxes[:, 0])
    for angle in angles:
        x, y = distance * np.cos(azimuth + angle), distance * np.sin(azimuth + angle)
        value = float(weights[(x > area[0]) & (x < area[3]) & (y > area[1]) & (y < area[4])].sum())
        if value > best_value:
            best, best_value = float(angle), value
    return best


def _paste(
    scan: LabelledScan,
    area: tuple[float, ...],
    objects: ObjectDatabase,
    settings: AugmentationSettings,
    rng: np.random.Generator,
) -> LabelledScan:
    """The scan with objects of the database at their own distance and at a random azimuth, where there is room."""
    boxes, labels = [scan.boxes], [scan.labels]
    added, counts = [], [scan.counts]
    removed = np.zeros(len(scan.points), dtype=bool)
    for label, most in enumerate(settings.paste):
        members = objects.members[label] if label < len(objects.members) else np.zeros(0, np.int64)
        for chosen in rng.choice(members, int(rng.integers(0, most + 1))) if len(members) else ():
            spot = _placed(objects, int(chosen), float(rng.uniform(-1, 1)) * settings.paste_azimuth)
            box = spot.boxes[0]
            if not _centered(spot.boxes, area)[0] or _collides(box, np.concatenate(boxes)):
                continue
            within = _within(scan.points, box)
            if np.count_nonzero(scan.points[within, 2] > box[2] - box[5] / 2 + GROUND_M) > MOST_OBSTACLES:
                continue
            removed[within] = True
            boxes.append(spot.boxes)
            labels.append(np.array([label]))
            counts.append(np.array([len(spot.points)]))
            added.append(spot.points)
    points = np.concatenate([scan.points[~removed], *added])
    return LabelledScan(points, np.concatenate(boxes), np.concatenate(labels), np.concatenate(counts))


def _placed(objects: ObjectDatabase, index: int, azimuth: float) -> LabelledScan:
    """An object of the database turned about the LiDAR to an azimuth."""
    box = objects.boxes[index]
    alone = LabelledScan(objects.points[index], box[None], np.zeros(1, np.int64), np.zeros(1, np.int64))
    return turned(alone, azimuth - float(np.arctan2(box[1], box[0])))


def _collides(box: FloatArray, others: FloatArray) -> bool:
    grown = box[None].copy()
    grown[:, 3:5] += 2 * MARGIN_M
    close = others[np.hypot(*(others[:, :2] - box[:2]).T) < 20]
    return len(close) > 0 and bool((bev_iou(grown, close) > 0).any())


def _within(points: NDArray[np.float32], box: FloatArray) -> NDArray[np.int64]:
    """Indices of the points inside a box."""
    reach = 0.5 * float(np.hypot(box[3], box[4]))
    near = np.flatnonzero((np.abs(points[:, 0] - box[0]) <= reach) & (np.abs(points[:, 1] - box[1]) <= reach))
    inside: NDArray[np.int64] = near[points_in_boxes(points[near], box[None])[0]]
    return inside


def cut_out(points: NDArray[np.float32], box: FloatArray) -> NDArray[np.float32]:
    """The points inside a box; of more than `MOST_POINTS_OF_OBJECT` an even selection, no side missing."""
    inside = _within(points, box)
    if len(inside) > MOST_POINTS_OF_OBJECT:
        inside = inside[np.linspace(0, len(inside) - 1, MOST_POINTS_OF_OBJECT).astype(np.int64)]
    return points[inside]

"""Class names of one vocabulary in another: COCO, KITTI and nuScenes, mapped by name, and the rider rule.

COCO sees a cyclist as a person and a bicycle; KITTI annotates both as one Cyclist and leaves bicycles without a rider
out; nuScenes includes a rider in the box of the bicycle or motorcycle. `join_riders` bridges the three:

    A person rides a mount (bicycle or motorcycle) when, in the image,

    1. their boxes overlap by at least `RIDER_OVERLAP` of the smaller box's area,
    2. the person's horizontal centre lies within the mount's box,
    3. the person's upper edge is above the mount's,
    4. the person's lower edge is not below the mount's by more than a tenth of the person's height, and
    5. the mount's score is at least `MOUNT_SCORE_RATIO` of the person's; a less sure one must not turn a pedestrian
       into a rider.

    Pairs are taken by descending geometric mean of the two scores, each person and each mount once. A pair becomes one
    detection: box = union of the two boxes, score = that geometric mean, mask = union of the two masks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from lcf3d.files import read_text
from lcf3d.geometry.iou import image_area
from lcf3d.structures import Detections2D, Detections3D, InstanceMask, IntArray

Detections = TypeVar("Detections", Detections2D, Detections3D)

COCO_CLASSES = tuple(
    """person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,parking meter,
bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,tie,suitcase,frisbee,skis,
snowboard,sports ball,kite,baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,cup,fork,
knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,potted plant,bed,
dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,oven,toaster,sink,refrigerator,book,clock,vase,
scissors,teddy bear,hair drier,toothbrush""".replace("\n", "").split(",")
)

RIDER_OVERLAP = 0.25
MOUNT_SCORE_RATIO = 0.5
PERSON = "person"
# what a mount of COCO becomes when somebody rides it
RIDDEN: Mapping[str, str] = {"bicycle": "cyclist", "motorcycle": "motorcyclist"}

# lower-case source name -> lower-case names it may go by in the target, best first; other classes keep their name
SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "person": ("person", "pedestrian"),
    "pedestrian": ("pedestrian", "person"),
    "bicycle": ("bicycle", "cyclist"),
    "cyclist": ("cyclist", "bicyclist", "bicycle"),
    "bicyclist": ("bicyclist", "cyclist", "bicycle"),
    "motorcyclist": ("motorcyclist", "motorcycle", "cyclist"),
    "car": ("car", "regular_vehicle"),
    "van": ("van", "car", "regular_vehicle"),
    "regular_vehicle": ("regular_vehicle", "car"),
    "box_truck": ("box_truck", "truck"),
    "trailer": ("trailer", "vehicular_trailer"),
    "vehicular_trailer": ("vehicular_trailer", "trailer"),
    "traffic_cone": ("traffic_cone", "construction_cone"),
    "construction_cone": ("construction_cone", "traffic_cone"),
    "stop sign": ("stop sign", "stop_sign"),
}


def read_class_names(names: str | Sequence[str]) -> tuple[str, ...]:
    """Class names from a sequence, a comma-separated string or a text file with one name a line."""
    if not isinstance(names, str):
        return tuple(names)
    if Path(names).is_file():
        lines = read_text(Path(names)).splitlines()
        return tuple(line.strip() for line in lines if line.strip())
    return tuple(name.strip() for name in names.split(",") if name.strip())


def class_mapping(source: Sequence[str], target: Sequence[str]) -> dict[str, str]:
    """Which class of ``target`` each class of ``source`` becomes; classes without a counterpart are absent.

    Names are compared without regard to case, then by `SYNONYMS`. A vocabulary that has ``person`` draws bicycles
    without their riders (COCO): its bicycles are no cyclists.
    """
    by_lower = {name.lower(): name for name in target}
    bare_mounts = PERSON in source
    mapping = {}
    for name in source:
        lower = name.lower()
        candidates = SYNONYMS.get(lower, (lower,))
        if bare_mounts and lower in RIDDEN:
            candidates = (lower,)
        found = next((by_lower[c] for c in candidates if c in by_lower), None)
        if found is not None:
            mapping[name] = found
    return mapping


def to_classes(
    detections: Detections, class_names: Sequence[str], mapping: Mapping[str, str] | None = None
) -> Detections:
    """Detections in another vocabulary; in 2D, riders joined with what they ride.

    Args:
        detections: of any detector; COCO-like 2D ones (with a class ``person``) pass through `join_riders`.
        class_names: target classes, for example `KITTI_CLASSES` or `NUSCENES_CLASSES`; where the detections have just
            these already, they are returned as they are.
        mapping: source name -> target name, on top of `class_mapping`; an empty target name drops the class.

    Returns:
        Detections with labels of ``class_names``; those of classes without a counterpart are left out.
    """
    if detections.class_names == tuple(class_names):
        return detections
    if isinstance(detections, Detections2D) and PERSON in detections.class_names:
        detections = join_riders(detections)
    names = class_mapping(detections.class_names, class_names)
    names.update(mapping or {})
    # a name that maps to nothing must not slip through by being equal to a target name
    full = {name: names.get(name, "") for name in detections.class_names}
    return detections.with_classes(class_names, full)


def reported_classes(
    own: Sequence[str], class_names: Sequence[str], mapping: Mapping[str, str] | None = None
) -> tuple[str, ...]:
    """The classes of ``class_names`` that a detector of the classes ``own`` can report after `to_classes`."""
    if tuple(own) == tuple(class_names):
        return tuple(class_names)
    riders = [rider for mount, rider in RIDDEN.items() if PERSON in own and mount in own]
    names = {**class_mapping([*own, *riders], class_names), **(mapping or {})}
    return tuple(name for name in class_names if name in names.values())


def join_riders(detections: Detections2D) -> Detections2D:
    """Every person who rides a bicycle or motorcycle and the mount, made one detection (rule: module's text).

    Args:
        detections: with COCO class names (at least ``person``).

    Returns:
        Detections with the same classes and `RIDDEN` behind them: riders first, then the rest in their order.
    """
    class_names = (*detections.class_names, *(n for n in RIDDEN.values() if n not in detections.class_names))
    extended = Detections2D(detections.boxes, detections.scores, detections.labels, class_names, detections.masks)
    mount_labels = {
        class_names.index(mount): class_names.index(name) for mount, name in RIDDEN.items() if mount in class_names
    }
    persons = np.flatnonzero(extended.labels == class_names.index(PERSON))
    mounts = np.flatnonzero(np.isin(extended.labels, list(mount_labels)))
    pairs = _rider_pairs(extended, persons, mounts)
    if not pairs:
        return extended
    first, second = np.array(pairs).T
    boxes = np.concatenate(
        [
            np.minimum(extended.boxes[first, :2], extended.boxes[second, :2]),
            np.maximum(extended.boxes[first, 2:], extended.boxes[second, 2:]),
        ],
        axis=1,
    )
    masks = None
    if extended.masks is not None:
        masks = tuple(_joined_mask(extended.masks[i], extended.masks[j]) for i, j in pairs)
    riders = Detections2D(
        boxes,
        np.sqrt(extended.scores[first] * extended.scores[second]),
        np.array([mount_labels[int(label)] for label in extended.labels[second]]),
        class_names,
        masks,
    )
    rest = np.ones(len(extended), dtype=bool)
    rest[first] = rest[second] = False
    return Detections2D.concatenate([riders, extended[rest]])


def _rider_pairs(detections: Detections2D, persons: IntArray, mounts: IntArray) -> list[tuple[int, int]]:
    """(person, mount) indices, by descending joint score, each index once."""
    person, mount = detections.boxes[persons][:, None], detections.boxes[mounts][None]
    sides = np.minimum(person[..., 2:], mount[..., 2:]) - np.maximum(person[..., :2], mount[..., :2])
    shared = np.prod(np.maximum(sides, 0), axis=-1)
    smaller = np.minimum(image_area(detections.boxes[persons])[:, None], image_area(detections.boxes[mounts])[None])
    overlap = np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)
    centre = (person[..., 0] + person[..., 2]) / 2
    rides = (overlap >= RIDER_OVERLAP) & (centre >= mount[..., 0]) & (centre <= mount[..., 2])
    rides &= person[..., 1] < mount[..., 1]
    rides &= person[..., 3] - mount[..., 3] <= (person[..., 3] - person[..., 1]) / 10
    rides &= detections.scores[mounts][None] >= MOUNT_SCORE_RATIO * detections.scores[persons][:, None]
    scores = np.sqrt(detections.scores[persons][:, None] * detections.scores[mounts][None])
    candidates = np.argwhere(rides)
    pairs: list[tuple[int, int]] = []
    used: set[int] = set()
    for p, m in candidates[np.argsort(-scores[rides], kind="stable")]:
        i, j = int(persons[p]), int(mounts[m])
        if i not in used and j not in used:
            used |= {i, j}
            pairs.append((i, j))
    return pairs


def _joined_mask(first: InstanceMask | None, second: InstanceMask | None) -> InstanceMask | None:
    """The pixels of either mask."""
    if first is None or second is None:
        return first or second
    parts = [m for m in (first, second) if m.bitmap.size]
    if len(parts) < 2:
        return parts[0] if parts else first
    x, y = min(m.x for m in parts), min(m.y for m in parts)
    right = max(m.x + m.bitmap.shape[1] for m in parts)
    bottom = max(m.y + m.bitmap.shape[0] for m in parts)
    bitmap = np.zeros((bottom - y, right - x), dtype=bool)
    for m in parts:
        height, width = m.bitmap.shape
        bitmap[m.y - y : m.y - y + height, m.x - x : m.x - x + width] |= m.bitmap
    return InstanceMask(x, y, bitmap)

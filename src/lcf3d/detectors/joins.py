"""Where detections of other tools meet a dataset: names made equal where that is sure, everything else counted.

Results are joined to a dataset by class, camera, sample and file name. A name that fits nothing takes its detections
with it; `LeftOut` counts those, so that every run can say what it did not use, and refuses results of which nothing is
left.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import shortened
from lcf3d.structures import FloatArray

# names, written plainly, that mean the same in every vocabulary
_SAME = (
    ("pedestrian", "person", "ped", "human"),
    ("cyclist", "bicyclist"),
    ("motorcycle", "motorbike"),
    ("car", "automobile"),
    ("trafficcone", "constructioncone"),
    ("trailer", "vehiculartrailer"),
    ("constructionvehicle", "vehicleconstruction"),
)
_NAMED = 5
NORMALISED = 2.0
BEYOND = 1.1
FEW = 0.03


def plain_name(name: str) -> str:
    """A name without case, spaces and signs: ``Traffic Cone`` and ``traffic_cone`` are one."""
    return "".join(c for c in name.casefold() if c.isalnum())


def join_classes(names: Iterable[str], class_names: Sequence[str]) -> dict[str, str]:
    """Which of ``class_names`` each name of another tool stands for; names that stand for none are absent.

    Equal names first, then without regard to case and signs, then names that mean the same everywhere, then the parts
    of dotted names (``vehicle.car`` is a car, ``vehicle.emergency.police`` none). Nothing is guessed beyond that: a van
    stays a van.
    """
    found: dict[str, str] = {}
    by_plain = {plain_name(name): name for name in reversed(class_names)}
    for group in _SAME:
        there = next((by_plain[name] for name in group if name in by_plain), None)
        if there is not None:
            by_plain = {**dict.fromkeys(group, there), **by_plain}
    for name in names:
        if name in class_names:
            found[name] = name
            continue
        candidates = [plain_name(name), *(plain_name(part) for part in name.split(".") if "." in name)]
        target = next((by_plain[c] for c in candidates if c in by_plain), None)
        if target is not None:
            found[name] = target
    return found


def join_cameras(names: Iterable[str], camera_names: Sequence[str]) -> dict[str, str]:
    """Which of a dataset's cameras each name stands for, without regard to case and signs."""
    by_plain = {plain_name(name): name for name in reversed(camera_names)}
    exact = set(camera_names)
    joined = {name: name if name in exact else by_plain.get(plain_name(name), "") for name in names}
    return {name: camera for name, camera in joined.items() if camera}


@dataclass
class LeftOut:
    """What results hold, what of it was taken, and what fits nothing.

    Attributes:
        place: the file or folder, for messages.
        taken: detections that were taken.
        classes: detections left out by class.
        cameras: detections left out by camera.
        frames: detections (or files) left out by frame.
    """

    place: Path | str
    taken: int = 0
    classes: Counter[str] = field(default_factory=Counter)
    cameras: Counter[str] = field(default_factory=Counter)
    frames: Counter[str] = field(default_factory=Counter)

    def to_json(self) -> dict[str, dict[str, int]]:
        """Counts by kind, the first few of many frames; empty where everything was used."""
        counts: dict[str, dict[str, int]] = {}
        for kind in ("classes", "cameras", "frames"):
            counter: Counter[str] = getattr(self, kind)
            if counter:
                shown = {shortened(name, 60): count for name, count in counter.most_common(_NAMED)}
                rest = sum(counter.values()) - sum(shown.values())
                counts[kind] = {**shown, **({"others": rest} if len(counter) > _NAMED else {})}
        return counts

    def notes(self) -> tuple[str, ...]:
        """One sentence for each kind of thing that was left out."""
        words = {
            "classes": "detections of classes that the run does not have",
            "cameras": "detections of cameras that the run does not use",
            "frames": "detections of frames that the run does not have",
        }
        return tuple(
            f"{self.place}: left out {sum(getattr(self, kind).values())} {words[kind]}: "
            + ", ".join(f"{name} {count}" for name, count in counts.items())
            for kind, counts in self.to_json().items()
        )

    def require_some(self, class_names: Sequence[str], camera_names: Sequence[str] = ()) -> None:
        """See that something was taken, unless there was nothing to take.

        Raises:
            DatasetError: all detections fit nothing; says which name of theirs, and what would have fitted.
        """
        if self.taken:
            return
        for kind, known in (("frames", ()), ("cameras", camera_names), ("classes", class_names)):
            counter: Counter[str] = getattr(self, kind)
            if counter and (kind != "frames" or not (self.cameras or self.classes)):
                names = ", ".join(shortened(name, 60) for name, _ in counter.most_common(_NAMED))
                wanted = f"; expected {', '.join(known)}" if known else ""
                raise DatasetError(
                    f"nothing in {self.place} fits: all of its {sum(counter.values())} detections are of {kind} "
                    f"that are not of this run ({names}){wanted}"
                )


def require_pixels(boxes: FloatArray, place: Path | str, size: tuple[int, int] | None = None) -> None:
    """See that 2D boxes are corners in pixels, as far as their values tell.

    Args:
        boxes: (N, 4) ``x1, y1, x2, y2``, as read.
        place: the file, for the message.
        size: (width, height) of the image, or None.

    Raises:
        FormatError: they are normalised to 0 to 1, or were written as corners where position and size were expected.
    """
    if len(boxes) and boxes.max() <= NORMALISED:
        raise FormatError(f"{place}: all 2D boxes lie within {boxes.max():.3g} pixels: normalised? expected pixels")
    if size is None or not len(boxes):
        return
    beyond = np.asarray((boxes[:, 2:] > np.array(size) * BEYOND).any(axis=1))
    second = boxes[:, 2:] - boxes[:, :2]
    corners = np.asarray((second >= boxes[:, :2]).all(axis=1) & (second <= np.array(size) * BEYOND).all(axis=1))
    if beyond.mean() > FEW and (corners[beyond]).all():
        raise FormatError(
            f"{place}: {int(beyond.sum())} of {len(boxes)} 2D boxes reach far beyond the {size[0]} x {size[1]} image; "
            "read as x1, y1, x2, y2 they would fit, but expected is x, y, width, height"
        )

"""What a dataset's sanity checks report, and the rules that hold for every dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from lcf3d.errors import Lcf3dError
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes

RULES = {
    "FRM01": "every frame can be read",
    "FRM02": "scans, where there are any, hold finite points",
    "FRM03": "images, where there are any, have the size that their camera says",
    "FRM04": "some labelled object is in view of some camera (else calibration and labels disagree)",
    "FRM05": "some labelled object holds points of its scan (else scan and labels disagree)",
    "FRM06": "every frame has a scan, an image and labels",
}
# labels farther away than this may hold no points
NEAR_M = 30.0


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a dataset.

    Attributes:
        id: number of the rule, for example ``NUS02``.
        severity: ``error`` (the dataset cannot be used as it is) or ``warning`` (part of it is left out).
        message: one sentence that names the file, record or frame.
    """

    id: str
    severity: Literal["error", "warning"]
    message: str


class Frames(Protocol):
    """Frames by id."""

    ids: tuple[str, ...]

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id."""
        ...


def check_frames(
    dataset: Frames, results: Path | None = None, progress: Callable[[], None] = lambda: None
) -> list[Finding]:
    """Everything that `RULES` find wrong with frames of any dataset; images and scans are read.

    Args:
        dataset: the frames.
        results: must be None or exist; the files in it are not looked at.
        progress: called after every frame.
    """
    findings: list[Finding] = []
    if results is not None and not results.exists():
        findings.append(Finding("FRM01", "error", f"{results} does not exist"))
    absent: dict[str, list[str]] = {"scan": [], "image": [], "label": []}
    near = seen = hit = 0
    for frame_id in dataset.ids:
        try:
            frame = dataset.frame(frame_id)
            findings += _check_sensors(frame, absent)
            labels = frame.labels
        except Lcf3dError as error:
            findings.append(Finding("FRM01", "error", f"frame {frame_id}: {error}"))
        else:
            if labels is None:
                absent["label"].append(frame_id)
            else:
                close = labels[np.hypot(labels.boxes[:, 0], labels.boxes[:, 1]) < NEAR_M]
                near += len(close)
                seen += sum(int(project_boxes(close.boxes, camera)[1].sum()) for camera in frame.cameras)
                if frame.points is not None and len(close):
                    hit += int(points_in_boxes(frame.points, close.boxes).any(axis=1).sum())
        progress()
    if near and not seen and not absent["image"]:
        findings.append(Finding("FRM04", "warning", f"none of {near} near labels is in view of any camera"))
    if near and not hit and not absent["scan"]:
        findings.append(Finding("FRM05", "warning", f"none of {near} near labels holds a point of its scan"))
    for what, frame_ids in absent.items():
        if frame_ids:
            counted = f"{len(frame_ids)} of {len(dataset.ids)} frames have no {what}, first {frame_ids[0]}"
            findings.append(Finding("FRM06", "warning", counted))
    return findings


def _check_sensors(frame: Frame, absent: dict[str, list[str]]) -> Iterator[Finding]:
    points = frame.points
    if points is None:
        absent["scan"].append(frame.id)
    elif not np.isfinite(points).all():
        yield Finding("FRM02", "error", f"frame {frame.id}: the scan holds NaN or infinite values")
    images = 0
    for camera in frame.cameras:
        if camera.name not in frame.images:
            continue
        images += 1
        height, width = frame.images[camera.name].shape[:2]
        if (width, height) != (camera.width, camera.height):
            sizes = f"{width} x {height}, its camera says {camera.width} x {camera.height}"
            yield Finding("FRM03", "error", f"frame {frame.id}: the image of camera {camera.name} is {sizes}")
    if not images:
        absent["image"].append(frame.id)

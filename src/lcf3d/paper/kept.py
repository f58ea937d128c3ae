"""Detections kept on disk, so that a network runs once for all rows of all tables."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numpy as np

from lcf3d.datasets.base import CameraSource, LidarSource
from lcf3d.errors import FormatError, Lcf3dError
from lcf3d.evaluation.domain_shift import AdaptedFrames, AdaptedLidar
from lcf3d.files import atomic_path, reading, shortened
from lcf3d.frame import Frame
from lcf3d.run.frames import FrameRunner
from lcf3d.run.sources import CameraOnImages, DetectorOnFrames, LidarOnScans
from lcf3d.structures import Detections2D, Detections3D, InstanceMask

Found = TypeVar("Found", Detections2D, Detections3D)


def keep_detections(runner: FrameRunner, lidar: str, cameras: dict[str, str], root: str, folder: Path) -> Kept:
    """Have a runner's networks run only where their detections of a frame are not in ``folder`` yet.

    Args:
        runner: changed in place; branches that read result files stay as they are.
        lidar: what names the LiDAR branch.
        cameras: what names that of each camera, ``*`` for all.
        root: names the data.
        folder: where detections are kept.

    Returns:
        Times of the networks, those of earlier runs included.
    """
    kept = Kept()
    runner.lidar = kept.lidar(runner.lidar, folder, lidar, root)
    for name, source in list(runner.cameras.items()):
        text = cameras.get(name) or cameras.get("*") or next(iter(cameras.values()))
        runner.cameras[name] = kept.camera(source, folder, text, root)
    return kept


@dataclass
class Kept:
    """Milliseconds that each detection took when it was made, by branch."""

    milliseconds: dict[str, list[float]] = field(default_factory=lambda: {"lidar": [], "camera": []})

    def lidar(self, source: LidarSource, folder: Path, text: str, root: str) -> LidarSource:
        """The LiDAR branch, whose network runs only where its detections are not in the folder; files stay files."""
        folder /= _name(text, root)
        if isinstance(source, LidarOnScans):
            return _KeptLidar(source, folder, self)
        if isinstance(source, DetectorOnFrames):
            return _KeptFrames(source, folder, self)
        return _KeptAdapted(source, folder, self) if isinstance(source, AdaptedLidar | AdaptedFrames) else source

    def camera(self, source: CameraSource, folder: Path, text: str, root: str) -> CameraSource:
        """The same of a camera branch."""
        return _KeptCamera(source, folder / _name(text, root), self) if isinstance(source, CameraOnImages) else source

    def medians(self) -> dict[str, float]:
        """The median of each branch that a network stands for; the first, which warms up, does not count."""
        return {k: float(np.median(v[1:] or v)) for k, v in self.milliseconds.items() if v}

    def get(self, branch: str, path: Path, make: Callable[[], Found], kind: type[Found]) -> Found:
        """The detections in a file, made and written now if it is not there.

        Raises:
            FormatError: the file is damaged.
        """
        if not path.is_file():
            start = perf_counter()
            found = make()
            spent = (perf_counter() - start) * 1e3
            _write(path, found, spent)
        else:
            found, spent = _read(path, kind)
        self.milliseconds[branch].append(spent)
        return found


class _KeptLidar(LidarOnScans):
    """A `LidarOnScans` whose detections are kept."""

    def __init__(self, source: LidarOnScans, folder: Path, kept: Kept) -> None:
        super().__init__(source.detector)
        self.folder, self.kept = folder, kept

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of the frame."""
        make = super().detect
        return self.kept.get("lidar", self.folder / f"{frame.id}.npz", lambda: make(frame), Detections3D)


class _KeptFrames(DetectorOnFrames):
    """A `DetectorOnFrames` whose detections are kept."""

    def __init__(self, source: DetectorOnFrames, folder: Path, kept: Kept) -> None:
        super().__init__(source.detector)
        self.folder, self.kept = folder, kept

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of the frame."""
        make = super().detect
        return self.kept.get("lidar", self.folder / f"{frame.id}.npz", lambda: make(frame), Detections3D)


@dataclass(frozen=True)
class _KeptAdapted:
    """A LiDAR branch of another domain whose detections are kept."""

    source: AdaptedLidar | AdaptedFrames
    folder: Path
    kept: Kept

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of the frame."""
        return self.kept.get("lidar", self.folder / f"{frame.id}.npz", lambda: self.source.detect(frame), Detections3D)


class _KeptCamera(CameraOnImages):
    """A `CameraOnImages` whose detections are kept."""

    def __init__(self, source: CameraOnImages, folder: Path, kept: Kept) -> None:
        super().__init__(source.detector)
        self.folder, self.kept = folder, kept

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of the frame's image."""
        make = super().detect
        return self.kept.get(
            "camera", self.folder / camera / f"{frame.id}.npz", lambda: make(frame, camera), Detections2D
        )


def _name(spec: str, root: str) -> str:
    """A folder name for a detector on some data: readable, and different for each."""
    readable = "".join(c if c.isalnum() or c in "-_=." else "-" for c in spec.replace("/", "-"))[-60:].strip("-")
    return f"{readable}-{hashlib.sha256(f'{spec} {root}'.encode()).hexdigest()[:8]}"


def _write(path: Path, found: Detections2D | Detections3D, milliseconds: float) -> None:
    arrays: dict[str, Any] = {
        "boxes": found.boxes,
        "scores": found.scores,
        "labels": found.labels,
        "class_names": np.array(found.class_names, dtype=np.str_),
        "milliseconds": milliseconds,
    }
    for name in ("velocities", "attributes"):
        value = getattr(found, name, None)
        if value is not None:
            arrays[name] = value
    masks = getattr(found, "masks", None)
    if masks is not None:
        # one array a mask; a detection without one has none
        arrays["masks"] = len(masks)
        for i, mask in enumerate(masks):
            if mask is not None:
                arrays[f"mask_{i}"], arrays[f"mask_{i}_at"] = mask.bitmap, np.array([mask.x, mask.y])
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def _read(path: Path, kind: type[Found]) -> tuple[Found, float]:
    try:
        with reading(path, "kept detections"), np.load(path, allow_pickle=False) as content:
            arrays: dict[str, Any] = {name: content[name] for name in content.files if not name.startswith("mask_")}
            names = tuple(arrays.pop("class_names").tolist())
            milliseconds = float(arrays.pop("milliseconds"))
            if "masks" in arrays:
                arrays["masks"] = tuple(_mask(content, i) for i in range(int(arrays["masks"])))
            return kind(class_names=names, **arrays), milliseconds
    except (OSError, Lcf3dError) as error:
        raise FormatError(f"{path} is damaged ({shortened(error)}); delete it and run again") from None


def _mask(content: Any, i: int) -> InstanceMask | None:
    if f"mask_{i}" not in content:
        return None
    x, y = content[f"mask_{i}_at"].tolist()
    return InstanceMask(x, y, content[f"mask_{i}"])

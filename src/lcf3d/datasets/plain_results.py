"""Results as JSON files of our own: read as a branch of a run, written beside its provenance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lcf3d.detectors.joins import LeftOut, join_cameras, join_classes, require_pixels
from lcf3d.errors import DatasetError
from lcf3d.files import inside, list_files
from lcf3d.formats.plain import read_detections_2d, read_detections_3d, write_detections_3d
from lcf3d.frame import Frame
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D, Detections3D

MOST_KEPT = 10_000
"""Frames whose detections stay in memory from the count of what fits to their use; others are read again."""


class _PlainResults(ABC):
    """A folder of ``ID.json``; a folder written by ``lcf3d run`` (with ``data/``) will do.

    Args:
        folder: where the files lie.
        class_names: classes to take.
        missing: ``error`` refuses frames without a file, ``empty`` takes them as frames without detections.

    Raises:
        DatasetError: no such folder.
    """

    reads_frames = True
    """Whether `load` reads the files of the frames that it is given, and no others."""

    def __init__(self, folder: Path | str, class_names: Sequence[str], missing: str = "error") -> None:
        path = Path(folder)
        if not path.is_dir():
            raise DatasetError(f"result folder {path} does not exist")
        self.folder = path / "data" if (path / "data").is_dir() else path
        self.class_names = tuple(class_names)
        self.missing = missing
        self.camera_names: tuple[str, ...] = ()
        self.left_out = LeftOut(self.folder)
        self._kept: dict[str, Any] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Without what was read: another process reads its own frames."""
        return {**self.__dict__, "_kept": {}}

    def load(self, frame_ids: Sequence[str]) -> None:
        """See that there are results of these frames.

        Raises:
            DatasetError: some are missing; says how many and which first.
        """
        absent = [frame_id for frame_id in frame_ids if not self._path(frame_id).is_file()]
        nothing = len(absent) == len(frame_ids) and not self.left_out.taken
        if absent and (self.missing == "error" or nothing):
            raise DatasetError(
                f"{self.folder} lacks the results of {len(absent)} of {len(frame_ids)} frames, first {absent[0]}.json"
            )
        before, self.left_out = self.left_out, LeftOut(self.folder)
        missing = set(absent)
        for frame_id in frame_ids:
            if frame_id not in missing:
                found = self._parse(self._path(frame_id))
                self._count(found, self._path(frame_id))
                if len(self._kept) < MOST_KEPT:
                    self._kept[frame_id] = found
        if not before.taken:
            self.left_out.require_some(self.class_names, self.camera_names)

    @abstractmethod
    def _parse(self, path: Path) -> Any:
        """What a file holds."""

    @abstractmethod
    def _count(self, found: Any, path: Path) -> None:
        """Note what of a file is taken."""

    def _found(self, frame_id: str) -> Any:
        """What the file of a frame holds, read once; None where it may be missing."""
        if frame_id not in self._kept:
            path = self._file(frame_id)
            return None if path is None else self._parse(path)
        return self._kept[frame_id]

    def _count_classes(self, found: Detections2D | Detections3D) -> None:
        joined = join_classes(found.class_names, self.class_names)
        for label, count in Counter(found.labels.tolist()).items():
            name = found.class_names[label]
            if name in joined:
                self.left_out.taken += count
            else:
                self.left_out.classes[name] += count

    def _path(self, frame_id: str) -> Path:
        return inside(self.folder, frame_id, ".json")

    def _file(self, frame_id: str) -> Path | None:
        """The file of a frame, None where it may be missing."""
        path = self._path(frame_id)
        if not path.is_file() and self.missing == "error":
            raise DatasetError(f"{path} does not exist")
        return path if path.is_file() else None


class PlainLidarResults(_PlainResults):
    """3D detections, see `lcf3d.formats.plain`."""

    def _parse(self, path: Path) -> Detections3D:
        return read_detections_3d(path)

    def _count(self, found: Detections3D, path: Path) -> None:
        self._count_classes(found)

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one frame."""
        found: Detections3D | None = self._found(frame.id)
        if found is None:
            return Detections3D.empty(self.class_names)
        return found.with_classes(self.class_names, join_classes(found.class_names, self.class_names))


class PlainCameraResults(_PlainResults):
    """2D detections by camera, see `lcf3d.formats.plain`.

    Args:
        camera_names: the dataset's cameras; those of the files are joined to them by name.
    """

    def __init__(
        self, folder: Path | str, class_names: Sequence[str], missing: str = "error", camera_names: Sequence[str] = ()
    ) -> None:
        super().__init__(folder, class_names, missing)
        self.camera_names = tuple(camera_names)

    def _parse(self, path: Path) -> dict[str, Detections2D]:
        return read_detections_2d(path)

    def _count(self, found: dict[str, Detections2D], path: Path) -> None:
        joined = join_cameras(found, self.camera_names)
        for camera, one in found.items():
            if camera in joined or not self.camera_names:
                require_pixels(one.boxes, path)
                self._count_classes(one)
            else:
                self.left_out.cameras[camera] += len(one)

    def sees(self, frame: Frame, camera: str) -> bool:
        """Always: a camera without detections looked and saw nothing."""
        return True

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one camera of one frame, clipped to its image."""
        found: dict[str, Detections2D] = self._found(frame.id) or {}
        own = next((name for name, target in join_cameras(found, [camera]).items() if target == camera), None)
        if own is None:
            return Detections2D.empty(self.class_names)
        one = found[own]
        joined = one.with_classes(self.class_names, join_classes(one.class_names, self.class_names))
        return joined.clipped(frame.camera(camera))


class PlainWriter:
    """Writes ``data/ID.json`` for every frame.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "data"

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Write the fused detections of a frame."""
        write_detections_3d(inside(self.folder, frame.id, ".json"), fused.detections)

    def is_done(self, frame_id: str) -> bool:
        """Whether the file of a frame is there."""
        return (self.folder / f"{frame_id}.json").is_file()

    def finish(self, frame_ids: Sequence[str], read: Callable[[str], FusedDetections]) -> None:
        """Nothing belongs to all frames together."""

    def written(self) -> Iterator[Path]:
        """The files of all frames."""
        yield from list_files(self.folder, ".json")

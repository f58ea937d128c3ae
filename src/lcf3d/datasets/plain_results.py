"""Results as JSON files of our own: read as a branch of a run, written beside its provenance."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from lcf3d.errors import DatasetError
from lcf3d.formats.plain import read_detections_2d, read_detections_3d, write_detections_3d
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D, Detections3D, Frame


class _PlainResults:
    """A folder of ``ID.json``; a folder written by ``lcf3d run`` (with ``data/``) will do.

    Args:
        folder: where the files lie.
        class_names: classes to take.
        missing: ``error`` refuses frames without a file, ``empty`` takes them as frames without detections.

    Raises:
        DatasetError: no such folder.
    """

    def __init__(self, folder: Path | str, class_names: Sequence[str], missing: str = "error") -> None:
        path = Path(folder)
        if not path.is_dir():
            raise DatasetError(f"result folder {path} does not exist")
        self.folder = path / "data" if (path / "data").is_dir() else path
        self.class_names = tuple(class_names)
        self.missing = missing

    def load(self, frame_ids: Sequence[str]) -> None:
        """See that there are results of these frames.

        Raises:
            DatasetError: some are missing; says how many and which first.
        """
        absent = [frame_id for frame_id in frame_ids if not self._path(frame_id).is_file()]
        if absent and (self.missing == "error" or len(absent) == len(frame_ids)):
            raise DatasetError(
                f"{self.folder} lacks the results of {len(absent)} of {len(frame_ids)} frames, first {absent[0]}.json"
            )

    def _path(self, frame_id: str) -> Path:
        return self.folder / f"{frame_id}.json"

    def _file(self, frame_id: str) -> Path | None:
        """The file of a frame, None where it may be missing."""
        path = self._path(frame_id)
        if not path.is_file() and self.missing == "error":
            raise DatasetError(f"{path} does not exist")
        return path if path.is_file() else None


class PlainLidarResults(_PlainResults):
    """3D detections, see `lcf3d.formats.plain`."""

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one frame."""
        path = self._file(frame.id)
        if path is None:
            return Detections3D.empty(self.class_names)
        return read_detections_3d(path).with_classes(self.class_names)


class PlainCameraResults(_PlainResults):
    """2D detections by camera, see `lcf3d.formats.plain`."""

    def sees(self, frame: Frame, camera: str) -> bool:
        """Always: a camera without detections looked and saw nothing."""
        return True

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one camera of one frame, clipped to its image."""
        path = self._file(frame.id)
        found = read_detections_2d(path) if path is not None else {}
        if camera not in found:
            return Detections2D.empty(self.class_names)
        return found[camera].with_classes(self.class_names).clipped(frame.camera(camera))


class PlainWriter:
    """Writes ``data/ID.json`` for every frame.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "data"

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Write the fused detections of a frame."""
        write_detections_3d(self.folder / f"{frame.id}.json", fused.detections)

    def is_done(self, frame_id: str) -> bool:
        """Whether the file of a frame is there."""
        return (self.folder / f"{frame_id}.json").is_file()

    def finish(self, frame_ids: Sequence[str], read: Callable[[str], FusedDetections]) -> None:
        """Nothing belongs to all frames together."""

    def written(self) -> Iterator[Path]:
        """The files of all frames."""
        yield from sorted(self.folder.glob("[!.]*.json"))

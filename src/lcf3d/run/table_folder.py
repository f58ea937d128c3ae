"""A run folder with parquet tables instead of two small files a frame.

OUT/provenance/part-NAME.parquet   one row a frame: detections, inputs, decisions
OUT/detections/part-NAME.parquet   one row an output, for other tools
OUT/config.yaml, run.json, calibration.json as in other run folders

A shard of frames is written at once: it is there whole or not at all, and a frame is done when its shard is there. The
name of a shard comes from its frames, so that the same run gives the same files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from lcf3d.errors import ConfigError, FormatError
from lcf3d.formats.fused_table import arrow, read_frame_ids, read_frames, write_detections, write_frames
from lcf3d.frame import Frame
from lcf3d.provenance import FusedDetections
from lcf3d.run.folder import RunFolder, is_behind_link

FORMS = ("folder", "parquet")
"""Forms of run folders: files of each frame, or tables of many."""
SHARD_FRAMES = 500
"""Frames in a shard of a run."""


class TableWriter:
    """Stands where a dataset's own writer does: a run in tables has no other files."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Nothing: the tables hold it."""

    def is_done(self, frame_id: str) -> bool:
        """Always: the tables decide."""
        return True

    def finish(self, frame_ids: Sequence[str], read: object) -> None:
        """Nothing belongs to all frames together."""

    def written(self) -> Iterator[Path]:
        """The tables."""
        yield from sorted(self.path.glob("provenance/part-*.parquet"))
        yield from sorted(self.path.glob("detections/part-*.parquet"))


class TableRunFolder(RunFolder):
    """A run folder with tables; see `RunFolder`.

    Args:
        path: the folder.

    Raises:
        ConfigError: pyarrow is not installed.
    """

    def __init__(self, path: Path | str) -> None:
        super().__init__(path, TableWriter(Path(path)))
        arrow()
        self._pending: list[tuple[str, FusedDetections]] = []
        self._places: dict[str, Path] | None = None
        self._read: tuple[Path, dict[str, FusedDetections]] | None = None

    def _own_files(self) -> list[Path]:
        own = [*TableWriter(self.path).written(), self.calibration_path, self.alignment_path]
        return [file for file in own if not is_behind_link(file, self.path)]

    def places(self) -> dict[str, Path]:
        """The shard of each frame that is done.

        Raises:
            FormatError: a shard cannot be read, or two hold the same frame; names them.
        """
        if self._places is None:
            places: dict[str, Path] = {}
            for path in sorted(self.path.glob("provenance/part-*.parquet")):
                for frame_id in read_frame_ids(path):
                    if frame_id in places:
                        raise FormatError(f"frame {frame_id} is in two shards, {places[frame_id].name} and {path.name}")
                    places[frame_id] = path
            self._places = places
        return self._places

    def frame_ids(self) -> list[str]:
        """Frames that are done, sorted."""
        return sorted(self.places())

    def is_done(self, frame_id: str) -> bool:
        """Whether the shard of a frame is there."""
        return frame_id in self.places()

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Keep a frame until its shard is written, see `shard`."""
        self._pending.append((frame.id, fused))

    @contextmanager
    def shard(self) -> Iterator[None]:
        """Frames written inside become one shard, which is there when the block ends well."""
        self._pending = []
        yield
        if self._pending:
            ids = "\n".join(frame_id for frame_id, _ in self._pending)
            name = f"part-{hashlib.sha256(ids.encode()).hexdigest()[:16]}.parquet"
            write_detections(self.path / "detections" / name, self._pending)
            # last: with it the frames are done
            write_frames(self.path / "provenance" / name, self._pending)
        self._pending, self._places = [], None

    def take(self, files: Mapping[str, bytes]) -> None:
        """See `RunFolder.take`."""
        super().take(files)
        self._places = None

    def read(self, frame_id: str) -> FusedDetections:
        """The result of a frame with its provenance.

        Raises:
            FormatError: it is not there or not readable.
        """
        place = self.places().get(frame_id)
        if place is None:
            raise FormatError(f"{self.path / 'provenance'} holds no frame {frame_id}")
        if self._read is None or self._read[0] != place:
            self._read = (place, dict(read_frames(place)))
        return self._read[1][frame_id]


def open_run_folder(path: Path | str) -> RunFolder:
    """A run folder to be read, of either form."""
    tables = any(Path(path).glob("provenance/part-*.parquet"))
    return TableRunFolder(path) if tables else RunFolder(path)


def require_form(form: str) -> str:
    """``form``, if it is one of `FORMS`.

    Raises:
        ConfigError: it is not.
    """
    if form not in FORMS:
        raise ConfigError(f"--format takes {' or '.join(FORMS)}, got {form!r}")
    return form

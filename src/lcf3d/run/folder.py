"""The folder that ``lcf3d run`` writes: results, provenance and the settings that made them.

OUT/config.yaml          the settings used
OUT/run.json             what was run: dataset, detectors, version
OUT/calibration.json     the score calibration used, if any
OUT/provenance/ID.json   why each input and output of the frame is there or not
OUT/...                  results in the dataset's own form: data/ID.txt for KITTI, results.json for nuScenes
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcf3d.datasets.base import ResultWriter
from lcf3d.errors import ConfigError
from lcf3d.files import atomic_path, inside, list_files, read_json, read_text, reading, remove_left_overs, write_json
from lcf3d.frame import Frame
from lcf3d.processes import lock_folder, unlock_folder
from lcf3d.provenance import FusedDetections
from lcf3d.remote.places import remove

if TYPE_CHECKING:
    from lcf3d.fusion.config import FusionConfig

FORMAT = 2
"""Of run folders; those of version 1 (lcf3d 0.1) are read, but not resumed."""


class RunFolder:
    """Reads and writes one run folder; every file appears whole or not at all.

    Args:
        path: the folder.
        writer: writes results in the dataset's form; None for a folder that is only read.
    """

    def __init__(self, path: Path | str, writer: ResultWriter | None = None) -> None:
        self.path = Path(path)
        self._writer = writer

    @staticmethod
    def is_run(path: Path) -> bool:
        """Whether a folder was written by ``lcf3d run``."""
        return (path / "run.json").is_file() and (path / "provenance").is_dir()

    @property
    def calibration_path(self) -> Path:
        """The score calibration used."""
        return self.path / "calibration.json"

    @property
    def alignment_path(self) -> Path:
        """How the cameras stood against the LiDAR, of a run with ``--self-calibrate``."""
        return self.path / "alignment.json"

    def provenance_path(self, frame_id: str) -> Path:
        """The provenance file of a frame."""
        return inside(self.path / "provenance", frame_id, ".json")

    def request(self) -> dict[str, Any]:
        """What was run, as ``run.json`` has it.

        Raises:
            FormatError: it is not there or not JSON.
            ConfigError: it was written by a later version of lcf3d.
        """
        content = read_json(self.path / "run.json")
        if not isinstance(content, dict):
            raise ConfigError(f"{self.path / 'run.json'} does not say what was run")
        version = content.get("format", 1)
        if not isinstance(version, int) or not 1 <= version <= FORMAT:
            raise ConfigError(
                f"{self.path} is a run of format {version}, written by lcf3d {content.get('lcf3d', '?')}; this lcf3d "
                f"reads formats up to {FORMAT}: upgrade it"
            )
        return content

    def begin(self, config: FusionConfig, run: dict[str, Any], *, resume: bool, overwrite: bool) -> None:
        """Write the settings, unless the folder already holds a run.

        Raises:
            ConfigError: it holds one and neither ``resume`` nor ``overwrite`` is set, or ``resume`` is and that run had
                other settings or inputs.
        """
        run = {"format": FORMAT, **run}
        if self.path.is_file():
            raise ConfigError(f"{self.path} is a file; choose a folder for --out")
        self.lock()
        try:
            self.require_place(_form(run), resume=resume, overwrite=overwrite)
            self._begin(config, run, resume=resume, overwrite=overwrite)
        except BaseException:
            self.release()
            raise

    def require_place(self, form: str, *, resume: bool, overwrite: bool) -> None:
        """See that a run may begin here, as far as that can be told before its inputs are read.

        Raises:
            ConfigError: the folder is a file, cannot be written, holds something and neither ``resume`` nor
                ``overwrite`` is set, or something that is no run of this form.
        """
        if self.path.is_file():
            raise ConfigError(f"{self.path} is a file; choose a folder for --out")
        there = next(path for path in (self.path, *self.path.absolute().parents) if path.exists())
        if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
            raise ConfigError(f"{self.path} cannot be written: {there} is read-only or no folder; choose another --out")
        if not list_files(self.path):
            return
        if not resume and not overwrite:
            raise ConfigError(f"{self.path} is not empty; pass --resume, --overwrite or another --out")
        inputs = self.path / "run.json"
        if overwrite and not inputs.is_file():
            raise ConfigError(f"{self.path} holds files of something else; choose another --out")
        if overwrite and _form(read_json(inputs)) != form:
            raise ConfigError(f"{self.path} holds a run of another --format; choose another --out")

    def lock(self) -> None:
        """Keep other processes from writing into the folder until `release`, or until this process ends.

        Raises:
            ConfigError: another process is writing; says which.
        """
        lock_folder(self.path)

    def release(self) -> None:
        """Let others write again."""
        unlock_folder(self.path)

    def _begin(self, config: FusionConfig, run: dict[str, Any], *, resume: bool, overwrite: bool) -> None:
        """See `begin`, with the folder locked."""
        remove_left_overs(self.path)
        settings, inputs = self.path / "config.yaml", self.path / "run.json"
        occupied = bool(list_files(self.path))
        if occupied and not overwrite:
            # a run that was killed before it had written its settings
            same = not settings.is_file() or read_text(settings) == config.to_yaml()
            if not same or not inputs.is_file() or read_json(inputs) != run:
                raise ConfigError(
                    f"{self.path} holds a run with other settings or inputs, so it cannot be resumed; "
                    "pass --overwrite or another --out"
                )
        elif occupied:
            for file in self._own_files():
                remove(file)
        write_json(inputs, run)
        config.dump(settings)

    def _own_files(self) -> list[Path]:
        """What the run that the folder holds has written, but for what lies behind a link or is of no frame of it."""
        frames = set(self.frame_ids())
        results = [] if self._writer is None else list(self._writer.written())
        own = [file for file in results if file.parent.name != "data" or file.stem in frames]
        own += [*(self.provenance_path(frame_id) for frame_id in frames), self.calibration_path, self.alignment_path]
        return [file for file in own if not is_behind_link(file, self.path)]

    def frame_ids(self) -> list[str]:
        """Frames that are done, sorted."""
        return [path.stem for path in list_files(self.path / "provenance", ".json")]

    def is_done(self, frame_id: str) -> bool:
        """Whether the files of a frame are there."""
        own = self._writer is None or self._writer.is_done(frame_id)
        return own and self.provenance_path(frame_id).is_file()

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Write the files of a frame, those in the dataset's form last."""
        write_json(self.provenance_path(frame.id), fused.to_json(), indent=None)
        if self._writer is not None:
            self._writer.write(frame, fused)

    def take(self, files: Mapping[str, bytes]) -> None:
        """Take in finished files of frames that were fused elsewhere, by their paths in the folder, in that order."""
        for name, content in files.items():
            with atomic_path(inside(self.path, name)) as temporary:
                temporary.write_bytes(content)

    @contextmanager
    def shard(self) -> Iterator[None]:
        """A stretch of frames that other forms of run folders write at once; here every frame has files of its own."""
        yield

    def finish(self, frame_ids: Sequence[str]) -> None:
        """Write what belongs to all frames together, and let others write again."""
        if self._writer is not None:
            self._writer.finish(frame_ids, self.read)
        self.release()

    def read(self, frame_id: str) -> FusedDetections:
        """The result of a frame with its provenance.

        Raises:
            FormatError: it is not there or not readable.
        """
        path = self.provenance_path(frame_id)
        with reading(path, "the provenance of a frame"):
            return FusedDetections.from_json(read_json(path))


def _form(run: Any) -> str:
    """The form of a run folder, as ``run.json`` has it."""
    return str(run.get("form", "folder")) if isinstance(run, dict) else "folder"


def is_behind_link(file: Path, folder: Path) -> bool:
    """Whether a file, or a folder on the way to it from ``folder``, is a link."""
    return any(path.is_symlink() for path in (file, *file.parents) if path != folder and folder in path.parents)

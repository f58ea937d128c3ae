"""Writing whole data sets: work in several processes, resume, and nothing half done."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Final

from lcf3d.errors import ConfigError, DatasetError, MissingExtraError
from lcf3d.files import list_files, read_json, remove_left_overs, write_json
from lcf3d.processes import end_with_parent, lock_folder, unlock_folder, workers
from lcf3d.simulation import kitti_layout, nuscenes_layout
from lcf3d.simulation.frames import drive_poses, simulate_drive
from lcf3d.simulation.presets import get_preset
from lcf3d.simulation.streets import STREET_NAMES

SETTINGS_FILE: Final = "simulation.json"
DRIVE_FRAMES: Final = 40
"""Longest drive; a longer sequence goes on in a new scene."""
_CHUNK = 5


@dataclass(frozen=True)
class Recipe:
    """Everything a data set depends on; equal recipes give equal bytes.

    Attributes:
        preset: name of the preset.
        frames: number of frames.
        seed: of all random numbers.
        sequence: drives of up to ``DRIVE_FRAMES`` consecutive frames instead of single scenes.
        street: kind of street, None for a mix.
        density: factor on the number of road users.
    """

    preset: str
    frames: int
    seed: int = 0
    sequence: bool = False
    street: str | None = None
    density: float = 1.0

    def __post_init__(self) -> None:
        get_preset(self.preset)
        if self.frames < 1 or self.seed < 0:
            raise ConfigError(f"frames must be 1 or more and seed 0 or more, got {self.frames} and {self.seed}")
        if self.street is not None and self.street not in STREET_NAMES:
            raise ConfigError(f"unknown street {self.street!r}; use one of {', '.join(STREET_NAMES)}")

    @property
    def drive_frames(self) -> int:
        """Frames of a full drive."""
        return min(DRIVE_FRAMES, self.frames) if self.sequence else 1

    def place(self, index: int) -> tuple[int, int]:
        """Drive and number within it of a frame of the data set."""
        return divmod(index, self.drive_frames)

    def frames_of(self, drive: int) -> int:
        """Frames of a drive; the last one may be shorter."""
        return min(self.drive_frames, self.frames - drive * self.drive_frames)

    def id(self, index: int) -> str:
        """File name stem of a frame."""
        kitti = get_preset(self.preset).layout == "kitti"
        if kitti and not self.sequence:
            return f"{index:06d}"
        drive, number = self.place(index)
        return f"{drive:04d}_{number:06d}" if kitti else f"{drive:04d}_{number:04d}"


def write_dataset(
    recipe: Recipe, root: Path, jobs: int = 1, resume: bool = False, progress: Callable[[int], None] = lambda _: None
) -> list[str]:
    """Simulate a data set into a folder.

    Args:
        recipe: what to simulate.
        root: folder to write to, empty or absent unless ``resume``.
        jobs: processes.
        resume: complete a data set that was interrupted; whole frames are kept.
        progress: called with the number of frames just finished.

    Returns:
        The ids of all frames.

    Raises:
        ConfigError: the folder is not empty, or holds another data set.
        DatasetError: a file cannot be written (no space left, no permission).
        MissingExtraError: embreex is not installed.
    """
    if jobs < 1:
        raise ConfigError(f"jobs must be 1 or more, got {jobs}")
    if find_spec("embreex") is None:
        raise MissingExtraError("embreex", "simulate", "the simulation")
    try:
        _prepare(recipe, root, resume)
        return _write(recipe, root, jobs, progress)
    finally:
        if not root.is_file():
            unlock_folder(root)


def _write(recipe: Recipe, root: Path, jobs: int, progress: Callable[[int], None]) -> list[str]:
    """Write the frames that are missing, and what belongs to all; returns the ids of all frames."""
    layout = _layout(recipe)
    ids = [recipe.id(k) for k in range(recipe.frames)]
    missing = [k for k in range(recipe.frames) if not layout.is_complete(root, ids[k])]
    progress(recipe.frames - len(missing))
    chunks = _chunks(recipe, missing)
    if jobs == 1 or len(chunks) == 1:
        for chunk in chunks:
            progress(len(_write_frames(recipe, root, chunk, 2)))
    else:
        _in_processes(recipe, root, chunks, jobs, progress)
    try:
        if layout is kitti_layout:
            kitti_layout.write_splits(root, ids, recipe.drive_frames)
            _write_poses(recipe, root)
        else:
            nuscenes_layout.write_tables(root, ids, recipe.seed)
    except OSError as error:
        raise _write_error(root, error) from error
    return ids


def _write_poses(recipe: Recipe, root: Path) -> None:
    """Write where the camera of each drive was, as KITTI's odometry does, for what looks at more than one frame."""
    if not recipe.sequence:
        return
    for drive in range(recipe.place(recipe.frames - 1)[0] + 1):
        frames = recipe.frames_of(drive)
        poses = drive_poses(recipe.preset, recipe.seed, frames, drive, recipe.street, recipe.density)
        kitti_layout.write_poses(root, f"{drive:04d}", poses, get_preset(recipe.preset))


def _layout(recipe: Recipe) -> ModuleType:
    return kitti_layout if get_preset(recipe.preset).layout == "kitti" else nuscenes_layout


def _prepare(recipe: Recipe, root: Path, resume: bool) -> None:
    """See that the folder may be written to, and note the recipe in it."""
    if root.exists() and not root.is_dir():
        raise ConfigError(f"{root} is a file; name a folder to write to")
    settings = root / SETTINGS_FILE
    lock_folder(root)
    remove_left_overs(root)
    if list_files(root) or settings.is_file():
        if not resume:
            raise ConfigError(
                f"{root} is not empty; choose another folder, or add --resume to complete a data set begun there"
            )
        if not settings.is_file():
            raise ConfigError(
                f"{root} holds no {SETTINGS_FILE}, so no simulated data set was begun there; choose another folder"
            )
        found = read_json(settings)
        if found != asdict(recipe):
            raise ConfigError(f"{root} was begun with other settings ({found}); use the same, or choose another folder")
        return
    try:
        write_json(settings, asdict(recipe))
    except OSError as error:
        raise _write_error(root, error) from error


def _chunks(recipe: Recipe, missing: list[int]) -> list[list[int]]:
    """Missing frames in short runs within one drive."""
    chunks: list[list[int]] = []
    for index in missing:
        last = chunks[-1] if chunks else None
        if (
            last
            and len(last) < _CHUNK
            and recipe.sequence
            and last[-1] == index - 1
            and recipe.place(index)[0] == recipe.place(last[0])[0]
        ):
            last.append(index)
        else:
            chunks.append([index])
    return chunks


def _write_frames(recipe: Recipe, root: Path, indices: list[int], threads: int) -> list[int]:
    """Simulate and write consecutive frames of one drive; returns their indices."""
    layout = _layout(recipe)
    drive, first = recipe.place(indices[0])
    frames = simulate_drive(
        recipe.preset,
        recipe.seed,
        recipe.frames_of(drive),
        drive=drive,
        street=recipe.street,
        density=recipe.density,
        threads=threads,
        first=first,
    )
    for index, frame in zip(indices, frames, strict=False):
        try:
            layout.write_frame(root, recipe.id(index), frame)
        except OSError as error:
            raise _write_error(root, error) from error
    return indices


def _in_processes(
    recipe: Recipe, root: Path, chunks: list[list[int]], jobs: int, progress: Callable[[int], None]
) -> None:
    """Write the chunks in several processes; the first error stops the rest."""
    context = multiprocessing.get_context("spawn")
    with (
        workers("simulating: the frames that are done are kept, go on with --resume and fewer --jobs"),
        ProcessPoolExecutor(min(jobs, len(chunks)), mp_context=context, initializer=end_with_parent) as pool,
    ):
        futures = [pool.submit(_write_frames, recipe, root, chunk, 1) for chunk in chunks]
        try:
            for future in as_completed(futures):
                progress(len(future.result()))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _write_error(root: Path, error: OSError) -> DatasetError:
    reason = error.strerror or str(error)
    return DatasetError(
        f"cannot write to {root}: {reason}; free some space or choose another folder, then go on with --resume"
    )

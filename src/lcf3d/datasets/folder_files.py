"""Which files of a plain folder belong together: by name, or by the time that their names tell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.structures import FloatArray

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


def files_in(folder: Path, suffixes: Sequence[str], what: str) -> dict[str, Path]:
    """Files of a folder by name without suffix, in order.

    Raises:
        DatasetError: no such folder, no such files in it, or two of one name.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder}, the folder of {what}, does not exist")
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.stem in found:
            raise DatasetError(f"{folder} has both {found[path.stem].name} and {path.name}; names must differ")
        found[path.stem] = path
    if not found:
        raise DatasetError(f"{folder}, the folder of {what}, holds no {', '.join(suffixes)}")
    return found


def times_of(names: Iterable[str]) -> FloatArray | None:
    """Seconds that file names tell, None unless all are numbers.

    Whole numbers of 18 digits and more are nanoseconds, of 15 and more microseconds, of 12 and more milliseconds.
    """
    times = []
    for name in names:
        try:
            value = float(name)
        except ValueError:
            return None
        digits = len(name) if name.isdigit() else 0
        times.append(int(name) * 1e-9 if digits >= 18 else value * (1e-6 if digits >= 15 else _small(digits)))
    found = np.array(times)
    return found if np.isfinite(found).all() else None


def _small(digits: int) -> float:
    return 1e-3 if digits >= 12 else 1.0


def matched(
    ids: Sequence[str], files: dict[str, Path], match: str, max_delay_s: float, what: str
) -> tuple[dict[str, Path], int]:
    """The file of each frame, and how many files belong to none.

    Args:
        ids: frames.
        files: by name.
        match: ``name`` or ``time``.
        max_delay_s: longest accepted time between a frame and its file.
        what: the files are, for the message.

    Raises:
        DatasetError: no file belongs to a frame, or names tell no time.
    """
    if match == "name":
        found = {frame_id: files[frame_id] for frame_id in ids if frame_id in files}
        hint = (
            "; with names that are times, write 'match: time' into sensors.yaml" if times_of(files) is not None else ""
        )
    else:
        own, theirs = times_of(ids), times_of(files)
        if own is None or theirs is None:
            bad = next(iter(ids if own is None else files))
            raise DatasetError(f"'match: time' needs file names that are numbers, got {bad!r} ({what})")
        order = np.argsort(theirs, kind="stable")
        places = np.clip(np.searchsorted(theirs[order], own), 1, len(order) - 1) if len(order) > 1 else None
        names, found, hint = list(files), {}, f" within {max_delay_s} s"
        for i, frame_id in enumerate(ids):
            near = order[:1] if places is None else order[places[i] - 1 : places[i] + 1]
            best = int(near[np.argmin(np.abs(theirs[near] - own[i]))])
            if abs(theirs[best] - own[i]) <= max_delay_s:
                found[frame_id] = files[names[best]]
    if not found:
        raise DatasetError(
            f"none of the {len(files)} files of {what}, first {next(iter(files))!r}, belongs to a frame, "
            f"first {ids[0]!r}{hint}"
        )
    return found, len(files) - len(set(found.values()))

"""Parts of a run on several machines, and putting them together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lcf3d.datasets.base import require_frames
from lcf3d.datasets.opening import open_dataset
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.files import copy_file, list_files, write_json
from lcf3d.run.folder import RunFolder
from lcf3d.run.table_folder import open_run_folder

# entries of run.json that belong to a shard
_OWN = ("shard", "lcf3d", "left_out", "notes")
_FOLDERS = ("provenance", "detections", "data")


def parse_shard(text: str) -> tuple[int, int]:
    """Number and count of ``i/n``, from ``1/n`` to ``n/n``.

    Raises:
        ConfigError: it is not of that form.
    """
    number, slash, count = text.partition("/")
    if not slash or not number.isdecimal() or not count.isdecimal() or not 1 <= int(number) <= int(count):
        raise ConfigError(f"--shard takes i/n with i from 1 to n, for example 2/8, got {text!r}")
    return int(number), int(count)


def frames_of_shard(frame_ids: Sequence[str], shard: str | None) -> tuple[str, ...]:
    """The frames of one part, a stretch of all of them; all without a shard."""
    if shard is None:
        return tuple(frame_ids)
    number, count = parse_shard(shard)
    first, last = ((k * len(frame_ids)) // count for k in (number - 1, number))
    return tuple(frame_ids[first:last])


def merge_shards(shards: Sequence[Path], out: Path) -> int:
    """Put the parts of a run together; gives the number of frames.

    Args:
        shards: run folders written with ``--shard i/n``, all n of them.
        out: a folder that does not exist yet or is empty.

    Raises:
        ConfigError: parts are missing, there twice, unfinished or of different runs; says which.
        DatasetError: the dataset is not where the run found it.
    """
    if out.exists() and (not out.is_dir() or list_files(out)):
        raise ConfigError(f"{out} is not empty; choose another --out")
    for folder in shards:
        if not RunFolder.is_run(folder):
            raise ConfigError(f"{folder} is no folder of 'lcf3d run': it has no run.json and provenance")
    requests = {folder: RunFolder(folder).request() for folder in shards}
    _require_whole(requests)
    request = {**next(iter(requests.values())), "shard": None, **_counts(list(requests.values()))}
    try:
        dataset = open_dataset(request["dataset"], split=request["split"], version=request.get("tables"))
    except DatasetError as error:
        raise DatasetError(f"the dataset of this run is not where it was: {error}") from None
    frame_ids = require_frames(dataset, request["frames"], request["dataset"])
    for folder, own in requests.items():
        done = set(open_run_folder(folder).frame_ids())
        absent = [frame_id for frame_id in frames_of_shard(frame_ids, own["shard"]) if frame_id not in done]
        if absent:
            raise ConfigError(
                f"{folder} (shard {own['shard']}) lacks {len(absent)} of its frames, first {absent[0]}: finish it with "
                "--resume"
            )
    for folder in shards:
        for name in _FOLDERS:
            for path in list_files(folder / name):
                copy_file(path, out / name / path.name)
    for name in ("config.yaml", "calibration.json", "alignment.json"):
        if (shards[0] / name).is_file():
            copy_file(shards[0] / name, out / name)
    if request.get("form", "folder") == "folder":
        RunFolder(out, dataset.writer(out)).finish(frame_ids)
    write_json(out / "run.json", request)
    return len(frame_ids)


def _counts(requests: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What all shards together leave out, and their notes: those of all, then what each says besides."""
    known = [request.get("left_out", {}) for request in requests]
    if all(counts == known[0] for counts in known):
        return {"left_out": known[0], "notes": requests[0].get("notes", [])}
    left_out: dict[str, dict[str, Counter[str]]] = {}
    for counts in known:
        for branch, kinds in counts.items():
            for kind, names in kinds.items():
                left_out.setdefault(branch, {}).setdefault(kind, Counter()).update(names)
    notes = [f"shard {request['shard']}: {note}" for request in requests for note in request.get("notes", [])]
    shared = set.intersection(*(set(request.get("notes", [])) for request in requests))
    first = [note for note in requests[0].get("notes", []) if note in shared]
    return {"left_out": left_out, "notes": first + [n for n in notes if n.partition(": ")[2] not in shared]}


def _require_whole(requests: dict[Path, dict[str, Any]]) -> None:
    """See that these are all parts of one run."""
    holders: dict[str, Path] = {}
    counts, first = set(), next(iter(requests.items()), None)
    if first is None:
        raise ConfigError("no shards to merge: name the folders that 'lcf3d run --shard i/n' has written")
    for folder, request in requests.items():
        shard = request.get("shard")
        if not shard:
            raise ConfigError(f"{folder} is a whole run, not a shard of one: it was written without --shard")
        if shard in holders:
            raise ConfigError(f"shard {shard} is there twice, in {holders[shard]} and {folder}: leave one out")
        holders[shard] = folder
        counts.add(parse_shard(shard)[1])
        different = [key for key in request if key not in _OWN and request[key] != first[1].get(key)]
        if different:
            raise ConfigError(f"{first[0]} and {folder} are shards of different runs: they differ in {different[0]}")
        if (folder / "config.yaml").read_text("utf-8") != (first[0] / "config.yaml").read_text("utf-8"):
            raise ConfigError(f"{first[0]} and {folder} are shards of different runs: they differ in their settings")
    if len(counts) > 1:
        raise ConfigError(f"the shards overlap: they are of runs cut into {' and '.join(map(str, sorted(counts)))}")
    count = counts.pop()
    missing = [f"{i}/{count}" for i in range(1, count + 1) if f"{i}/{count}" not in holders]
    if missing:
        raise ConfigError(f"{len(missing)} of {count} shards are missing: {', '.join(missing)}")

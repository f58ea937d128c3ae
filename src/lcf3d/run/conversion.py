"""Run folders of one form turned into the other."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from lcf3d.datasets.base import Dataset
from lcf3d.errors import ConfigError
from lcf3d.files import copy_file, list_files, write_json
from lcf3d.run.folder import RunFolder
from lcf3d.run.table_folder import SHARD_FRAMES, TableRunFolder, open_run_folder, require_form

# folders that results were written to for their readers, removed when the program ends
_kept: list[TemporaryDirectory[str]] = []


def convert_run(source: Path, dataset: Dataset, out: Path, form: str) -> int:
    """A run folder in another form; gives the number of frames.

    Args:
        source: run folder of either form.
        dataset: that it was made from.
        out: a folder that does not exist yet or is empty.
        form: ``folder`` or ``parquet``.

    Raises:
        ConfigError: ``out`` holds something.
        FormatError: the run cannot be read.
    """
    require_form(form)
    if out.exists() and (not out.is_dir() or list_files(out)):
        raise ConfigError(f"{out} is not empty; choose another --out")
    run = open_run_folder(source)
    request = run.request()
    target = TableRunFolder(out) if form == "parquet" else RunFolder(out, dataset.writer(out))
    done = set(run.frame_ids())
    frame_ids = [frame_id for frame_id in dataset.ids if frame_id in done]
    if len(frame_ids) < len(done):
        foreign = sorted(done - set(frame_ids))
        raise ConfigError(f"{len(foreign)} frames of {source} are not in its dataset, first {foreign[0]}")
    for first in range(0, len(frame_ids), SHARD_FRAMES):
        with target.shard():
            for frame_id in frame_ids[first : first + SHARD_FRAMES]:
                target.write(dataset.frame(frame_id), run.read(frame_id))
    target.finish(frame_ids)
    for name in ("config.yaml", "calibration.json", "alignment.json"):
        if (source / name).is_file():
            copy_file(source / name, out / name)
    write_json(out / "run.json", {**request, "form": form})
    return len(frame_ids)


def as_files(results: Path, dataset: Dataset) -> Path:
    """Results as files in the dataset's own form: the same path, or for a run in tables a folder for the time being."""
    run = open_run_folder(results)
    if not isinstance(run, TableRunFolder):
        return results
    _kept.append(TemporaryDirectory(prefix="lcf3d-"))
    folder = Path(_kept[-1].name) / results.name
    folder.mkdir()
    writer = dataset.writer(folder)
    known = set(dataset.ids)
    frame_ids = [frame_id for frame_id in run.frame_ids() if frame_id in known]
    for frame_id in frame_ids:
        writer.write(dataset.frame(frame_id), run.read(frame_id))
    writer.finish(frame_ids, run.read)
    (folder / "provenance").symlink_to((results / "provenance").resolve(), target_is_directory=True)
    return folder

"""Files for the test servers of KITTI and nuScenes, checked against the official limits before they are written."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lcf3d.datasets.base import Dataset
from lcf3d.datasets.opening import named
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.files import atomic_path
from lcf3d.formats.kitti import format_objects, read_folder
from lcf3d.formats.nuscenes import read_submission, write_submission
from lcf3d.structures import KITTI_CLASSES

KITTI_TEST_FRAMES = tuple(f"{i:06d}" for i in range(7518))
"""Frames of KITTI's object test set; the server wants a file of each."""

NUSCENES_TEST_SAMPLES = 6008
"""Samples of nuScenes' test set."""

META_KEYS = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
"""Flags that a nuScenes submission has to state, each true or false."""


def write_submission_file(text: str, dataset: Dataset, results: Path, out: Path) -> int:
    """Write the file that a test server takes; gives the number of frames.

    Args:
        text: names the dataset, for its kind.
        dataset: the same, opened; of nuScenes, whose samples they are.
        results: result files, or a run folder.
        out: the zip (KITTI) or JSON file (nuScenes).

    Raises:
        ConfigError: there is no such server for this kind of dataset.
        DatasetError: frames of the test set are missing.
        FormatError: a value that the server would refuse.
    """
    if out.is_dir():
        raise ConfigError(f"{out} is a folder; --out names the file to write, for example kitti.zip")
    kind = named(text).kind
    if kind == "kitti":
        return kitti_zip(results, out)
    if kind == "nuscenes":
        return nuscenes_json(results, dataset.ids, out)
    raise ConfigError(f"submission files are for kitti:ROOT and nuscenes:ROOT, got {text!r}")


def kitti_zip(results: Path, out: Path, frame_ids: Sequence[str] = KITTI_TEST_FRAMES) -> int:
    """A zip with a result file of every test frame in its root; gives the number of files.

    Raises:
        DatasetError: files are missing, or of frames that the test set has not; says how many and which first.
        FormatError: a line is malformed, or has a class, box or score that the server does not take.
    """
    folder = results / "data" if (results / "data").is_dir() else results
    _require_frames(folder, frame_ids)
    frames = read_folder(folder, tuple(frame_ids), results=True)
    objects = frames.objects
    names = [str(name) for name in np.unique(objects.class_names)]
    strange = [name for name in names if name not in KITTI_CLASSES]
    if strange:
        raise FormatError(f"{folder} holds {', '.join(strange)}; KITTI's server takes {', '.join(KITTI_CLASSES)}")
    empty = np.flatnonzero((objects.boxes2d[:, 2:] <= objects.boxes2d[:, :2]).any(axis=1))
    if len(empty):
        frame = frame_ids[int(frames.frame_of_object[empty[0]])]
        raise FormatError(f"{folder / frame}.txt: {len(empty)} boxes have no area in the image; leave them out")
    with atomic_path(out) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for frame_id, found in zip(frame_ids, frames, strict=True):
            archive.writestr(f"{frame_id}.txt", format_objects(found))
    return len(frame_ids)


def _require_frames(folder: Path, frame_ids: Sequence[str]) -> None:
    """See that a folder has a text file of every frame and of no other."""
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder; expected KITTI text files, one a frame")
    present = {path.stem for path in folder.glob("*.txt")}
    if not present and any(folder.rglob("*.parquet")):
        raise DatasetError(f"{folder} holds parquet files; the server takes text: run with --format folder")
    missing, others = sorted(set(frame_ids) - present), sorted(present - set(frame_ids))
    if missing:
        raise DatasetError(
            f"{folder} lacks the files of {len(missing)} of the {len(frame_ids)} test frames, first {missing[0]}.txt; "
            "run on the whole test set (an empty file means no objects)"
        )
    if others:
        raise DatasetError(
            f"{folder} holds {len(others)} files that are of no test frame, first {others[0]}.txt; "
            "are they results of another set?"
        )


def nuscenes_json(results: Path, tokens: Sequence[str], out: Path, expected: int = NUSCENES_TEST_SAMPLES) -> int:
    """A submission of exactly the test samples, at most 500 boxes each, with all flags; gives the number of samples.

    Raises:
        DatasetError: the tables are not those of the test set, or samples are missing or of another set.
        FormatError: a value that the server would refuse.
    """
    if len(tokens) != expected:
        raise DatasetError(f"expected the {expected} samples of v1.0-test, the tables hold {len(tokens)}")
    file = results / "results.json" if results.is_dir() else results
    boxes, meta = read_submission(file)
    missing, others = set(tokens) - set(boxes.sample_tokens), set(boxes.sample_tokens) - set(tokens)
    if missing or others:
        raise DatasetError(
            f"{file} lacks {len(missing)} samples of the test set and holds {len(others)} of others; "
            "run on all samples of v1.0-test"
        )
    wrong = [key for key in META_KEYS if not isinstance(meta.get(key), bool)]
    if wrong:
        raise FormatError(f"{file}: meta must say true or false for {', '.join(wrong)}")
    write_submission(out, boxes, {key: meta[key] for key in META_KEYS})
    return len(tokens)

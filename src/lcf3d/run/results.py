"""The detector kind ``results:PATH``: detections of another tool, read as the dataset says that its results look."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource, require_missing
from lcf3d.datasets.foreign_results import ForeignLidarResults, is_foreign
from lcf3d.errors import ConfigError


def lidar_results(
    path: str, class_names: Sequence[str], dataset: Dataset, missing: str = "error", classes: str = ""
) -> LidarSource:
    """3D detections in result files.

    Args:
        path: file or folder in the form of the dataset's results, a run folder, or results of OpenPCDet or mmdet3d
            (`lcf3d.datasets.foreign_results`).
        class_names: classes to take.
        dataset: whose frames they are of.
        missing: frames without results: ``error``, or ``empty``.
        classes: of mmdet3d's results: the names that its numbers stand for, with commas.

    Raises:
        Lcf3dError: the files are not there, or not in that form.
    """
    place = Path(path).expanduser()
    if is_foreign(place):
        return ForeignLidarResults(
            place, dataset.ids, class_names, require_missing(missing), classes, dataset.native_from_canonical
        )
    if classes:
        raise ConfigError(f"classes={classes} names the numbers of mmdet3d's results, but {path} holds none of those")
    return dataset.lidar_results(place, class_names, require_missing(missing))


def camera_results(path: str, class_names: Sequence[str], dataset: Dataset, missing: str = "error") -> CameraSource:
    """2D detections in result files; see `lidar_results`."""
    return dataset.camera_results(Path(path).expanduser(), class_names, require_missing(missing))

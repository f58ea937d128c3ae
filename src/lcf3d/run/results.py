"""The detector kind ``results:PATH``: detections of another tool, read as the dataset says that its results look."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource, require_missing


def lidar_results(path: str, class_names: Sequence[str], dataset: Dataset, missing: str = "error") -> LidarSource:
    """3D detections in result files.

    Args:
        path: file or folder in the form of the dataset's results, or a run folder.
        class_names: classes to take.
        dataset: whose frames they are of.
        missing: frames without results: ``error``, or ``empty``.

    Raises:
        Lcf3dError: the files are not there, or not in that form.
    """
    return dataset.lidar_results(Path(path).expanduser(), class_names, require_missing(missing))


def camera_results(path: str, class_names: Sequence[str], dataset: Dataset, missing: str = "error") -> CameraSource:
    """2D detections in result files; see `lidar_results`."""
    return dataset.camera_results(Path(path).expanduser(), class_names, require_missing(missing))

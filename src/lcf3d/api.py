"""One-call forms of what the command line does: `run`, `evaluate`, `draw`, and reading and writing of results."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D, Detections3D

if TYPE_CHECKING:
    from PIL import Image

    from lcf3d.datasets.base import Dataset
    from lcf3d.evaluation.protocol import ResultSet, TrackingResult
    from lcf3d.fusion.config import FusionConfig


def run(
    dataset: str,
    lidar: str,
    camera: str | Mapping[str, str],
    out: str | Path,
    *,
    config: str | Path | FusionConfig | None = None,
    jobs: int = 1,
    ray: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Fuse the detections of two detectors on a dataset into a folder: what ``lcf3d run`` does.

    Args:
        dataset: ``kind:ARGUMENT``, for example ``kitti:ROOT``.
        lidar: the LiDAR branch, for example ``results:DIR`` or ``shipped:kitti``.
        camera: the camera branch of all cameras that the dataset uses, or of single ones by name.
        out: the run folder, see `lcf3d.run.folder`.
        config: preset, YAML file or settings; the dataset's preset without it.
        jobs: processes.
        ray: address of a Ray cluster to run on, ``auto`` for that of this machine.
        resume: continue a run that was interrupted.
        overwrite: replace the run that ``out`` holds.
        options: further fields of `lcf3d.run.setup.RunRequest`, for example ``split="val"`` or ``recovery="off"``.

    Returns:
        Counts by outcome and class, notes, and median milliseconds, as ``lcf3d run --json`` prints them.

    Raises:
        Lcf3dError: anything wrong with the request, the dataset or the result files.
    """
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.remote.places import local
    from lcf3d.remote.urls import is_url
    from lcf3d.run.frames import total
    from lcf3d.run.ray_workers import fuse_frames, require_processes
    from lcf3d.run.sequences import pending_frames
    from lcf3d.run.setup import RunRequest, prepare_run

    folder = local(out, new=True)
    settings = config if isinstance(config, FusionConfig) else None
    named = None if config is None or settings is not None else str(config)
    cameras = {"*": camera} if isinstance(camera, str) else dict(camera)
    try:
        request = RunRequest(dataset, lidar, cameras, config=named, **options)
    except TypeError as error:
        raise ConfigError(f"run() does not know that option: {error}") from None
    require_processes(request, jobs, ray)
    prepared = prepare_run(request, folder, resume=resume, overwrite=overwrite, settings=settings)
    pending, sequences = pending_frames(prepared)
    counts = total(list(fuse_frames(prepared, pending, jobs, ray, sequences)))
    prepared.folder.finish(prepared.frame_ids)
    warnings = prepared.warnings()
    for sentence in warnings:
        logging.getLogger(__name__).warning(sentence)
    return {
        **counts,
        "warnings": list(warnings),
        "already_done": len(prepared.frame_ids) - len(pending),
        "out": str(out if is_url(out) else folder),
    }


def _opened(dataset: str | Dataset, split: str | None) -> Dataset:
    """The dataset of that name; one that is open already stays as it is."""
    from lcf3d.datasets.opening import open_dataset

    return open_dataset(dataset, split=split) if isinstance(dataset, str | Path) else dataset


def evaluate(
    dataset: str | Dataset,
    results: str | Path,
    *,
    split: str | None = None,
    frames: Sequence[str] | None = None,
    missing: str = "error",
    **options: Any,
) -> ResultSet:
    """Results measured by the dataset's own metric: what ``lcf3d eval`` does.

    Args:
        dataset: ``kind:ARGUMENT``, or a dataset.
        results: results in the dataset's form, or a run folder.
        split: split of the dataset, where it is given by name.
        frames: only these frames.
        missing: frames without results: ``error``, or ``empty``.
        options: fields of `lcf3d.evaluation.protocol.EvaluationOptions`, for example ``classes=("Car",)``.

    Returns:
        The results, measured: ``to_json()`` has all numbers, ``tables()`` those for people.

    Raises:
        Lcf3dError: labels, results or options are wrong.
    """
    from lcf3d.datasets.base import require_missing
    from lcf3d.evaluation.opening import open_evaluation
    from lcf3d.evaluation.protocol import EvaluationOptions
    from lcf3d.remote.places import local
    from lcf3d.run.conversion import as_files

    data = _opened(dataset, split)
    path = local(results)
    evaluation = open_evaluation(data, frames, EvaluationOptions(**options))
    return evaluation.read(as_files(path, data), path.name, require_missing(missing))


def evaluate_tracking(
    dataset: str | Dataset,
    results: str | Path,
    *,
    split: str | None = None,
    frames: Sequence[str] | None = None,
    missing: str = "error",
    **options: Any,
) -> TrackingResult:
    """Tracks measured by the dataset's own measure: what ``lcf3d eval --tracking`` does.

    Args:
        dataset: ``kind:ARGUMENT``, or a dataset, with labels that have track numbers.
        results: a run folder of ``memory``, or another tracker's results in the dataset's form.
        split: split of the dataset, where it is given by name.
        frames: only these frames.
        missing: frames without tracks: ``error``, or ``empty``.
        options: as of `evaluate`, for example ``classes=("Car",)``.

    Returns:
        The tracks, measured: ``to_json()`` has all numbers, ``table()`` those for people.

    Raises:
        Lcf3dError: labels, tracks or options are wrong.
    """
    from lcf3d.datasets.base import require_missing
    from lcf3d.evaluation.opening import open_tracking
    from lcf3d.evaluation.protocol import EvaluationOptions
    from lcf3d.remote.places import local
    from lcf3d.run.conversion import as_files

    data = _opened(dataset, split)
    measure = open_tracking(data, frames, EvaluationOptions(**options))
    return measure.read(as_files(local(results), data), require_missing(missing))


def draw(
    frame: Frame,
    boxes: FusedDetections | Detections3D | None = None,
    camera: Mapping[str, Detections2D] | None = None,
    *,
    truth: bool = True,
    min_score: float = float("-inf"),
) -> Image.Image:
    """A picture of a frame: its images with boxes, and the bird's-eye view.

    Args:
        frame: what the sensors saw.
        boxes: the result of a fusion, coloured by outcome, or plain 3D detections.
        camera: 2D detections by camera name, to be drawn beside plain 3D detections.
        truth: also draw the labels.
        min_score: leave out boxes of a lower score.
    """
    from lcf3d.visualization.png import draw_frame
    from lcf3d.visualization.scene import Scene

    labels = frame.labels if truth else None
    if isinstance(boxes, FusedDetections):
        return draw_frame(frame, Scene.from_fused(boxes, labels, min_score))
    shown = Detections3D.empty(()) if boxes is None else boxes
    return draw_frame(frame, Scene.from_detections(shown, camera or {}, labels, min_score))


def read_run(folder: str | Path) -> dict[str, FusedDetections]:
    """The fused detections of a run folder, with their reasons, by frame id.

    Raises:
        FormatError: a file is missing or not readable.
        ConfigError: it is no run folder, or one of a later version.
    """
    from lcf3d.remote.places import local
    from lcf3d.run.table_folder import open_run_folder

    run_folder = open_run_folder(local(folder))
    if not run_folder.is_run(run_folder.path):
        raise ConfigError(f"{folder} is no folder of 'lcf3d run': it has no run.json and provenance")
    run_folder.request()
    return {frame_id: run_folder.read(frame_id) for frame_id in run_folder.frame_ids()}

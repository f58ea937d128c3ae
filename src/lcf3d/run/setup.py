"""What a run builds before the first frame: dataset, branches, calibration, fusion, output folder."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource, by_camera, require_frames, require_missing
from lcf3d.datasets.opening import open_dataset
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.files import write_json
from lcf3d.formats.fused_table import arrow
from lcf3d.fusion.calibration import Calibration, load_calibration, memory_settings
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.localizer import Localizer
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.localizers.named import load_localizer
from lcf3d.processes import LOCK
from lcf3d.run.alignment import describe, find_alignment, looked_at, turned_warnings
from lcf3d.run.folder import RunFolder
from lcf3d.run.frames import FrameRunner
from lcf3d.run.joins import left_out_counts, left_out_notes, report_notes, score_notes
from lcf3d.run.settings import build_config
from lcf3d.run.shards import frames_of_shard, parse_shard
from lcf3d.run.sources import CameraOnImages, open_cameras, open_lidar
from lcf3d.run.table_folder import TableRunFolder, require_form
from lcf3d.run.teaching import Looked, find_calibration, look_in_files, reported_classes, teaching_frames

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunRequest:
    """What decides the results of a run; ``lcf3d run`` has an option for each.

    Attributes:
        dataset: ``kind:ARGUMENT``, see `lcf3d.datasets.opening.open_dataset`.
        lidar: the LiDAR branch, ``kind:ARGUMENT``.
        cameras: the camera branch by camera name; under the name ``*`` that of all cameras the dataset uses.
        split: name of a split of the dataset; all frames without it.
        tables: nuScenes: folder of tables.
        frames: only these frames.
        config: preset or YAML file; the dataset's preset without it.
        changes: ``name=value`` settings on top of it.
        recovery: ``on`` or ``off``; as the settings say without it.
        localizer: ``kind:ARGUMENT``, for recovery.
        tiles: overlapping tiles across wide images, for camera detectors that know them.
        calibration: file of ``lcf3d calibrate``, ``auto`` or ``none``.
        self_calibrate: turn each camera as the matches of the whole drive say, see `lcf3d.run.alignment`.
        missing: result files that are not there: ``error`` or ``empty``.
        memory: whether recent frames of a sequence testify too, see `lcf3d.fusion.memory`.
        smooth: whether later ones do as well, see `lcf3d.fusion.memory_smooth`.
        shard: ``i/n``: only that part of the frames, see `lcf3d.run.shards`.
        form: of the run folder: ``folder`` or ``parquet``.
    """

    dataset: str
    lidar: str
    cameras: dict[str, str]
    split: str | None = None
    tables: str | None = None
    frames: tuple[str, ...] = ()
    config: str | None = None
    changes: tuple[str, ...] = ()
    recovery: str | None = None
    localizer: str = "geometric"
    tiles: int = 1
    calibration: str = "auto"
    missing: str = "error"
    self_calibrate: bool = False
    memory: bool = False
    smooth: bool = False
    shard: str | None = None
    form: str = "folder"


class Inputs(NamedTuple):
    """What a run reads: dataset, frames, settings, the LiDAR branch, the branch of each camera, the localizer."""

    dataset: Dataset
    frame_ids: tuple[str, ...]
    config: FusionConfig
    lidar: LidarSource
    cameras: dict[str, CameraSource]
    localizer: Localizer


@dataclass(frozen=True)
class Run:
    """A run ready to begin.

    Attributes:
        dataset: whose frames they are.
        frame_ids: the frames.
        config: settings.
        runner: what to do with a frame.
        folder: where results go.
        request: what was asked for.
        notes: what of the inputs is left out, and which classes no camera is asked about; once a run.
    """

    dataset: Dataset
    frame_ids: tuple[str, ...]
    config: FusionConfig
    runner: FrameRunner
    folder: RunFolder
    request: RunRequest
    notes: tuple[str, ...] = ()

    def warnings(self) -> tuple[str, ...]:
        """What the finished run shows to be wrong with its inputs: cameras that are turned."""
        if self.request.self_calibrate:
            return ()
        done = [frame_id for frame_id in self.frame_ids if self.folder.is_done(frame_id)]
        return turned_warnings(self.dataset, done, self.folder.read, self.config.class_names)


def prepare_run(
    request: RunRequest,
    out: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    settings: FusionConfig | None = None,
) -> Run:
    """Read and check everything that can be checked, then begin the output folder.

    Args:
        request: what to run.
        out: the run folder.
        resume: continue a run that was interrupted.
        overwrite: replace the run that ``out`` holds.
        settings: instead of those that the request names.

    Raises:
        Lcf3dError: anything wrong with the request, the dataset or the result files.
    """
    _require_possible(request)
    if not (out / LOCK).exists():
        # else somebody writes there, which `begin` says
        RunFolder(out).require_place(request.form, resume=resume, overwrite=overwrite)
    inputs = read_inputs(request, settings=settings)
    dataset, frame_ids, config, lidar, cameras, localizer = inputs
    own_ids = frames_of_shard(frame_ids, request.shard)
    folder = TableRunFolder(out) if request.form == "parquet" else RunFolder(out, dataset.writer(out))
    fusion = make_fusion(config, localizer)
    runner = FrameRunner(dataset, lidar, cameras, fusion, folder, smooth=request.smooth)
    from lcf3d import __version__

    # checked before anything is written; with results in files this is quick
    reports = find_alignment(dataset, frame_ids, lidar, cameras, config.class_names) if request.self_calibrate else {}
    runner.alignment = {name: whole.alignment for name, (whole, *_) in reports.items()}
    looked = look_in_files(dataset, frame_ids, cameras)
    if resume and folder.calibration_path.is_file():
        calibration: Calibration | None = Calibration.load(folder.calibration_path)
    else:
        calibration = find_calibration(
            request.calibration, dataset, frame_ids, lidar, cameras, config, runner.alignment, looked
        )
    runner.fusion, notes = calibrated_fusion(inputs, calibration, looked)
    written: dict[str, Any] = {
        "lcf3d": __version__,
        **asdict(request),
        "left_out": left_out_counts(lidar, cameras),
        "notes": list(notes),
    }
    folder.begin(config, _as_json(written), resume=resume, overwrite=overwrite)
    if reports:
        write_json(folder.alignment_path, {name: whole.to_json() for name, (whole, *_) in reports.items()})
        for name, (whole, *_) in reports.items():
            log.warning("camera %s: %s (%s)", name, describe(whole), whole.status)
    if calibration is not None:
        calibration.dump(folder.calibration_path)
    if request.memory or request.smooth:
        runner.memory = memory_settings(calibration)
    return Run(dataset, own_ids, config, runner, folder, request, notes)


def _require_possible(request: RunRequest) -> None:
    """Refuse, before anything is read, what cannot be run.

    Raises:
        Lcf3dError: says what.
    """
    require_form(request.form)
    if request.form == "parquet":
        arrow()
    if request.shard is not None:
        parse_shard(request.shard)
        if request.memory or request.smooth:
            raise ConfigError("--shard takes drives apart, and --memory and --smooth need them whole; leave one out")
    if request.calibration != "auto":
        load_calibration(request.calibration)


def read_inputs(
    request: RunRequest,
    usual: Callable[[Dataset], Sequence[str]] | None = None,
    settings: FusionConfig | None = None,
    look: bool = True,
) -> Inputs:
    """The dataset, settings and both branches, result files read and images looked for.

    Args:
        request: what to read.
        usual: the frames to take where neither a split nor frames are named; all without it.
        settings: instead of those that the request names.
        look: read all result files and look for images; else each is read when its frame comes.

    Raises:
        Lcf3dError: anything wrong with the request, the dataset or the result files.
    """
    require_missing(request.missing)
    dataset = open_dataset(request.dataset, split=request.split, version=request.tables)
    texts = camera_texts(request.cameras, dataset)
    config = settings or build_config(
        request.config or dataset.preset, request.changes, _is_stereo(texts, dataset), dataset.class_names
    )
    if request.recovery is not None:
        if request.recovery not in ("on", "off"):
            raise ConfigError(f"--recovery takes on or off, got {request.recovery!r}")
        config = config.updated(recovery=request.recovery == "on")
    chosen: Sequence[str] = request.frames
    if usual is not None and not chosen and request.split is None:
        chosen = usual(dataset)
    frame_ids = require_frames(dataset, chosen, request.dataset)
    if look:
        dataset.require_complete(frame_ids)
    lidar = open_lidar(request.lidar, dataset, config.class_names, request.missing)
    cameras = by_camera(dataset, open_cameras(texts, dataset, config.class_names, request.missing, request.tiles))
    loaded = load_localizer(request.localizer)
    if look:
        _load((lidar, *cameras.values()), frame_ids, request, cameras)
        _require_images(dataset, frame_ids, cameras)
    return Inputs(dataset, frame_ids, config, lidar, cameras, loaded)


def _load(
    sources: Sequence[object], frame_ids: Sequence[str], request: RunRequest, cameras: Mapping[str, CameraSource]
) -> None:
    """Read result files: those of all frames, or of a shard its own and those that the whole run learns from."""
    parts: list[Sequence[str]] = [frame_ids]
    if request.shard is not None:
        learned = set(teaching_frames(frame_ids))
        if request.self_calibrate:
            learned.update(looked_at(frame_ids, cameras))
        # last its own, which are counted
        parts = [[one for one in frame_ids if one in learned], frames_of_shard(frame_ids, request.shard)]
    for source in sources:
        if hasattr(source, "load"):
            for part in parts if getattr(source, "reads_frames", False) else [frame_ids]:
                if part:
                    source.load(part)


def camera_texts(cameras: dict[str, str], dataset: Dataset) -> dict[str, str]:
    """The detector of each camera by its name: ``*`` stands for those that the dataset uses.

    Raises:
        ConfigError: the left or right camera of a stereo pair is named and the dataset has none.
    """
    texts: dict[str, str] = {}
    for name, text in cameras.items():
        if name in ("left", "right") and name not in dataset.camera_names:
            if dataset.stereo_pair is None:
                raise ConfigError(
                    "--camera-left and --camera-right are for a stereo pair, which this dataset does not have; "
                    f"--camera is for {', '.join(dataset.used_cameras)}"
                )
            name = dataset.stereo_pair[name == "right"]
        texts.update(dict.fromkeys(dataset.used_cameras, text) if name == "*" else {name: text})
    return texts


def _is_stereo(texts: dict[str, str], dataset: Dataset) -> bool:
    return dataset.stereo_pair is not None and set(dataset.stereo_pair) <= set(texts)


def _as_json(value: dict[str, Any]) -> dict[str, Any]:
    """Tuples as lists, as they come back from a file."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()}


def _require_images(dataset: Dataset, frame_ids: Sequence[str], cameras: dict[str, CameraSource]) -> None:
    """See that every camera has an image in some frame, if its detector needs images.

    Raises:
        DatasetError: one has none, or (where a detector sees several cameras) none of them has one.
    """
    by_source: dict[int, list[str]] = {}
    for name, source in cameras.items():
        if isinstance(source, CameraOnImages):
            by_source.setdefault(id(source), []).append(name)
    for names in by_source.values():
        if not any(dataset.has_image(frame_id, name) for frame_id in frame_ids for name in names):
            raise DatasetError(
                f"no frame of the run has an image of the {' or '.join(names)} camera; "
                "add the images, or pass results:PATH as its detector"
            )


def make_fusion(
    config: FusionConfig,
    localizer: Localizer,
    calibration: Calibration | None = None,
    reports: Mapping[str, Collection[str]] | None = None,
) -> LateCascadeFusion:
    """The fusion that belongs to some settings: that of stereo pairs for `StereoConfig`."""
    if isinstance(config, StereoConfig):
        return StereoLateCascadeFusion(config, localizer, calibration=calibration, reports=reports)
    return LateCascadeFusion(config, localizer, calibration=calibration, reports=reports)


def calibrated_fusion(
    inputs: Inputs, calibration: Calibration | None, looked: Looked | None = None
) -> tuple[LateCascadeFusion, tuple[str, ...]]:
    """The fusion that runs, and what is to be said once: what is left out, and which classes no camera is asked about.

    Args:
        inputs: of the run.
        calibration: of the scores.
        looked: what `look_in_files` gave for them, where that is known.

    Raises:
        ConfigError: scores that are no probabilities and have no score map.
    """
    for source, maps in ((inputs.lidar, "lidar"), *((camera, "camera") for camera in inputs.cameras.values())):
        require = getattr(source, "require_probabilities", None)
        if require is not None:
            require(getattr(calibration, maps) if calibration else ())
    if looked is None:
        looked = look_in_files(inputs.dataset, inputs.frame_ids, inputs.cameras)
    reported = reported_classes(inputs.cameras, inputs.config, len(inputs.frame_ids), looked)
    notes = (
        *left_out_notes(inputs.lidar, inputs.cameras),
        *report_notes(reported, inputs.config),
        *score_notes(inputs.config),
    )
    return make_fusion(inputs.config, inputs.localizer, calibration, reported), notes

"""What ``lcf3d run`` builds before the first frame: dataset, branches, calibration, fusion, output folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import typer

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.datasets.nuscenes_tables import CAMERAS as NUSCENES_CAMERAS
from lcf3d.datasets.opening import parse_dataset
from lcf3d.detectors.named import load_detector
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.fusion.calibration import Calibration, load_calibration
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.localizer import Localizer
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.fusion.self_calibration import self_calibrate
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.localizers.named import load_localizer
from lcf3d.plugins import parse as parse_spec
from lcf3d.run.folder import KittiRunFolder, NuscenesRunFolder, RunFolder
from lcf3d.run.frames import FrameRunner
from lcf3d.run.results import KittiResults, NuscenesCameraResults, NuscenesLidarResults
from lcf3d.run.settings import build_config
from lcf3d.run.sources import CameraOnImages, CameraSource, LidarOnScans, LidarSource

Dataset = KittiDataset | NuscenesDataset

# frames that a calibration without labels looks at, evenly over the run
TEACHING_FRAMES = 400
# the same where a camera detector has to be run on them
TEACHING_IMAGES = 40
# with fewer frames than this, a class that the camera branch did not detect may just not have been there
FEW_FRAMES = 100


@dataclass(frozen=True)
class RunRequest:
    """The options of ``lcf3d run`` that decide what comes out."""

    dataset: str
    lidar: str
    cameras: dict[str, str]
    split: str | None = None
    version: str | None = None
    frames: tuple[str, ...] = ()
    config: str | None = None
    changes: tuple[str, ...] = ()
    recovery: str | None = None
    localizer: str = "geometric"
    tiles: int = 1
    calibration: str = "auto"
    missing: str = "error"


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
    """A run ready to begin."""

    dataset: Dataset
    frame_ids: tuple[str, ...]
    config: FusionConfig
    runner: FrameRunner
    folder: RunFolder


def prepare_run(request: RunRequest, out: Path, *, resume: bool, overwrite: bool) -> Run:
    """Read and check everything that can be checked, then begin the output folder.

    Raises:
        Lcf3dError: anything wrong with the request, the dataset or the result files.
    """
    dataset, frame_ids, config, lidar, cameras, localizer = read_inputs(request)
    folder = KittiRunFolder(out) if isinstance(dataset, KittiDataset) else NuscenesRunFolder(out, dataset)
    runner = FrameRunner(dataset, lidar, cameras, _fusion(config, localizer, None), folder)
    from lcf3d import __version__

    # checked before anything is written; with results in files this is quick
    calibration = _calibration(request, runner, frame_ids, config, folder if resume else None)
    for source, maps in ((lidar, "lidar"), *((camera, "camera") for camera in cameras.values())):
        if isinstance(source, KittiResults):
            source.require_probabilities(getattr(calibration, maps) if calibration else ())
    written: dict[str, Any] = {"lcf3d": __version__, **asdict(request)}
    folder.begin(config, _as_json(written), resume=resume, overwrite=overwrite)
    if calibration is not None:
        calibration.dump(folder.calibration_path)
        runner.fusion = _fusion(config, localizer, calibration)
    return Run(dataset, frame_ids, config, runner, folder)


def read_inputs(request: RunRequest) -> Inputs:
    """The dataset, settings and both branches, result files read and images looked for.

    Raises:
        Lcf3dError: anything wrong with the request, the dataset or the result files.
    """
    kind, root = parse_dataset(request.dataset)
    config = _config(request, kind)
    dataset = _dataset(request, kind, root, config)
    frame_ids = _frame_ids(request, dataset)
    lidar = _lidar_source(request, dataset, config)
    cameras = _camera_sources(request, dataset, config)
    for source in (lidar, *cameras.values()):
        if isinstance(source, KittiResults):
            source.load(frame_ids)
    _require_images(dataset, frame_ids, cameras)
    return Inputs(dataset, frame_ids, config, lidar, cameras, load_localizer(request.localizer))


def _as_json(value: dict[str, Any]) -> dict[str, Any]:
    """Tuples as lists, as they come back from a file."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()}


def _config(request: RunRequest, kind: str) -> FusionConfig:
    config = build_config(request.config or kind, list(request.changes), stereo=len(request.cameras) > 1)
    if request.recovery is None:
        return config
    if request.recovery not in ("on", "off"):
        raise ConfigError(f"--recovery takes on or off, got {request.recovery!r}")
    return config.updated(recovery=request.recovery == "on")


def _dataset(request: RunRequest, kind: str, root: Path, config: FusionConfig) -> Dataset:
    if kind == "kitti":
        dataset = KittiDataset(root, request.split, class_names=config.class_names)
        dataset.require_calibrations()
        return dataset
    if len(request.cameras) > 1:
        raise ConfigError("--camera-left and --camera-right are for KITTI layout; nuScenes uses --camera for all six")
    return NuscenesDataset(root, request.version, request.split, late_cameras="drop")


def _frame_ids(request: RunRequest, dataset: Dataset) -> tuple[str, ...]:
    known = set(dataset.ids)
    for frame_id in request.frames:
        if frame_id not in known:
            raise ConfigError(f"{request.dataset} has no frame {frame_id!r} in split {request.split!r}")
    return request.frames or dataset.ids


def _lidar_source(request: RunRequest, dataset: Dataset, config: FusionConfig) -> LidarSource:
    spec = parse_spec(request.lidar)
    if spec.kind == "results" and isinstance(dataset, NuscenesDataset):
        return NuscenesLidarResults(spec.argument, dataset, config.class_names)
    loaded: Any = load_detector(request.lidar, "lidar", config.class_names, {"missing": request.missing})
    return loaded if hasattr(loaded, "detect") else LidarOnScans(loaded)


def _camera_sources(request: RunRequest, dataset: Dataset, config: FusionConfig) -> dict[str, CameraSource]:
    """The source of each camera used; a detector named twice is loaded once."""
    by_text: dict[str, CameraSource] = {}
    for text in request.cameras.values():
        if text not in by_text:
            by_text[text] = _camera_source(text, request, dataset, config)
    if isinstance(dataset, NuscenesDataset):
        (source,) = by_text.values()
        return dict.fromkeys(NUSCENES_CAMERAS, source)
    return {name: by_text[text] for name, text in request.cameras.items()}


def _camera_source(text: str, request: RunRequest, dataset: Dataset, config: FusionConfig) -> CameraSource:
    spec = parse_spec(text)
    if spec.kind == "results" and isinstance(dataset, NuscenesDataset):
        return NuscenesCameraResults(spec.argument, config.class_names)
    defaults: dict[str, int | float | bool | str] = {"missing": request.missing}
    if request.tiles > 1:
        defaults["tiles"] = request.tiles
    loaded: Any = load_detector(text, "camera", config.class_names, defaults)
    return loaded if hasattr(loaded, "detect") else CameraOnImages(loaded)


def _require_images(dataset: Dataset, frame_ids: Sequence[str], cameras: dict[str, CameraSource]) -> None:
    """See that every camera asked for by name has an image in some frame, if its detector needs images."""
    if not isinstance(dataset, KittiDataset):
        return
    for name, source in cameras.items():
        if isinstance(source, CameraOnImages) and not any(name in dataset.image_paths(i) for i in frame_ids):
            raise DatasetError(
                f"no frame of the run has an image of the {name} camera in {dataset.folder}; "
                "add the images, or pass results:DIR as its detector"
            )


def _fusion(config: FusionConfig, localizer: Localizer, calibration: Calibration | None) -> LateCascadeFusion:
    if isinstance(config, StereoConfig):
        return StereoLateCascadeFusion(config, localizer, calibration=calibration)
    return LateCascadeFusion(config, localizer, calibration=calibration)


def _calibration(
    request: RunRequest, runner: FrameRunner, frame_ids: Sequence[str], config: FusionConfig, resumed: RunFolder | None
) -> Calibration | None:
    """The calibration of the file asked for, or one taught by the camera, where that is needed or costs nothing.

    Raises:
        ConfigError: scores outside [0, 1] that nothing calibrates.
    """
    if resumed is not None and resumed.calibration_path.is_file():
        return Calibration.load(resumed.calibration_path)
    if request.calibration != "auto":
        return load_calibration(request.calibration)
    if isinstance(runner.lidar, LidarOnScans):
        return None
    low, high = _score_range(runner, frame_ids)
    probabilities = low >= 0 and high <= 1
    in_files = all(not isinstance(source, CameraOnImages) for source in runner.cameras.values())
    # probabilities need no map, but evidence also asks which classes the camera knows, which files tell at no cost
    if probabilities and not (config.ensemble == "evidence" and in_files and len(frame_ids) >= FEW_FRAMES):
        return None
    chosen = frame_ids[:: -(-len(frame_ids) // (TEACHING_FRAMES if in_files else TEACHING_IMAGES))]
    if not probabilities:
        typer.echo(
            f"LiDAR scores go from {low:.4g} to {high:.4g} and are no probabilities: calibrated without labels on "
            f"{len(chosen)} frames, with the camera as teacher; 'lcf3d calibrate' on labelled frames does better",
            err=True,
        )
    teaching = []
    for frame_id in chosen:
        frame = runner.dataset.frame(frame_id)
        found = runner.detect_cameras(frame)
        if found:
            teaching.append((frame, runner.lidar.detect(frame), next(iter(found.values()))))
    calibration = self_calibrate(teaching, config)
    if len(chosen) < FEW_FRAMES:
        calibration = calibration.model_copy(update={"camera_classes": None})
    return calibration


def _score_range(runner: FrameRunner, frame_ids: Sequence[str]) -> tuple[float, float]:
    """Lowest and highest score of the LiDAR branch over all frames, 0 and 0 without any."""
    low, high = 0.0, 0.0
    for frame_id in frame_ids:
        scores = runner.lidar.detect(runner.dataset.frame(frame_id)).scores
        if len(scores):
            low, high = min(low, float(scores.min())), max(high, float(scores.max()))
    return low, high

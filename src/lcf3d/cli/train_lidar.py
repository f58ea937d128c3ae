"""``lcf3d train lidar``: the small LiDAR detector, on simulated scans, a KITTI folder or nuScenes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from lcf3d.detectors.fusion.painters import Painter
    from lcf3d.detectors.lidar.config import LidarConfig
    from lcf3d.training.lidar import LidarTask
    from lcf3d.training.lidar_scans import ScanSource
    from lcf3d.training.samples import SampleRecipe

VALIDATED = 24
"""Held-out scans that are looked at after each checkpoint; all of them at the end."""


def lidar(
    dataset: Annotated[
        str, typer.Argument(help="kitti:ROOT or nuscenes:ROOT with scans and labels; simulated scans if left out")
    ] = "",
    out: Annotated[Path, typer.Option(help="folder for checkpoints and the finished lidar.onnx")] = Path("train-lidar"),
    split: Annotated[
        str | None, typer.Option(help="file of ROOT/ImageSets, or nuScenes split; all if left out")
    ] = None,
    version: Annotated[str | None, typer.Option(help="folder of nuScenes tables; the only one if left out")] = None,
    preset: Annotated[str, typer.Option(help="sensor and world that are simulated")] = "kitti64",
    density: Annotated[float, typer.Option(min=0.1, help="factor on the number of simulated road users")] = 1.0,
    frames: Annotated[int, typer.Option(min=2, help="simulated scans")] = 1000,
    samples_seed: Annotated[int, typer.Option(min=0, help="of the simulated scans")] = 1001,
    samples: Annotated[Path | None, typer.Option(help="folder of simulated scans; default: the user's cache")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="processes that simulate")] = 1,
    held_out: Annotated[
        int | None, typer.Option(min=1, help="scans at the end to measure with; 100, or a fifth of few, if left out")
    ] = None,
    steps: Annotated[int, typer.Option(min=1)] = 3600,
    batch_size: Annotated[int, typer.Option(min=1, help="windows a step, 36 m x 38 m each, two of a scan")] = 4,
    learning_rate: Annotated[float, typer.Option(help="highest one of the schedule")] = 3e-3,
    tilt: Annotated[float, typer.Option(min=0, help="degrees that scans are tilted by at most")] = 0.0,
    paint: Annotated[
        str,
        typer.Option(help="PointPainting: what gives points class scores, for example masks:shipped:kitti"),
    ] = "",
    frustums: Annotated[
        str,
        typer.Option(help="Frustum PointPillars: whose boxes cut frustums, for example shipped:kitti"),
    ] = "",
    init: Annotated[
        str, typer.Option(help="weights to begin with: last.pt of another training, lidar.onnx, or shipped:kitti")
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="of weights and batches")] = 0,
    checkpoint_every: Annotated[int, typer.Option(min=1, help="steps between checkpoints and validations")] = 500,
    workers: Annotated[int, typer.Option(min=0, help="processes that prepare batches")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="threads of torch; 0 leaves it to torch")] = 0,
    device: Annotated[str, typer.Option(help="torch's name of the device to train on")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="go on from the folder's last checkpoint")] = False,
) -> None:
    """Train the small LiDAR detector (Car, Pedestrian, Cyclist) and write it as lidar.onnx.

    Examples:

    lcf3d train lidar --out train-lidar

    lcf3d train lidar kitti:KITTI --split train --init train-lidar/last.pt --out train-lidar-kitti
    """
    from lcf3d.cli.train_common import beginning, held_out_of, train_with_progress
    from lcf3d.detectors.lidar.kinds import shipped_path
    from lcf3d.training.lidar import LidarTask, objects_of
    from lcf3d.training.lidar_augmentation import AugmentationSettings
    from lcf3d.training.loop import TrainingSettings, import_torch, require_device, require_unused
    from lcf3d.training.samples import SampleRecipe

    torch = import_torch()
    require_device(device)
    if threads:
        torch.set_num_threads(threads)
    recipe = SampleRecipe("lidar", preset, frames, samples_seed, density=density)
    config, painter = _painting(paint, frustums, dataset)
    start, begin = beginning(init, shipped_path)
    if not resume:
        require_unused(out)
    scans = _scans(dataset, split, version, recipe, samples, jobs, painter)
    learned, measured = scans.hold_out(held_out_of(scans.count, held_out, 100))
    objects = objects_of(learned, config)
    task = LidarTask(
        learned,
        measured.part(0, VALIDATED),
        config=config,
        batch_size=batch_size,
        augmentation=AugmentationSettings(tilt=math.radians(tilt)),
        objects=objects,
        data=f"{dataset} {split or ''} {version or ''}".strip() if dataset else recipe.folder,
        begin=begin,
    )
    settings = TrainingSettings(
        steps, learning_rate, seed=seed, average=0.998, checkpoint_every=checkpoint_every, workers=workers
    )
    network = train_with_progress(task, settings, out, resume, start, device)
    _write(LidarTask(learned, measured, config=config), network, out)


def _write(task: LidarTask, network: Any, out: Path) -> None:
    """Write the trained network and its figures on the held-out scans."""
    from lcf3d.detectors.lidar.export import export_onnx
    from lcf3d.files import write_json
    from lcf3d.training.lidar import trained_detector

    export_onnx(trained_detector(network, task.config), out / "lidar.onnx")
    figures = task.validate(network)
    write_json(out / "figures.json", figures)
    for name in (f"AP {name}" for name in task.config.class_names):
        # a class that no held-out scan has, has no AP
        typer.echo(f"{name:<20}{figures[name]:>9.3f}" if name in figures else f"{name:<20}{'-':>9}")


def _painting(paint: str, frustums: str, dataset: str) -> tuple[LidarConfig, Painter | None]:
    """The network's configuration, and what gives its points class scores."""
    from lcf3d.detectors.fusion.frustum_pillars import frustum_painter
    from lcf3d.detectors.fusion.painters import load_painter
    from lcf3d.detectors.lidar.presets import COMPACT_KITTI, painted_config
    from lcf3d.errors import ConfigError

    if not paint and not frustums:
        return COMPACT_KITTI, None
    if paint and frustums:
        raise ConfigError("--paint and --frustums are two networks; train one at a time")
    if not dataset.startswith("kitti:"):
        raise ConfigError("painting needs images beside the scans; name a KITTI folder, for example kitti:ROOT")
    if paint:
        return painted_config(paint), load_painter(paint, COMPACT_KITTI.class_names)
    return painted_config(frustums, only_painted=True), frustum_painter(frustums, COMPACT_KITTI.class_names)


def _scans(
    dataset: str,
    split: str | None,
    version: str | None,
    recipe: SampleRecipe,
    samples: Path | None,
    jobs: int,
    painter: Painter | None = None,
) -> ScanSource:
    from lcf3d.structures import KITTI_CLASSES
    from lcf3d.training.lidar_scans import dataset_scans, simulated_scans

    if dataset:
        return dataset_scans(dataset, split, KITTI_CLASSES, version, painter)
    from lcf3d.cli.train_common import prepare_samples
    from lcf3d.training.recipes import default_samples_root

    return simulated_scans(prepare_samples(recipe, samples or default_samples_root(), jobs), KITTI_CLASSES)

"""``lcf3d train camera``: the small camera detector, on simulated images or a KITTI folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.training.camera import CameraTask
    from lcf3d.training.camera_images import LabelledImage
    from lcf3d.training.samples import SampleRecipe

# of KITTI's resolution, at which the detector looks at its images
SAMPLE_SCALE = 0.67


def camera(
    dataset: Annotated[
        str, typer.Argument(help="kitti:ROOT with images and labels; simulated images if left out")
    ] = "",
    out: Annotated[Path, typer.Option(help="folder for checkpoints and the finished camera.onnx")] = Path(
        "train-camera"
    ),
    split: Annotated[str, typer.Option(help="file of ROOT/ImageSets")] = "train",
    masks: Annotated[bool, typer.Option(help="learn instance masks; a KITTI folder has none")] = True,
    frames: Annotated[int, typer.Option(min=2, help="simulated images")] = 510,
    preset: Annotated[str, typer.Option(help="sensor and world that are simulated")] = "kitti64",
    density: Annotated[float, typer.Option(min=0.1, help="factor on the number of simulated road users")] = 1.0,
    samples_seed: Annotated[int, typer.Option(min=0, help="of the simulated images")] = 1002,
    samples: Annotated[Path | None, typer.Option(help="folder of simulated images; default: the user's cache")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="processes that simulate")] = 1,
    held_out: Annotated[
        int | None,
        typer.Option(min=1, help="images at the end to calibrate and measure with; 50, or a fifth of few, if left out"),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="batches of the whole training")] = 2600,
    batch_size: Annotated[int, typer.Option(min=1, help="views a step, 192 x 416 pixels each")] = 8,
    learning_rate: Annotated[float, typer.Option(help="highest one of the schedule")] = 3e-3,
    seed: Annotated[int, typer.Option(min=0, help="of weights and batches")] = 0,
    checkpoint_every: Annotated[int, typer.Option(min=1, help="steps between checkpoints and validations")] = 650,
    workers: Annotated[int, typer.Option(min=0, help="processes that prepare batches")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="threads of torch; 0 leaves it to torch")] = 0,
    init: Annotated[
        str,
        typer.Option(help="weights to begin with: last.pt of another training, a camera.onnx, or shipped:kitti"),
    ] = "",
    device: Annotated[str, typer.Option(help="torch's name of the device to train on")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="go on from the folder's last checkpoint")] = False,
) -> None:
    """Train the small camera detector (Car, Pedestrian, Cyclist) and write it as camera.onnx.

    Examples:

    lcf3d train camera --out train-camera

    lcf3d train camera kitti:KITTI --split train --no-masks --init shipped:kitti --out train-camera-kitti
    """
    from lcf3d.cli.train_common import beginning, held_out_of, train_with_progress
    from lcf3d.detectors.camera.small import shipped_path
    from lcf3d.detectors.camera.small_network import SmallConfig
    from lcf3d.training.camera import CameraTask
    from lcf3d.training.loop import TrainingSettings, import_torch, require_device, require_unused
    from lcf3d.training.samples import SampleRecipe

    torch = import_torch()
    require_device(device)
    if threads:
        torch.set_num_threads(threads)
    start, begin = beginning(init, shipped_path)
    if not resume:
        require_unused(out)
    recipe = SampleRecipe("camera", preset, frames, samples_seed, SAMPLE_SCALE, density)
    if dataset:
        if masks:
            raise ConfigError(f"{dataset} has no instance masks to learn from; add --no-masks")
        images = _kitti_images(dataset, split)
    else:
        images = _simulated_images(recipe, samples, jobs, masks)
    last = held_out_of(len(images), held_out, 50)
    config = SmallConfig() if masks else SmallConfig(prototypes=0)
    data = f"{dataset} {split}" if dataset else recipe.folder
    task = CameraTask(images[:-last], images[-last:], config, batch_size, data=data, begin=begin)
    settings = TrainingSettings(
        steps, learning_rate, seed=seed, average=0.998, checkpoint_every=checkpoint_every, workers=workers
    )
    network = train_with_progress(task, settings, out, resume, start, device)
    _finish(task, network, out)


def _finish(task: CameraTask, network: Any, out: Path) -> None:
    """Calibrate the network's scores, write it with its figures, and say where it is."""
    from dataclasses import replace

    from lcf3d.detectors.camera.small_export import export_small
    from lcf3d.files import write_json
    from lcf3d.training.camera_calibration import calibrate

    # scores are fitted on one half of the held-out images, figures are of the other
    fitted = task.held_out[::2]
    task = replace(task, held_out=task.held_out[1::2])
    if not task.held_out:
        typer.echo("one image is held out: scores are calibrated on it, and there is none left for figures", err=True)
    calibrate(network, fitted)
    export_small(network, out / "camera.onnx")
    figures = task.validate(network)
    write_json(out / "figures.json", figures)
    for name, value in figures.items():
        typer.echo(f"{name:<20}{value:>9}")
    typer.echo(f"detector: {out / 'camera.onnx'} (use it as onnx:{out / 'camera.onnx'})")


def _simulated_images(recipe: SampleRecipe, root: Path | None, jobs: int, masks: bool) -> list[LabelledImage]:
    from lcf3d.cli.train_common import prepare_samples
    from lcf3d.training.camera_images import read_samples
    from lcf3d.training.recipes import default_samples_root

    return read_samples(prepare_samples(recipe, default_samples_root() if root is None else root, jobs), masks)


def _kitti_images(dataset: str, split: str) -> list[LabelledImage]:
    from lcf3d.datasets.opening import root_of
    from lcf3d.detectors.camera.small import INPUT_SIZE
    from lcf3d.training.camera_images import read_kitti

    _, root = root_of(dataset, ("kitti",), "lcf3d train camera")
    return read_kitti(root, split, INPUT_SIZE)

"""``lcf3d train localizer``: a frustum network, from simulated scans or from a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.localizers.spec import LocalizerSpec
    from lcf3d.training.frustums import PooledFrustum
    from lcf3d.training.recipes import LocalizerRecipe


def localizer(
    out: Annotated[Path, typer.Option(help="folder for checkpoints, curves and the finished network")],
    data: Annotated[
        str | None, typer.Argument(help="kitti:ROOT or nuscenes:ROOT with scans and labels; simulated if left out")
    ] = None,
    classes: Annotated[str, typer.Option(help="classes, sizes and recipe: kitti or nuscenes")] = "kitti",
    split: Annotated[str | None, typer.Option(help="training split of DATA")] = None,
    val_split: Annotated[str | None, typer.Option(help="validation split of DATA")] = None,
    form: Annotated[str, typer.Option(help="v1 (PointNet, ONNX), or v2 (PointNet++ of the LCF3D authors)")] = "v1",
    variant: Annotated[str, typer.Option(help="proposals: all, box, stereo, mask or box+mask")] = "all",
    steps: Annotated[int | None, typer.Option(min=1, help="batches; the recipe's number if left out")] = None,
    batch_size: Annotated[int | None, typer.Option(min=2, help="frustums a batch")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="highest learning rate")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="of weights and batches")] = None,
    samples: Annotated[Path | None, typer.Option(help="folder that keeps simulated samples")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="processes that simulate")] = 2,
    init: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="last.pt of another training, whose weights this one begins with"
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="torch's name of the device to train on")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="go on with a training that was interrupted")] = False,
) -> None:
    """Train a frustum localizer; without DATA on simulated scans, which rebuilds the network that is shipped.

    lcf3d train localizer --out localizer

    lcf3d train localizer kitti:KITTI --split train --val-split val --out mine

    Several processes: torchrun --nproc-per-node 2 -m lcf3d train localizer --out localizer
    """
    from dataclasses import replace

    from lcf3d.cli.train_common import train_with_progress
    from lcf3d.localizers.spec import LocalizerSpec
    from lcf3d.training.localizer import LocalizerTask
    from lcf3d.training.loop import require_device, require_unused
    from lcf3d.training.recipes import VARIANTS, recipe_of

    require_device(device)
    if not resume:
        require_unused(out)
    recipe = recipe_of(classes)
    if variant not in VARIANTS:
        raise ConfigError(f"--variant takes {', '.join(VARIANTS)}, got {variant!r}")
    if form not in ("v1", "v2"):
        raise ConfigError(f"--form takes v1 or v2, got {form!r}")
    spec = LocalizerSpec.of(cast("Literal['v1', 'v2']", form), classes)
    given: dict[str, Any] = {"steps": steps, "learning_rate": learning_rate, "seed": seed}
    settings = replace(recipe.settings, **{name: value for name, value in given.items() if value is not None})
    pool, held_out = _pools(recipe, spec, data, split, val_split, samples, jobs)
    source = f"{data} {split or ''}".strip() if data else recipe.samples.folder
    size = batch_size or recipe.batch_size
    task = LocalizerTask(spec, pool, held_out, size, VARIANTS[variant], recipe.shares, data=source)
    network = train_with_progress(task, settings, out, resume, init, device)
    path = _save(network, spec, out)
    typer.echo(f"{path}: use it with lcf3d run --localizer {'onnx' if form == 'v1' else 'frustum-pointnet'}:{path}")


def _pools(
    recipe: LocalizerRecipe,
    spec: LocalizerSpec,
    data: str | None,
    split: str | None,
    val_split: str | None,
    samples: Path | None,
    jobs: int,
) -> tuple[list[PooledFrustum], list[PooledFrustum]]:
    """Training and held-out frustums, from the dataset or the recipe's simulated scans."""
    from lcf3d.cli.train_common import prepare_samples
    from lcf3d.training.frustums import collect, scenes_of_dataset, scenes_of_samples
    from lcf3d.training.recipes import default_samples_root, training_cameras

    labels = {name: k for k, name in enumerate(spec.class_names)}
    labels |= {other: labels[name] for other, name in recipe.synonyms.items()}
    if data is not None:
        pool = collect(_counted(scenes_of_dataset(data, split)), labels, seed=0)
        held_out = collect(scenes_of_dataset(data, val_split), labels, seed=1) if val_split else []
        return pool, held_out
    if split or val_split:
        raise ConfigError("--split and --val-split are for a dataset; name it as kitti:ROOT or nuscenes:ROOT")
    paths = prepare_samples(recipe.samples, samples or default_samples_root(), jobs)
    cameras, first = training_cameras(recipe), len(paths) - recipe.held_out
    pool = collect(_counted(scenes_of_samples(paths[:first], cameras, recipe.views, seed=0)), labels, seed=0)
    return pool, collect(scenes_of_samples(paths[first:], cameras, recipe.views, seed=1), labels, seed=1)


def _counted(scenes: Any) -> Any:
    """The same scenes under a progress bar."""
    from rich.console import Console
    from rich.progress import track

    return track(scenes, description="cutting frustums", console=Console(stderr=True))


def _save(network: Any, spec: LocalizerSpec, out: Path) -> Path:
    """The finished network as ONNX, or as a checkpoint of the authors' form."""
    if spec.form == "v1":
        from lcf3d.localizers.pointnet import export_onnx

        export_onnx(network, spec, out / "localizer.onnx")
        return out / "localizer.onnx"
    from lcf3d.files import atomic_path
    from lcf3d.training.loop import import_torch

    path = out / "localizer.pth"
    with atomic_path(path) as temporary:
        import_torch().save({"state_dict": network.state_dict()}, temporary)
    return path

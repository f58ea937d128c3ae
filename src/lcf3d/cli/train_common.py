"""What the training commands share: samples under a progress bar, training under a progress bar."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from lcf3d.training.loop import TrainingSettings, TrainingTask
    from lcf3d.training.samples import SampleRecipe


def prepare_samples(recipe: SampleRecipe, root: Path, jobs: int) -> list[Path]:
    """Paths of all samples of a recipe, those that are missing in its folder of ``root`` simulated.

    Raises:
        ConfigError: the folder holds another set.
        MissingExtraError: embreex is not installed and something is missing.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from lcf3d.training.samples import write_samples

    columns = (TextColumn("simulating samples"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("samples", total=recipe.frames)
        return write_samples(recipe, root / recipe.folder, jobs, lambda n: bar.advance(task, n))


def held_out_of(count: int, asked: int | None, usual: int) -> int:
    """How many samples at the end to hold out: those asked for, else the usual number, a fifth of fewer.

    Raises:
        ConfigError: nothing would be left to learn from.
    """
    held_out = min(usual, max(1, count // 5)) if asked is None else asked
    if count <= held_out:
        raise ConfigError(f"there are {count} samples, too few to hold out {held_out}; lower --held-out")
    return held_out


def beginning(init: str, shipped: Callable[[str], Path]) -> tuple[Path | None, Path | None]:
    """A training's checkpoint, or an exported network, that a training begins with.

    Args:
        init: a path, ``shipped:NAME``, or nothing.
        shipped: gives the file of a network that comes with lcf3d.

    Raises:
        ConfigError: there is no such file, or lcf3d ships no such network.
        DetectorError: lcf3d ships no such network.
    """
    if init.startswith("shipped:"):
        return None, shipped(init.removeprefix("shipped:"))
    path = Path(init) if init else None
    if path is not None and not path.is_file():
        raise ConfigError(
            f"--init {init} does not exist; name last.pt of a training, an exported .onnx file or shipped:kitti"
        )
    return (None, path) if path is not None and path.suffix == ".onnx" else (path, None)


def train_with_progress(
    task: TrainingTask,
    settings: TrainingSettings,
    out: Path,
    resume: bool,
    start: Path | None = None,
    device: str = "cpu",
) -> Any:
    """`lcf3d.training.loop.train` under a progress bar that shows loss and the last validation; gives the network.

    Raises:
        ConfigError: see `lcf3d.training.loop.train`.
        DetectorError: see there.
        MissingExtraError: torch is not installed.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    from lcf3d.training.loop import Progress, train

    console = Console(stderr=True, markup=False, highlight=False)
    columns = (
        TextColumn("training"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[loss]}"),
    )
    smooth = 0.0
    with Bar(*columns, console=console) as bar:
        row = bar.add_task("steps", total=settings.steps, loss="")

        def report(progress: Progress) -> None:
            nonlocal smooth
            smooth = progress.loss if smooth == 0.0 else 0.98 * smooth + 0.02 * progress.loss
            bar.update(row, completed=progress.step, loss=f"loss {smooth:.3f}")
            if progress.validation:
                figures = "  ".join(f"{name} {value:.3f}" for name, value in progress.validation.items())
                console.print(f"step {progress.step}: loss {smooth:.3f}  {figures}", soft_wrap=True)

        return train(task, settings, out, resume, report, start, device)

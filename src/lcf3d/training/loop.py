"""The training loop that all networks share: schedule, checkpoints, resuming, TensorBoard, several processes.

Everything random in step ``n`` comes from the seed and ``n`` alone, so a training that was interrupted at any moment
and resumed ends with the same weights as one that was not.
"""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lcf3d.errors import ConfigError, DatasetError, DetectorError
from lcf3d.files import atomic_path, write_json
from lcf3d.networks.checkpoints import TRAINING_FORMAT, load_parameters, read_training
from lcf3d.processes import lock_folder, unlock_folder
from lcf3d.training.batches import batches, seed_of

LAST = "last.pt"


@dataclass(frozen=True)
class TrainingSettings:
    """How long and how fast to train.

    Attributes:
        steps: batches of the whole training.
        learning_rate: the highest one, reached after the warm-up and then lowered to zero along a half cosine.
        warmup: share of the steps in which the learning rate rises.
        weight_decay: of AdamW, on weights of more than one dimension.
        clip: largest norm of the gradient.
        seed: of weights, batches and dropout.
        average: decay of the running average of the weights that is validated and exported; 0 for none.
        checkpoint_every: steps between checkpoints; validation takes place at each.
        workers: processes that prepare batches; 0 prepares them in the training's own.
    """

    steps: int
    learning_rate: float = 1e-3
    warmup: float = 0.05
    weight_decay: float = 0.01
    clip: float = 10.0
    seed: int = 0
    average: float = 0.999
    checkpoint_every: int = 500
    workers: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.checkpoint_every < 1:
            raise ConfigError(f"steps must be 1 or more, got {self.steps} and checkpoint_every {self.checkpoint_every}")
        if not self.learning_rate > 0:
            raise ConfigError(f"learning_rate must be above 0, got {self.learning_rate}")

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        rising = max(1.0, self.warmup * self.steps)
        if step < rising:
            return self.learning_rate * (step + 1) / rising
        done = (step - rising) / max(1.0, self.steps - rising)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


class TrainingTask(Protocol):
    """What is trained: a network, its batches, its loss and its measure."""

    def network(self) -> Any:
        """A new torch module with random weights (torch's generator is seeded before)."""
        ...

    def batch(self, step: int, rng: np.random.Generator) -> Any:
        """The batch of a step as nested tuples, lists or dicts of tensors; all that is random comes from ``rng``."""
        ...

    def loss(self, network: Any, batch: Any) -> dict[str, Any]:
        """Weighted scalar terms by name; their sum is minimised. ``network`` may be wrapped for several processes."""
        ...

    def validate(self, network: Any) -> dict[str, float]:
        """Figures of the network (in evaluation mode, on the CPU) on held-out samples; may be empty."""
        ...

    def described(self) -> dict[str, Any]:
        """What the batches depend on besides the settings, as plain data: a training is resumed with the same only."""
        ...

    def starting(self, weights: dict[str, Any]) -> dict[str, Any]:
        """The weights of another training as this one's network takes them."""
        ...


@dataclass(frozen=True)
class Progress:
    """What is reported after a step.

    Attributes:
        step: steps done.
        loss: sum of the terms.
        terms: each term.
        validation: figures, after steps that validate.
    """

    step: int
    loss: float
    terms: dict[str, float]
    validation: dict[str, float]


def train(
    task: TrainingTask,
    settings: TrainingSettings,
    folder: Path,
    resume: bool = False,
    report: Callable[[Progress], None] = lambda _: None,
    start: Path | None = None,
    device: str = "cpu",
) -> Any:
    """Train a network; gives it with the averaged weights, in evaluation mode, on the CPU.

    ``folder`` receives ``last.pt`` (everything to go on from), ``settings.json``, ``metrics.json`` and TensorBoard's
    event files. Under torchrun every process works on its own batches and gradients are averaged.

    Args:
        task: what to train.
        settings: how.
        folder: for checkpoints; must hold none unless ``resume``.
        resume: go on from the folder's checkpoint, if there is one.
        report: called after every step.
        start: checkpoint of another training, whose averaged weights this one begins with.
        device: torch's name of the device to train on.

    Raises:
        ConfigError: the folder holds a training already, or one with other settings or data, or another process trains
            there; there is no such device.
        DatasetError: a checkpoint cannot be written (no space left, no permission).
        DetectorError: the loss is not finite (the last good checkpoint stays), or the checkpoint is another network's.
        MissingExtraError: torch is not installed.
    """
    torch = import_torch()
    with _deterministic(torch):
        return _train(torch, task, settings, folder, resume, report, start, require_device(device))


def _train(
    torch: Any,
    task: TrainingTask,
    settings: TrainingSettings,
    folder: Path,
    resume: bool,
    report: Callable[[Progress], None],
    start: Path | None,
    device: str,
) -> Any:
    """See `train`."""
    rank, world = _join(torch)
    run = _Run(torch, task, settings, folder, rank, device)
    if start is not None:
        run.start(start)
    if rank == 0:
        lock_folder(folder)
    try:
        return _steps(run, resume, report, world)
    finally:
        if rank == 0:
            unlock_folder(folder)


def _steps(run: _Run, resume: bool, report: Callable[[Progress], None], world: int) -> Any:
    """All steps from the checkpoint, or the beginning, on; gives the averaged network."""
    torch, task, settings, folder, rank, device = run.torch, run.task, run.settings, run.folder, run.rank, run.device
    first = run.resume() if resume else run.begin()
    network = run.network
    if world > 1:
        network = torch.nn.parallel.DistributedDataParallel(network, broadcast_buffers=False)
    network.train()
    for step, batch in batches(task, settings.seed, range(first, settings.steps), settings.workers, rank):
        torch.manual_seed(seed_of(settings.seed, step, rank, 1))
        for group in run.optimizer.param_groups:
            group["lr"] = settings.rate(step)
        terms = task.loss(network, on_device(batch, device))
        total = sum(terms.values())
        _require_finite(terms, step, folder)
        run.optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(run.network.parameters(), settings.clip)
        run.optimizer.step()
        run.average(step)
        done, figures = step + 1, {}
        if done % settings.checkpoint_every == 0 or done == settings.steps:
            figures = run.save(done)
            run.network.train()
        report(run.note(done, terms, figures))
    run.close()
    return run.averaged.cpu()


@contextmanager
def _deterministic(torch: Any) -> Iterator[None]:
    """Sums in a fixed order, whatever the number of threads, where torch has an algorithm for that."""
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])


class _Run:
    """The state of a training: network, optimizer, averaged weights, and where they are kept."""

    def __init__(
        self, torch: Any, task: TrainingTask, settings: TrainingSettings, folder: Path, rank: int, device: str
    ) -> None:
        self.torch, self.task, self.settings, self.folder, self.rank = torch, task, settings, folder, rank
        self.device = device
        # as a file gives it back
        self.described: dict[str, Any] = json.loads(json.dumps(task.described()))
        torch.manual_seed(settings.seed)
        self.network = task.network().to(device)
        self.averaged = task.network().to(device)
        self.averaged.load_state_dict(self.network.state_dict())
        self.averaged.eval().requires_grad_(False)
        decayed = [p for p in self.network.parameters() if p.requires_grad and p.ndim > 1]
        others = [p for p in self.network.parameters() if p.requires_grad and p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=settings.learning_rate)
        self.history: list[dict[str, Any]] = []
        self._writer: Any = None

    def start(self, path: Path) -> None:
        """Take the averaged weights of another training."""
        weights = self.task.starting(read_training(path)["averaged"])
        load_parameters(self.network, weights, str(path))
        load_parameters(self.averaged, weights, str(path))

    def begin(self) -> int:
        require_unused(self.folder)
        if self.rank == 0:
            write_json(self.folder / "settings.json", asdict(self.settings))
        return 0

    def resume(self) -> int:
        """Load the checkpoint; gives the steps done."""
        path = self.folder / LAST
        if not path.exists():
            return self.begin()
        state = read_training(path)
        _require_same(path, {**state["settings"], **state.get("task", {})}, {**asdict(self.settings), **self.described})
        load_parameters(self.network, state["network"], str(path))
        load_parameters(self.averaged, state["averaged"], str(path))
        self.optimizer.load_state_dict(state["optimizer"])
        self.history = list(state["history"])
        return int(state["step"])

    def average(self, step: int) -> None:
        """Move the averaged weights towards the network's."""
        decay = min(self.settings.average, (1 + step) / (10 + step))
        with self.torch.no_grad():
            for kept, new in zip(self.averaged.state_dict().values(), self.network.state_dict().values(), strict=True):
                if kept.dtype.is_floating_point:
                    kept.lerp_(new, 1 - decay)
                else:
                    kept.copy_(new)

    def save(self, done: int) -> dict[str, float]:
        """Validate and write the checkpoint, whole or not at all; gives the validation's figures."""
        if self.rank != 0:
            return {}
        network = self.averaged if self.device == "cpu" else copy.deepcopy(self.averaged).cpu()
        with self.torch.no_grad():
            figures = self.task.validate(network)
        self.history.append({"step": done, **figures})
        state = {
            "format": TRAINING_FORMAT,
            "step": done,
            "settings": asdict(self.settings),
            "task": self.described,
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "history": self.history,
        }
        try:
            with atomic_path(self.folder / LAST) as temporary:
                self.torch.save(state, temporary)
            write_json(self.folder / "metrics.json", self.history)
        except (OSError, RuntimeError) as error:
            # torch reports a full disk as a RuntimeError of its own
            reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
            raise DatasetError(
                f"cannot write {self.folder / LAST}: {reason}; the one before stays: make room, go on with --resume"
            ) from error
        return figures

    def note(self, done: int, terms: dict[str, Any], figures: dict[str, float]) -> Progress:
        """What to report, after writing it to TensorBoard."""
        values = {name: float(value.detach()) for name, value in terms.items()}
        progress = Progress(done, sum(values.values()), values, figures)
        if self.rank == 0 and (done % 20 == 0 or figures):
            writer = self._tensorboard()
            for name, value in {"loss": progress.loss, **values}.items():
                writer.add_scalar(f"train/{name}", value, done)
            for name, value in figures.items():
                writer.add_scalar(f"validation/{name}", value, done)
        return progress

    def _tensorboard(self) -> Any:
        if self._writer is None:
            from lcf3d.networks.torch import summary_writer

            self._writer = summary_writer(self.folder / "tensorboard")
        return self._writer

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


def require_unused(folder: Path) -> None:
    """See that a new training may begin in a folder.

    Raises:
        ConfigError: it holds one already.
    """
    if (folder / LAST).exists():
        raise ConfigError(f"{folder} holds a training already; go on with --resume, or choose another folder")


def import_torch() -> Any:
    """torch, or a sentence that says how to install it.

    Raises:
        MissingExtraError: torch is not installed.
    """
    from lcf3d.networks.torch import torch

    return torch


def require_device(device: str) -> str:
    """The device, if torch can use it here.

    Raises:
        ConfigError: it cannot.
    """
    torch = import_torch()
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0][:120]
        raise ConfigError(
            f"torch cannot use the device {device!r} here ({reason}); choose cpu, or one it has"
        ) from None
    return device


def on_device(batch: Any, device: str) -> Any:
    """A batch (nested tuples, lists or dicts of tensors) with its tensors on a device."""
    if isinstance(batch, Mapping):
        return {name: on_device(value, device) for name, value in batch.items()}
    if isinstance(batch, (tuple, list)):
        return type(batch)(on_device(value, device) for value in batch)
    return batch.to(device) if hasattr(batch, "to") else batch


def _require_same(path: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """See that a training goes on as it began; how many processes prepare its batches changes nothing.

    What a checkpoint of an earlier version does not tell is not compared.
    """
    other = [name for name in then if name in now and name != "workers" and then[name] != now[name]]
    if other:
        listed = ", ".join(f"{name} {then[name]!r} then and {now[name]!r} now" for name in other)
        raise ConfigError(f"{path} was trained with other settings: {listed}; use the same to go on")


def _require_finite(terms: dict[str, Any], step: int, folder: Path) -> None:
    bad = [name for name, value in terms.items() if not math.isfinite(float(value.detach()))]
    if bad:
        kept = f"{folder / LAST} is the last good checkpoint" if (folder / LAST).exists() else "no checkpoint yet"
        raise DetectorError(
            f"the loss {bad[0]!r} of step {step} is not finite; {kept}: lower the learning rate, or look at the data"
        )


def _join(torch: Any) -> tuple[int, int]:
    """Rank and number of the processes; joins the group under torchrun."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world > 1 and not torch.distributed.is_initialized():
        torch.distributed.init_process_group("gloo")
    return int(os.environ.get("RANK", "0")), world

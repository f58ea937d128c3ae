"""Training against the clock on data that is still being made: for a machine that is at hand for minutes only.

The other loop (`lcf3d.training.loop`) counts steps and can be repeated to the byte; this one takes what time there is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from lcf3d.errors import DetectorError
from lcf3d.files import atomic_path
from lcf3d.networks.checkpoints import TRAINING_FORMAT, load_parameters, read_training
from lcf3d.training.loop import import_torch

MOST_SETBACKS = 5
"""So many times in a row a training goes back to its last good weights before it gives up."""


@dataclass(frozen=True)
class ClockSettings:
    """How to train against the clock.

    Attributes:
        learning_rate: the highest one; it falls to zero at the deadline along half a cosine.
        warmup: steps in which it rises.
        weight_decay: of AdamW, on weights of more than one dimension.
        clip: largest norm of the gradient.
        average: decay of the running average of the weights, which is what is written.
        save_every: seconds between writing weights.
        look_every: seconds between looks for new data.
        needed: samples to wait for before the first step.
        seed: of weights.
    """

    learning_rate: float
    warmup: int = 200
    weight_decay: float = 0.02
    clip: float = 10.0
    average: float = 0.999
    save_every: float = 60.0
    look_every: float = 8.0
    needed: int = 100
    seed: int = 0

    def rate(self, step: int, share: float) -> float:
        """Learning rate of a step, ``share`` of the time being over."""
        rising = min(1.0, (step + 1) / max(1, self.warmup))
        return self.learning_rate * rising * 0.5 * (1 + math.cos(math.pi * min(1.0, max(0.0, share))))


class ClockTask(Protocol):
    """What is trained against the clock."""

    def network(self) -> Any:
        """A new torch module with random weights."""
        ...

    def refresh(self) -> int:
        """Take the samples that have come; gives how many there are now."""
        ...

    def loss(self, network: Any, step: int) -> dict[str, Any]:
        """Weighted scalar terms of a new batch."""
        ...

    def check(self, network: Any) -> dict[str, float]:
        """Figures of the averaged network on held-out samples; may be empty."""
        ...


def train_by_clock(
    task: ClockTask,
    settings: ClockSettings,
    deadline: float,
    path: Path,
    device: str = "cpu",
    report: Callable[[str], None] = print,
    start: Path | None = None,
) -> Any:
    """Train until a deadline; gives the averaged network, and writes it every so often and at the end.

    Args:
        task: what to train.
        settings: how.
        deadline: `time.time` at which the last weights must be on the disk.
        path: of the checkpoint, which `lcf3d train ... --init` takes.
        device: torch's name of the device.
        report: takes lines of progress.
        start: checkpoint of another training whose weights this one begins with.

    Raises:
        DetectorError: no data came in time, or the gradient is not finite for long.
    """
    torch = import_torch()
    torch.manual_seed(settings.seed)
    if device != "cpu":
        torch.backends.cudnn.benchmark = True
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    run = _ClockRun(torch, task, settings, path, device, report)
    if start is not None:
        run.start(start)
    samples = task.refresh()
    while samples < settings.needed:
        if time.time() > deadline - min(10.0, settings.save_every):
            raise DetectorError(f"only {samples} of {settings.needed} samples came before the deadline")
        time.sleep(0.5)
        samples = task.refresh()
    return run.until(deadline, samples)


class _ClockRun:
    """The state of a training against the clock."""

    def __init__(
        self,
        torch: Any,
        task: ClockTask,
        settings: ClockSettings,
        path: Path,
        device: str,
        report: Callable[[str], None],
    ) -> None:
        self.torch, self.task, self.settings, self.path, self.report = torch, task, settings, path, report
        self.network = task.network().to(device)
        self.averaged = task.network().to(device)
        self.averaged.load_state_dict(self.network.state_dict())
        self.averaged.eval().requires_grad_(False)
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        others = [p for p in self.network.parameters() if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=settings.learning_rate)
        self.step = 0
        self.values = [
            [value for value in network.state_dict().values() if value.dtype.is_floating_point]
            for network in (self.averaged, self.network)
        ]
        self.good = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.history: list[dict[str, Any]] = []

    def start(self, path: Path) -> None:
        """Take the averaged weights of another training."""
        weights = read_training(path)["averaged"]
        load_parameters(self.network, weights, str(path))
        load_parameters(self.averaged, weights, str(path))

    def until(self, deadline: float, samples: int) -> Any:
        """Train until the deadline; gives the averaged network."""
        begun = time.time()
        saved = looked = begun
        sums: dict[str, Any] = {}
        counted = 0
        bad = 0
        # time to write the last weights
        end = deadline - min(3.0, 0.05 * max(0.0, deadline - begun))
        self.network.train()
        while (now := time.time()) < end:
            if now - looked > self.settings.look_every:
                samples, looked = self.task.refresh(), time.time()
            terms = self._one((now - begun) / (end - begun))
            for name, value in terms.items():
                sums[name] = sums.get(name, 0) + value
            counted += 1
            if now - saved > self.settings.save_every:
                bad = 0 if self._note(sums, counted, samples, now - begun) else bad + 1
                sums, counted, saved = {}, 0, time.time()
                if bad > MOST_SETBACKS:
                    raise DetectorError(f"the loss is not finite again and again; {self.path} holds good weights")
        if counted:
            self._note(sums, counted, samples, time.time() - begun)
        return self.averaged

    def _one(self, share: float) -> dict[str, Any]:
        """One step; gives its terms, on the device."""
        torch = self.torch
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.rate(self.step, share)
        terms = self.task.loss(self.network, self.step)
        self.optimizer.zero_grad(set_to_none=True)
        sum(terms.values()).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip)
        # without a finite gradient a step does nothing; to ask whether it has one would make the device wait
        for parameter in self.network.parameters():
            if parameter.grad is not None:
                parameter.grad.nan_to_num_(0.0, 0.0, 0.0)
        self.optimizer.step()
        self.step += 1
        decay = min(self.settings.average, self.step / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(*self.values, 1 - decay)
        return {name: value.detach() for name, value in terms.items()}

    def _note(self, sums: dict[str, Any], counted: int, samples: int, seconds: float) -> bool:
        """Report, check and write the averaged weights; whether the loss was finite. Else go back."""
        terms = {name: float(value) / counted for name, value in sums.items()}
        finite = all(math.isfinite(value) for value in terms.values())
        weights = {name: value.detach().cpu() for name, value in self.averaged.state_dict().items()}
        finite = finite and all(bool(self.torch.isfinite(value).all()) for value in weights.values())
        with self.torch.no_grad():
            figures = self.task.check(self.averaged) if finite else {}
        line = {"step": self.step, "seconds": round(seconds, 1), "samples": samples, **terms, **figures}
        self.history.append(line)
        self.report("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in line.items()))
        if not finite:
            self.network.load_state_dict(self.good)
            self.averaged.load_state_dict(self.good)
            self.optimizer.state.clear()
        else:
            self.good = weights
            self.path.parent.mkdir(parents=True, exist_ok=True)
            state = {"format": TRAINING_FORMAT, "step": self.step, "averaged": weights, "history": self.history}
            with atomic_path(self.path) as temporary:
                self.torch.save(state, temporary)
        return finite


def mixed(device: str) -> Any:
    """A context in which convolutions and products run in bfloat16 where the device is good at it."""
    torch = import_torch()
    return torch.autocast("cuda", torch.bfloat16, enabled=device != "cpu") if device != "cpu" else _nothing()


def _nothing() -> Any:
    from contextlib import nullcontext

    return nullcontext()

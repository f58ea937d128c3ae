import time
from itertools import count

import numpy as np
import pytest

from lcf3d.errors import DetectorError

torch = pytest.importorskip("torch")

from lcf3d.networks.checkpoints import read_training  # noqa: E402
from lcf3d.training.clocked import ClockSettings, train_by_clock  # noqa: E402

SETTINGS = ClockSettings(0.05, warmup=5, average=0.9, save_every=0.2, look_every=0.05, needed=3)


class Line:
    """y = 2 x - 1; a sample more each time one looks."""

    def __init__(self, spoilt=()):
        self.spoilt, self.samples, self.checks = spoilt, count(1), 0

    def network(self):
        return torch.nn.Linear(1, 1)

    def refresh(self):
        return next(self.samples)

    def loss(self, network, step):
        x = torch.from_numpy(np.random.default_rng(step).normal(size=(16, 1)).astype(np.float32))
        square = ((network(x) - (2 * x - 1)) ** 2).mean()
        return {"square": square * float("nan") if step in self.spoilt else square}

    def check(self, network):
        self.checks += 1
        return {"at one": float(network(torch.ones(1, 1)))}


def test_it_learns_until_the_deadline_and_leaves_its_weights(tmp_path):
    lines, path = [], tmp_path / "line.pt"
    deadline = time.time() + 3
    network = train_by_clock(Line(), SETTINGS, deadline, path, report=lines.append)
    assert time.time() < deadline + 0.5
    assert float(network.weight) == pytest.approx(2, abs=0.2)
    assert len(lines) > 3
    state = read_training(path)
    assert torch.equal(state["averaged"]["weight"], network.weight)
    assert state["history"][-1]["samples"] > SETTINGS.needed
    again = train_by_clock(Line(), SETTINGS, time.time() + 1.5, tmp_path / "2.pt", report=lines.append, start=path)
    assert float(again.weight) == pytest.approx(2, abs=0.2)


def test_steps_that_are_not_finite_leave_good_weights(tmp_path):
    network = train_by_clock(Line(spoilt={3, 4}), SETTINGS, time.time() + 2, tmp_path / "a.pt", report=lambda _: None)
    assert torch.isfinite(network.weight).all()
    with pytest.raises(DetectorError, match="not finite again and again"):
        train_by_clock(Line(spoilt=range(10**9)), SETTINGS, time.time() + 20, tmp_path / "b.pt", report=lambda _: None)


def test_too_few_samples_before_the_deadline(tmp_path):
    few = ClockSettings(0.05, save_every=0.2, needed=50)
    with pytest.raises(DetectorError, match=r"only \d+ of 50 samples came"):
        train_by_clock(Line(), few, time.time() + 1, tmp_path / "line.pt", report=lambda _: None)


def test_the_rate_falls_with_the_time():
    assert SETTINGS.rate(0, 0.0) == pytest.approx(0.01)
    assert SETTINGS.rate(100, 0.0) == pytest.approx(0.05)
    assert SETTINGS.rate(100, 0.5) == pytest.approx(0.025)
    assert SETTINGS.rate(100, 2.0) == pytest.approx(0.0)

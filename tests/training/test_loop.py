import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import ConfigError, DatasetError, DetectorError
from lcf3d.processes import LOCK

torch = pytest.importorskip("torch")

from lcf3d.training.loop import LAST, TrainingSettings, on_device, train  # noqa: E402


class Line:
    """y = 2 x - 1 by a small network with dropout and batch normalization."""

    def __init__(self, hidden=8, spoilt_step=None, batch_size=16):
        self.hidden, self.spoilt_step, self.batch_size = hidden, spoilt_step, batch_size

    def described(self):
        return {"batch_size": self.batch_size, "data": ("a", "b")}

    def starting(self, weights):
        return weights

    def network(self):
        return torch.nn.Sequential(
            torch.nn.Linear(1, self.hidden), torch.nn.BatchNorm1d(self.hidden), torch.nn.Dropout(0.1),
            torch.nn.ReLU(), torch.nn.Linear(self.hidden, 1),
        )  # fmt: skip

    def batch(self, step, rng):
        x = rng.normal(size=(self.batch_size, 1)).astype(np.float32)
        if step == self.spoilt_step:
            x[0] = np.nan
        return {"x": torch.from_numpy(x), "y": torch.from_numpy(2 * x - 1)}

    def loss(self, network, batch):
        return {"square": ((network(batch["x"]) - batch["y"]) ** 2).mean()}

    def validate(self, network):
        return {"at one": float(network(torch.ones(1, 1)))}


SETTINGS = TrainingSettings(40, 0.05, average=0.9, checkpoint_every=10)


class Stop(Exception):
    pass


def stop_at(step):
    def report(progress):
        if progress.step == step:
            raise Stop

    return report


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


@pytest.mark.parametrize("workers", [0, 1])
def test_interrupted_at_any_moment_and_resumed_is_as_if_nothing_had_happened(tmp_path, workers):
    settings = TrainingSettings(**{**vars(SETTINGS), "workers": workers})
    whole = train(Line(), settings, tmp_path / "whole")
    for step in (3, 17, 20, 39):
        with pytest.raises(Stop):
            train(Line(), settings, tmp_path / f"{step}", report=stop_at(step))
        assert same(whole, train(Line(), settings, tmp_path / f"{step}", resume=True))
    history = json.loads((tmp_path / "17" / "metrics.json").read_text())
    assert [entry["step"] for entry in history] == [10, 20, 30, 40]
    assert same(whole, train(Line(), settings, tmp_path / "whole", resume=True)), "nothing is left to do"


def test_it_learns_and_reports(tmp_path):
    reports = []
    train(Line(), TrainingSettings(200, 0.05, average=0.9, checkpoint_every=50), tmp_path, report=reports.append)
    assert reports[-1].validation["at one"] == pytest.approx(1, abs=0.4)
    assert np.mean([r.loss for r in reports[-20:]]) < 0.3 * np.mean([r.loss for r in reports[:20]])
    assert any((tmp_path / "tensorboard").iterdir())


def test_a_loss_that_is_not_finite_stops_with_the_last_good_checkpoint(tmp_path):
    with pytest.raises(DetectorError, match=r"'square' of step 25 is not finite; .*last\.pt is the last good"):
        train(Line(spoilt_step=25), SETTINGS, tmp_path)
    assert torch.load(tmp_path / LAST, weights_only=True)["step"] == 20
    with pytest.raises(DetectorError, match="no checkpoint yet"):
        train(Line(spoilt_step=5), SETTINGS, tmp_path / "early")


def test_a_folder_in_use_other_settings_and_other_networks_are_refused(tmp_path):
    train(Line(), SETTINGS, tmp_path)
    with pytest.raises(ConfigError, match="holds a training already"):
        train(Line(), SETTINGS, tmp_path)
    with pytest.raises(ConfigError, match="trained with other settings"):
        train(Line(), TrainingSettings(41, 0.05, average=0.9, checkpoint_every=10), tmp_path, resume=True)
    with pytest.raises(DetectorError, match=r"another architecture: .*0\.weight \(expected \(9, 1\), got \(8, 1\)\)"):
        train(Line(hidden=9), SETTINGS, tmp_path, resume=True)
    (tmp_path / LAST).write_bytes(b"torn")
    with pytest.raises(DetectorError, match="damaged"):
        train(Line(), SETTINGS, tmp_path, resume=True)


def test_a_folder_that_another_process_trains_in_is_refused(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    with (tmp_path / LOCK).open("w+") as held:
        held.write("process 7")
        held.flush()
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(ConfigError, match="is being written by process 7: wait"):
            train(Line(), SETTINGS, tmp_path)
    assert not (tmp_path / LAST).exists()
    train(Line(), SETTINGS, tmp_path)
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("unexpected pos 128 vs 22")])
def test_a_full_disk_leaves_the_last_checkpoint_and_says_how_to_go_on(tmp_path, monkeypatch, error):
    whole = train(Line(), SETTINGS, tmp_path / "whole")
    save = torch.save

    def full(state, path):
        if state["step"] == 20:
            raise error
        save(state, path)

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(DatasetError, match=r"cannot write .*last.pt: (no space|unexpected pos).* go on with --resume"):
        train(Line(), SETTINGS, tmp_path / "full")
    monkeypatch.undo()
    assert torch.load(tmp_path / "full" / LAST, weights_only=True)["step"] == 10
    assert same(train(Line(), SETTINGS, tmp_path / "full", resume=True), whole)


def test_a_training_goes_on_with_what_it_began_with_but_for_the_workers(tmp_path):
    with pytest.raises(Stop):
        train(Line(), SETTINGS, tmp_path, report=stop_at(25))
    with pytest.raises(ConfigError, match="batch_size 16 then and 8 now"):
        train(Line(batch_size=8), SETTINGS, tmp_path, resume=True)
    other = TrainingSettings(**{**vars(SETTINGS), "workers": 1})
    assert same(train(Line(), SETTINGS, tmp_path / "whole"), train(Line(), other, tmp_path, resume=True))


def test_checkpoints_that_tell_nothing_of_their_batches_are_gone_on_with(tmp_path):
    train(Line(), SETTINGS, tmp_path)
    state = torch.load(tmp_path / LAST, weights_only=True)
    del state["task"]
    torch.save(state, tmp_path / LAST)
    train(Line(batch_size=8), SETTINGS, tmp_path, resume=True)


def test_a_device_that_is_not_there_is_one_sentence(tmp_path):
    for device in ("no such device", "meta"):
        with pytest.raises(ConfigError, match=f"torch cannot use the device '{device}'"):
            train(Line(), SETTINGS, tmp_path / "x", device=device)
    assert not (tmp_path / "x").exists()


def test_batches_are_put_on_a_device_whatever_holds_them():
    batch = on_device({"a": [torch.zeros(2), 3], "b": (torch.ones(1),)}, "meta")
    assert batch["a"][0].device.type == batch["b"][0].device.type == "meta"
    assert batch["a"][1] == 3


def test_a_training_begins_with_the_weights_of_another(tmp_path):
    first = train(Line(), SETTINGS, tmp_path / "first")
    nothing = TrainingSettings(1, 1e-12, average=0.0, checkpoint_every=1)
    second = train(Line(), nothing, tmp_path / "second", start=tmp_path / "first" / LAST)
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        torch.testing.assert_close(a, b)
    with pytest.raises(DetectorError, match="another architecture"):
        train(Line(hidden=9), nothing, tmp_path / "third", start=tmp_path / "first" / LAST)
    with pytest.raises(DetectorError, match="does not exist"):
        train(Line(), nothing, tmp_path / "fourth", start=tmp_path / "nowhere.pt")


def test_the_rate_rises_and_falls():
    settings = TrainingSettings(100, 1.0, warmup=0.1)
    assert settings.rate(0) == pytest.approx(0.1)
    assert settings.rate(10) == pytest.approx(1.0)
    assert settings.rate(55) == pytest.approx(0.5)
    assert settings.rate(99) < 0.01
    for bad in ({"steps": 0}, {"learning_rate": 0.0}):
        with pytest.raises(ConfigError):
            TrainingSettings(**{"steps": 10, **bad})


def test_two_processes_train_one_network(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os, sys, torch\n"
        "from pathlib import Path\n"
        "from lcf3d.training.loop import train\n"
        "from tests.training.test_loop import SETTINGS, Line\n"
        "rank = os.environ['RANK']\n"
        "seen = []\n"
        "class Noted(Line):\n"
        "    def loss(self, network, batch):\n"
        "        seen.append(float(batch['x'].sum()))\n"
        "        self.last = network\n"
        "        return super().loss(network, batch)\n"
        "task = Noted()\n"
        "train(task, SETTINGS, Path(sys.argv[1]))\n"
        "weights = torch.cat([p.detach().flatten() for p in task.last.parameters()])\n"
        "torch.save({'weights': weights, 'seen': torch.tensor(seen)}, Path(sys.argv[1]) / f'rank{rank}.pt')\n"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    root = Path(__file__).parents[2]
    path = os.pathsep.join([str(root / "src"), str(root)])
    subprocess.run([*command, str(tmp_path)], check=True, cwd=root, env={**os.environ, "PYTHONPATH": path})
    one, two = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in (0, 1))
    assert torch.allclose(one["weights"], two["weights"])
    assert not torch.allclose(one["seen"], two["seen"]), "each has batches of its own"
    assert torch.load(tmp_path / LAST, weights_only=True)["step"] == SETTINGS.steps

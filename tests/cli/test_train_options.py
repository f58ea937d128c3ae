"""Options of the training commands reach what is trained."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app

pytest.importorskip("torch")


@dataclass
class Seen:
    """What a training command asked for, up to the training itself."""

    recipe: Any = None
    training: dict[str, Any] = field(default_factory=dict)
    threads: list[int] = field(default_factory=list)


class Trained(Exception):
    """The command came to its training."""


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Seen:
    """Nothing is simulated, read or trained."""
    import torch

    from lcf3d.cli import train_common
    from lcf3d.training import camera_images, frustums, lidar, lidar_scans, loop

    found = Seen()

    def samples(recipe: Any, root: Path, jobs: int) -> list[Path]:
        found.recipe = recipe
        return [root / str(i) for i in range(4)]

    def train(task: Any, settings: Any, out: Path, resume: bool, init: Any, device: str) -> None:
        found.training = {"task": task, "settings": settings, "init": init, "device": device}
        raise Trained

    monkeypatch.setattr(train_common, "prepare_samples", samples)
    monkeypatch.setattr(train_common, "train_with_progress", train)
    monkeypatch.setattr(camera_images, "read_samples", lambda paths, masks: list(paths))
    monkeypatch.setattr(
        lidar_scans, "simulated_scans", lambda paths, names: lidar_scans.ScanSource(lambda i: paths[i], len(paths), 0.0)
    )
    monkeypatch.setattr(lidar, "objects_of", lambda scans, preset: [])
    monkeypatch.setattr(frustums, "collect", lambda scenes, labels, seed: [])
    monkeypatch.setattr(loop, "require_device", lambda device: None)
    monkeypatch.setattr(torch, "set_num_threads", found.threads.append)
    return found


def train(*arguments: object) -> None:
    result = CliRunner().invoke(app, ["train", *map(str, arguments)])
    assert isinstance(result.exception, Trained), result.output


@pytest.mark.parametrize("network", ["lidar", "camera"])
def test_a_detectors_options(network: str, seen: Seen, tmp_path: Path) -> None:
    options = ("--samples-seed", 77, "--learning-rate", 0.5, "--checkpoint-every", 9, "--workers", 3, "--threads", 5)
    (tmp_path / "last.pt").touch()
    start = ("--init", tmp_path / "last.pt", "--device", "cuda:1")
    train(network, *options, *start, "--samples", tmp_path, "--out", tmp_path / "out")
    settings = seen.training["settings"]
    assert (settings.learning_rate, settings.checkpoint_every, settings.workers) == (0.5, 9, 3)
    assert seen.recipe.seed == 77
    assert seen.threads == [5]
    assert (seen.training["init"], seen.training["device"]) == (tmp_path / "last.pt", "cuda:1")


def test_scans_are_tilted_by_degrees(seen: Seen, tmp_path: Path) -> None:
    train("lidar", "--tilt", 90, "--samples", tmp_path, "--out", tmp_path / "out")
    assert seen.training["task"].augmentation.tilt == pytest.approx(3.14159265 / 2)


def test_the_localizers_options(seen: Seen, tmp_path: Path) -> None:
    (tmp_path / "last.pt").touch()
    start = ("--init", tmp_path / "last.pt", "--device", "cuda:1")
    train("localizer", "--learning-rate", 0.5, *start, "--samples", tmp_path, "--out", tmp_path / "out")
    assert seen.training["settings"].learning_rate == 0.5
    assert (seen.training["init"], seen.training["device"]) == (tmp_path / "last.pt", "cuda:1")


@pytest.mark.parametrize("network", ["lidar", "camera", "localizer"])
def test_what_cannot_begin_is_told_before_anything_is_simulated(network: str, seen: Seen, tmp_path: Path) -> None:
    def told(*options: object) -> str:
        result = CliRunner().invoke(app, ["train", network, *map(str, options)])
        assert result.exit_code in (1, 2)
        assert not seen.training
        assert seen.recipe is None
        return f"{result.exception} {result.output}"

    assert "does not exist" in told("--init", tmp_path / "absent.pt", "--out", tmp_path / "new")
    (tmp_path / "last.pt").touch()
    assert "holds a training already" in told("--out", tmp_path)

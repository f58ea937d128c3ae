from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.errors import ConfigError, DetectorError
from tests.training.camera_pictures import picture

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from lcf3d.detectors.camera.small_network import SmallConfig  # noqa: E402
from lcf3d.networks.checkpoints import read_training  # noqa: E402
from lcf3d.training.camera import CameraTask  # noqa: E402
from lcf3d.training.camera_calibration import calibrate  # noqa: E402
from lcf3d.training.loop import TrainingSettings, train  # noqa: E402

TINY = SmallConfig(channels=(4, 4, 8, 8, 8), depths=(0, 0, 0, 0), neck=8, prototypes=2)
IMAGES = (
    picture([("Car", (20, 16, 60, 48)), ("Pedestrian", (70, 10, 80, 40))]),
    picture([("Cyclist", (10, 20, 30, 50))]),
    picture([]),
)


def task(config: SmallConfig = TINY, held_out: int = 0) -> CameraTask:
    return CameraTask(IMAGES, IMAGES[:held_out], config, batch_size=2, view=(32, 64))


def settings(**changes: float) -> TrainingSettings:
    return TrainingSettings(**{"steps": 4, "checkpoint_every": 2, "seed": 3, **changes})  # type: ignore[arg-type]


def test_a_batch_depends_on_its_generator_alone() -> None:
    first, second = (task().batch(7, np.random.default_rng(5)) for _ in range(2))
    assert set(first) == {"pixels", "boxes", "visible", "labels", "numbers", "owner"}
    assert first["pixels"].shape == (2, 3, 32, 64)
    for name, value in first.items():
        torch.testing.assert_close(value, second[name], rtol=0, atol=0)


def test_a_resumed_training_ends_with_the_same_bytes(tmp_path: Path) -> None:
    class Interrupted(Exception):
        pass

    def stop(progress) -> None:  # type: ignore[no-untyped-def]
        if progress.step == 3:
            raise Interrupted

    train(task(), settings(), tmp_path / "whole")
    with pytest.raises(Interrupted):
        train(task(), settings(), tmp_path / "broken", report=stop)
    train(task(), settings(), tmp_path / "broken", resume=True)
    whole, broken = (read_training(tmp_path / name / "last.pt") for name in ("whole", "broken"))
    for name, value in whole["averaged"].items():
        assert torch.equal(value, broken["averaged"][name]), name


def test_a_checkpoint_of_another_size_is_refused_with_the_first_difference(tmp_path: Path) -> None:
    train(task(), settings(steps=2), tmp_path)
    other = SmallConfig(channels=(4, 4, 8, 8, 8), depths=(0, 0, 0, 0), neck=16, prototypes=2)
    with pytest.raises(DetectorError, match=r"another architecture: .* shape: lateral\.0\.0\.weight \(expected"):
        train(task(other), settings(steps=2), tmp_path, resume=True)


def test_validation_measures_what_is_exported() -> None:
    figures = task(held_out=2).validate(task().network().eval())
    assert {"AP50 Car", "AP70 Cyclist", "calibration error"} <= set(figures)
    assert task().validate(task().network()) == {}


def test_calibration_leaves_the_network_usable() -> None:
    network = task().network().eval().requires_grad_(False)
    calibrate(network, IMAGES)
    assert torch.isfinite(network.calibration).all()
    assert (network.calibration[:, 0] > 0).all()


def test_without_masks() -> None:
    plain = SmallConfig(channels=(4, 4, 8, 8, 8), depths=(0, 0, 0, 0), neck=8, prototypes=0)
    batch = task(plain).batch(0, np.random.default_rng(0))
    assert "owner" not in batch
    assert set(task(plain).loss(task(plain).network().train(), batch)) == {"score", "box"}


def test_a_network_without_masks_begins_with_one_that_has_them(tmp_path: Path) -> None:
    train(task(), settings(steps=2), tmp_path / "masks")
    plain = SmallConfig(channels=(4, 4, 8, 8, 8), depths=(0, 0, 0, 0), neck=8, prototypes=0)
    nothing = settings(steps=1, learning_rate=1e-12, average=0.0, checkpoint_every=1)
    begun = train(task(plain), nothing, tmp_path / "plain", start=tmp_path / "masks" / "last.pt")
    before = read_training(tmp_path / "masks" / "last.pt")["averaged"]
    torch.testing.assert_close(begun.predict.weight, before["predict.weight"][:7])
    torch.testing.assert_close(begun.state_dict()["tower.0.0.weight"], before["tower.0.0.weight"])
    with pytest.raises(DetectorError, match="another architecture"):
        train(task(), nothing, tmp_path / "again", start=tmp_path / "plain" / "last.pt")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": ()}, "at least one image"),
        ({"view": (30, 64)}, "multiples of 32"),
        ({"batch_size": 0}, "batch_size must be 1 or more"),
    ],
)
def test_settings_that_make_no_sense(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CameraTask(**{"images": IMAGES, "held_out": (), "config": TINY, **changes})


def test_images_without_masks_need_no_masks() -> None:
    from dataclasses import replace

    with pytest.raises(ConfigError, match="--no-masks"):
        CameraTask([replace(IMAGES[0], owner=None)], (), TINY)


def test_the_command_trains_and_exports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import typer

    from lcf3d.cli import train_camera
    from lcf3d.detectors.camera.onnx import OnnxDetector

    monkeypatch.setattr(train_camera, "_simulated_images", lambda *_: list(IMAGES))
    monkeypatch.setattr("lcf3d.detectors.camera.small_network.SmallConfig", lambda: TINY)
    app = typer.Typer()
    app.command()(train_camera.camera)
    arguments = ["--out", str(tmp_path), "--steps", "1", "--batch-size", "1", "--held-out", "1"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert OnnxDetector(tmp_path / "camera.onnx").layout == "ultralytics"
    fitted, measured = [], []
    monkeypatch.setattr("lcf3d.training.camera_calibration.calibrate", lambda _, images: fitted.extend(images))
    monkeypatch.setattr(CameraTask, "validate", lambda one, _: measured.append(one.held_out) or {})
    both = CliRunner().invoke(app, ["--out", str(tmp_path / "two"), "--steps", "1", "--held-out", "2"])
    assert both.exit_code == 0
    # scores are fitted on other images than the last figures are of
    assert [image is IMAGES[1] for image in fitted] == [True]
    assert [image is IMAGES[2] for image in measured[-1]] == [True]
    again = CliRunner().invoke(app, arguments)
    assert isinstance(again.exception, ConfigError)
    few = CliRunner().invoke(app, ["--out", str(tmp_path / "few"), "--held-out", "3"])
    assert "lower --held-out" in str(few.exception)
    masks = CliRunner().invoke(app, [f"kitti:{tmp_path}", "--out", str(tmp_path / "masks")])
    assert "--no-masks" in str(masks.exception)

"""Training of the small LiDAR detector: it learns, it can be interrupted, it refuses what is not its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("tensorboard")

from lcf3d.detectors.lidar import OnnxLidarDetector, export_onnx  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError  # noqa: E402
from lcf3d.training.lidar import LidarTask, checkpoint_detector, objects_of  # noqa: E402
from lcf3d.training.lidar_scans import LabelledScan, ScanSource  # noqa: E402
from lcf3d.training.loop import TrainingSettings, train  # noqa: E402
from tests.training.lidar_scenes import CONFIG, EMPTY, SCENES, scene  # noqa: E402

TASK = LidarTask(
    SCENES, EMPTY.part(0, 1), CONFIG, batch_size=2, window=(32, 32), objects=objects_of(SCENES, CONFIG, 10)
)
SETTINGS = TrainingSettings(steps=4, checkpoint_every=2)


class Interrupted(Exception):
    pass


def stop_after(step):
    def report(progress):
        if progress.step == step:
            raise Interrupted

    return report


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return train(TASK, SETTINGS, folder), folder


def test_an_interrupted_training_ends_like_one_that_was_not(trained, tmp_path):
    whole, _ = trained
    # stopped after the checkpoint at step 2, in the middle of what follows it
    with pytest.raises(Interrupted):
        train(TASK, SETTINGS, tmp_path, report=stop_after(3))
    resumed = train(TASK, SETTINGS, tmp_path, resume=True)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_it_learns_one_scan_by_heart(tmp_path):
    only = ScanSource(lambda i: scene(0, 3), 1, 0.0)
    calm = replace(TASK.augmentation, scale=0, drop=0, intensity_gain=0, intensity_offset=0, intensity_noise=0)
    task = LidarTask(only, None, CONFIG, 1, (64, 64), 1, calm)
    losses = []
    settings = TrainingSettings(steps=30, learning_rate=4e-3, checkpoint_every=30, average=0)
    train(task, settings, tmp_path, report=lambda progress: losses.append(progress.loss))
    assert losses[-1] < 0.3 * losses[0]


def test_batches_depend_on_the_generator_alone():
    first, second = (TASK.batch(3, np.random.default_rng([0, 3])) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert int(first["pillars"].max()) < 2 * 32 * 32


@pytest.mark.parametrize("source", [EMPTY, ScanSource(lambda i: empty_scan(), 1, 1.0)])
def test_scans_without_objects_or_points_give_finite_losses(source):
    task = replace(TASK, scans=source, objects=None)
    network = task.network()
    terms = task.loss(network, task.batch(0, np.random.default_rng(0)))
    assert all(torch.isfinite(value) for value in terms.values())
    sum(terms.values()).backward()
    assert replace(task, held_out=source).validate(network.eval()) == {}, "no class is there to be found"


def empty_scan():
    none = np.zeros(0, np.int64)
    return LabelledScan(np.zeros((0, 4), np.float32), np.zeros((0, 7)), none, none)


def test_checkpoint_to_onnx(trained, tmp_path):
    _, folder = trained
    detector = checkpoint_detector(folder / "last.pt", CONFIG, nms="off", score_threshold=0.0)
    export_onnx(detector, tmp_path / "lidar.onnx")
    exported = OnnxLidarDetector(tmp_path / "lidar.onnx", nms="off", score_threshold=0.0, threads=1)
    found, wanted = exported(scene(4).points), detector(scene(4).points)
    assert len(found) == len(wanted) > 0
    np.testing.assert_allclose(found.scores, wanted.scores, atol=1e-4)


def test_a_training_can_begin_with_another(trained, tmp_path):
    network, folder = trained
    nothing = TrainingSettings(steps=1, learning_rate=1e-12, average=0.0, checkpoint_every=1)
    begun = train(TASK, nothing, tmp_path, start=folder / "last.pt")
    for (name, value), other in zip(network.named_parameters(), begun.parameters(), strict=True):
        torch.testing.assert_close(value, other, msg=name)


def test_another_tilt_is_another_training():
    tilted = replace(TASK, augmentation=replace(TASK.augmentation, tilt=0.01))
    assert tilted.described()["tilt"] == 0.01
    assert tilted.described() != TASK.described()


def test_checkpoints_of_another_network(trained, tmp_path):
    state = torch.load(trained[1] / "last.pt", weights_only=True)
    state["averaged"].pop("bbox_head.task_heads.0.bias")
    torch.save(state, tmp_path / "last.pt")
    with pytest.raises(DetectorError, match=r"another architecture.*task_heads\.0\.bias"):
        checkpoint_detector(tmp_path / "last.pt", CONFIG)
    with pytest.raises(DetectorError, match="another architecture"):
        train(TASK, SETTINGS, tmp_path / "other", start=tmp_path / "last.pt")
    with pytest.raises(DetectorError, match="does not exist"):
        checkpoint_detector(tmp_path / "none.pt", CONFIG)
    with pytest.raises(ConfigError, match="no centre head"):
        replace(TASK, config=replace(CONFIG, centers=None)).batch(0, np.random.default_rng(0))

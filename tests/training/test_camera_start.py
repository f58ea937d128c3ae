"""Trainings of the camera detector that begin with an exported network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from lcf3d.datasets.drive import read_drive  # noqa: E402
from lcf3d.detectors.camera.small import shipped_path  # noqa: E402
from lcf3d.detectors.camera.small_export import export_small  # noqa: E402
from lcf3d.detectors.camera.small_network import SmallConfig  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError  # noqa: E402
from lcf3d.networks.onnx import open_session  # noqa: E402
from lcf3d.training.camera import CameraTask  # noqa: E402
from lcf3d.training.camera_augmentation import Augmentation  # noqa: E402
from lcf3d.training.camera_images import drive_images  # noqa: E402
from lcf3d.training.camera_start import exported_parameters, module_name  # noqa: E402
from tests.training.camera_pictures import picture  # noqa: E402

IMAGES = (
    picture([("Car", (20, 16, 60, 48)), ("Pedestrian", (70, 10, 80, 40))]),
    picture([("Cyclist", (10, 20, 30, 50))]),
)


def task(prototypes: int = 16, begin: Path | None = None, classes: int = 3) -> CameraTask:
    config = SmallConfig(classes=classes, prototypes=prototypes)
    return CameraTask(IMAGES, (), config, batch_size=4, view=(96, 128), begin=begin)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped network as a file without layers of bytes."""
    path = tmp_path_factory.mktemp("plain") / "camera.onnx"
    export_small(task(begin=shipped_path("kitti")).network(), path)
    return path


@pytest.mark.parametrize("prototypes", [16, 0])
def test_a_training_begins_where_the_exported_network_stands(prototypes: int, plain: Path) -> None:
    begun = task(prototypes, plain)
    network = begun.network()
    assert network.training
    image = np.random.default_rng(1).random((1, 3, 96, 160), dtype=np.float32)
    exported = open_session(plain, 1, "").run(None, {"images": image})
    with torch.no_grad():
        outputs = network.eval()(torch.from_numpy(image))
    table = (outputs[0] if prototypes else outputs).numpy()
    np.testing.assert_allclose(table[:, :4], exported[0][:, :4], rtol=1e-3, atol=1e-2)
    # scores are calibrated in the file only, which changes no order
    for label in (4, 5, 6):
        np.testing.assert_array_equal(np.argsort(-table[0, label])[:5], np.argsort(-exported[0][0, label])[:5])
    if prototypes:
        np.testing.assert_allclose(table[:, 7:], exported[0][:, 7:], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(outputs[1], exported[1], rtol=1e-3, atol=1e-3)


def test_bytes_of_the_shipped_network_become_weights_again() -> None:
    image = read_drive(count=1)[0].image[:352, :1216].transpose(2, 0, 1)[None] / np.float32(255)
    exported = open_session(shipped_path("kitti"), 1, "").run(None, {"images": image})
    with torch.no_grad():
        table, prototypes = task(begin=shipped_path("kitti")).network().eval()(torch.from_numpy(image))
    # the file rounds its maps as well, so that the two are alike and not equal
    assert np.corrcoef(table[0, 4:7].flatten(), exported[0][0, 4:7].ravel())[0, 1] > 0.95
    assert np.corrcoef(prototypes.flatten(), exported[1].ravel())[0, 1] > 0.99
    best = np.argsort(-exported[0][0, 4:7].max(axis=0))[:60]
    assert np.median(np.abs(table.numpy()[0, :4, best] - exported[0][0, :4, best])) < 2


def test_in_training_it_knows_what_the_shipped_network_knows() -> None:
    images = drive_images()[:2]
    plain = Augmentation(as_it_is=1.0, gain=0.0, blurred=0.0, noisy=0.0, grey=0.0, sought=1.0)
    begun, fresh = (
        CameraTask(images, (), SmallConfig(prototypes=0), 2, (256, 640), plain, begin=path)
        for path in (shipped_path("kitti"), None)
    )
    batch = begun.batch(0, np.random.default_rng(0))
    with torch.no_grad():
        losses = [sum(t.item() for t in one.loss(one.network(), batch).values()) for one in (begun, fresh)]
    assert losses[0] < 0.5 * losses[1]


def test_an_exported_training_begins_another(tmp_path: Path) -> None:
    torch.manual_seed(4)
    first = task().network()
    with torch.no_grad():
        first.scale.copy_(torch.tensor([1.1, 0.9, 1.2]))
    export_small(first, tmp_path / "camera.onnx")
    second = task(begin=tmp_path / "camera.onnx").network()
    torch.testing.assert_close(second.scale, first.scale)
    image = torch.rand(1, 3, 64, 96)
    with torch.no_grad():
        torch.testing.assert_close(second.eval()(image), first.eval()(image), rtol=1e-3, atol=1e-2)
    parameters, scales = exported_parameters(tmp_path / "camera.onnx")
    # weights and biases of 32 convolutions; two are used at three sizes
    assert sum("_" not in name for name in parameters) == 2 * 32
    assert scales == pytest.approx([1.1, 0.9, 1.2])


def test_what_is_no_small_detector_is_refused(tmp_path: Path) -> None:
    from lcf3d.detectors.lidar.kinds import MODELS

    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"\x08\xff\xff")
    export_small(task(prototypes=0).network(), tmp_path / "plain.onnx")
    for path, message in (
        (tmp_path / "absent.onnx", "does not exist"),
        (broken, "ONNX"),
        (MODELS / "lidar_kitti.onnx", "is no small camera detector to begin with"),
        # a network without masks cannot begin one with them
        (tmp_path / "plain.onnx", "is no small camera detector to begin with: predict.weight has shape"),
    ):
        with pytest.raises(DetectorError, match=message):
            task(begin=path).network()
    with pytest.raises(ConfigError, match="no camera detector 'waymo'"):
        shipped_path("waymo")


def test_a_training_says_what_it_began_with() -> None:
    assert task(begin=shipped_path("kitti")).described()["begin"] == "camera_kitti.onnx"
    assert "begin" not in task().described()


def test_names_of_modules() -> None:
    assert module_name("/stages.1/stages.1.2/body/body.0/body.0.0/Conv") == "stages.1.2.body.0.0"
    assert module_name("/predict/Conv") == "predict"
    assert module_name("/stem/stem.0/Conv") == "stem.0"

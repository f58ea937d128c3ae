from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import ConfigError
from lcf3d.structures import KITTI_CLASSES

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from lcf3d.detectors.camera.onnx import OnnxDetector  # noqa: E402
from lcf3d.detectors.camera.onnx_layouts import cell_count  # noqa: E402
from lcf3d.detectors.camera.small_export import export_small  # noqa: E402
from lcf3d.detectors.camera.small_network import SmallConfig, SmallDetector, SmallOutputs  # noqa: E402

TINY = SmallConfig(channels=(4, 4, 8, 8, 8), depths=(0, 1, 0, 0), neck=8, prototypes=2)
PLAIN = SmallConfig(channels=(4, 4, 8, 8, 8), depths=(0, 0, 0, 0), neck=8, prototypes=0)


@pytest.fixture(scope="module")
def network() -> SmallDetector:
    torch.manual_seed(0)
    made = SmallDetector(TINY)
    with torch.no_grad():
        made.predict.bias[:3] = 0.0  # scores that pass the threshold
        made.calibration[:] = torch.tensor([0.5, 1.0])
    return made.eval()


@pytest.fixture(scope="module")
def file(network: SmallDetector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / "small.onnx"
    export_small(network, path, size=(64, 96))
    return path


def test_outputs_have_the_layout_of_the_reader(network: SmallDetector) -> None:
    with torch.no_grad():
        table, prototypes = network(torch.zeros(2, 3, 64, 96))
    assert table.shape == (2, 4 + 3 + 2, cell_count((64, 96)))
    assert prototypes.shape == (2, 2, 16, 24)


def test_a_new_network_predicts_squares_of_its_strides_around_its_cells() -> None:
    made = SmallDetector(TINY)
    with torch.no_grad():
        made.predict.weight.zero_()
        boxes = made.outputs(torch.zeros(1, 3, 64, 96)).boxes[0]
    assert boxes[[0, 1, 96, -1]].tolist() == [[0, 0, 8, 8], [8, 0, 16, 8], [0, 0, 16, 16], [64, 32, 96, 64]]


def test_training_mode_gives_what_losses_need() -> None:
    outputs = SmallDetector(PLAIN).train()(torch.zeros(2, 3, 32, 64))
    assert isinstance(outputs, SmallOutputs)
    assert outputs.prototypes is None
    assert outputs.coefficients.shape[2] == 0


def test_the_exported_file_gives_what_torch_gives(network: SmallDetector, file: Path) -> None:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(file))
    # the second size is not the one it was exported with
    for size in ((64, 96), (96, 64)):
        image = np.random.default_rng(0).random((1, 3, *size), dtype=np.float32)
        with torch.no_grad():
            expected = network(torch.from_numpy(image))
        for got, wanted in zip(session.run(None, {"images": image}), expected, strict=True):
            np.testing.assert_allclose(got, wanted.numpy(), atol=2e-4, rtol=1e-4)


@pytest.mark.parametrize("shape", [(64, 96), (37, 203), (200, 31), (1, 1)])
def test_the_detector_takes_images_of_any_size(file: Path, shape: tuple[int, int]) -> None:
    detector = OnnxDetector(file, threads=1)
    assert detector.layout == "ultralytics"
    assert detector.own_class_names == KITTI_CLASSES
    grey = np.repeat(np.random.default_rng(0).integers(0, 255, (*shape, 1), dtype=np.uint8), 3, axis=2)
    (found,) = detector([grey])
    assert found.masks is not None
    assert (found.boxes >= 0).all()
    assert (found.boxes[:, 2] <= shape[1]).all()


def test_another_input_size_can_be_asked_for(file: Path) -> None:
    OnnxDetector(file, size="128x64", threads=1)([np.zeros((60, 40, 3), np.uint8)])


def test_without_masks(tmp_path: Path) -> None:
    made = SmallDetector(PLAIN).train()
    export_small(made, tmp_path / "plain.onnx", size=(64, 96))
    assert made.training
    detector = OnnxDetector(tmp_path / "plain.onnx", score_threshold=0.0, threads=1)
    (found,) = detector([np.zeros((64, 96, 3), np.uint8)])
    assert found.masks is None


def test_names_must_fit_the_classes(network: SmallDetector, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="3 classes, got 2 names"):
        export_small(network, tmp_path / "x.onnx", names=("Car", "Pedestrian"))


def test_sizes_that_make_no_sense() -> None:
    with pytest.raises(ConfigError, match="classes must be 1 or more"):
        SmallConfig(classes=0)

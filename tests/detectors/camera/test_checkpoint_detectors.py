"""What DDQ-DETR and DetectoRS take and refuse, and their parts by hand; their numbers are in the parity tests."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torchvision")

from lcf3d.detectors.camera import checkpoint_detector, ddq, detectors_cascade  # noqa: E402
from lcf3d.detectors.classes import COCO_CLASSES  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError, ShapeError  # noqa: E402


class Fixed(checkpoint_detector.CheckpointDetector):
    """Finds one box in the network's input and remembers that input."""

    name = "Fixed"
    marks = ("weight",)
    multiple = 32

    @classmethod
    def build(cls, state):
        return torch.nn.Linear(1, 3, bias=False)

    @classmethod
    def class_count(cls, state):
        return len(state["weight"])

    @classmethod
    def own_parameters(cls, state):
        return dict(state)

    def find(self, image, width, height):
        self.seen = image, width, height
        boxes = np.array([[0, 0, width / 2, height], [-5, 0, width + 9, 10], [0, 0, 1, 1]], float)
        return boxes, np.array([0.9, 0.5, 0.01]), np.array([0, 2, 1])


WEIGHT = {"weight": torch.zeros(3, 1)}


def test_boxes_come_back_in_pixels_of_the_image():
    detector = Fixed.from_state_dict(WEIGHT)
    image = np.zeros((200, 400, 3), np.uint8)
    image[..., 0] = 255
    found = detector([image])[0]
    tensor, width, height = detector.seen
    # 400 x 200 fits 1333 x 800 with a factor of 1333 / 400
    assert (width, height) == (1333, 667)
    assert tuple(tensor.shape) == (1, 3, 672, 1344)
    mean, std = checkpoint_detector.MEAN, checkpoint_detector.STD
    np.testing.assert_allclose(tensor[0, :, 0, 0], (np.array([255, 0, 0]) - mean) / std, rtol=1e-5)
    assert not tensor[0, :, 667:].any()
    np.testing.assert_allclose(found.boxes, [[0, 0, 200, 200], [0, 0, 400, 10 * 200 / 667]])
    assert found.class_names == ("Car", "Pedestrian", "Cyclist")
    assert found.labels.tolist() == [0, 2]


def test_what_is_refused():
    with pytest.raises(ShapeError, match=r"\(H, W, 3\)"):
        Fixed.from_state_dict(WEIGHT)([np.zeros((5, 5), np.uint8)])
    with pytest.raises(ConfigError, match="score_threshold"):
        Fixed.from_state_dict(WEIGHT, score_threshold=2)
    with pytest.raises(DetectorError, match="no DDQ-DETR of OpenMMLab: it lacks bbox_head"):
        ddq.DDQDetector.from_state_dict(WEIGHT)
    with pytest.raises(DetectorError, match="no DetectoRS of OpenMMLab: it lacks roi_head"):
        detectors_cascade.DetectoRSDetector.from_state_dict(WEIGHT)


def test_classes_of_a_checkpoint():
    names = checkpoint_detector.network_classes
    assert names(80, "") == COCO_CLASSES
    assert names(3, "") == ("Car", "Pedestrian", "Cyclist")
    assert names(2, "Car, Van") == ("Car", "Van")
    with pytest.raises(ConfigError, match="has 2 classes, 1 are named"):
        names(2, "Car")
    with pytest.raises(ConfigError, match=r"has 10 classes: name them"):
        names(10, "")


def test_cell_boxes():
    cells = ddq.cell_boxes([(1, 2), (1, 1)], torch.zeros(1))
    expected = [[0.25, 0.5, 0.05, 0.05], [0.75, 0.5, 0.05, 0.05], [0.5, 0.5, 0.1, 0.1]]
    np.testing.assert_allclose(cells.numpy(), expected, rtol=1e-6)


def test_best_pairs():
    scores = torch.tensor([[0.1, 0.9], [0.8, 0.2]])
    boxes = torch.tensor([[0.5, 0.5, 1.0, 1.0], [0.25, 0.5, 0.5, 0.5]])
    found, values, labels = ddq.best_pairs(scores, boxes, 100, 50)
    np.testing.assert_allclose(values, [0.9, 0.8, 0.2, 0.1])
    assert labels.tolist() == [1, 0, 1, 0]
    np.testing.assert_allclose(found[:2], [[0, 0, 100, 50], [0, 12.5, 50, 37.5]])


@torch.inference_mode()
def test_switchable_convolution_without_offsets_is_a_mixture():
    torch.manual_seed(0)
    conv = detectors_cascade.SwitchableConv(4, 1)
    for parameter in conv.parameters():
        torch.nn.init.zeros_(parameter)
    torch.nn.init.normal_(conv.weight)
    torch.nn.init.normal_(conv.weight_diff)
    torch.nn.init.constant_(conv.switch.bias, 0.25)
    x = torch.randn(1, 4, 9, 11)
    near = torch.nn.functional.conv2d(x, conv.weight, padding=1)
    far = torch.nn.functional.conv2d(x, conv.weight + conv.weight_diff, padding=3, dilation=3)
    torch.testing.assert_close(conv(x), 0.25 * near + 0.75 * far, rtol=1e-4, atol=1e-4)


def test_standardized_weights():
    weight = torch.randn(5, 3, 3, 3)
    gamma, beta = torch.rand(5, 1, 1, 1) + 0.5, torch.randn(5, 1, 1, 1)
    name = "backbone.conv1"
    state = {f"{name}.weight": weight, f"{name}.weight_gamma": gamma, f"{name}.weight_beta": beta}
    own = detectors_cascade.DetectoRSDetector.own_parameters({**state, "neck.x.weight": weight})
    assert set(own) == {f"{name}.weight", "neck.x.weight"}
    assert own["neck.x.weight"] is weight
    flat = own[f"{name}.weight"].flatten(1)
    torch.testing.assert_close(flat.mean(dim=1), beta.flatten(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(flat.std(dim=1), gamma.flatten(), rtol=1e-3, atol=1e-4)

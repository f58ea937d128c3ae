"""The mmdet adapter on a stub with mmdet's functions and result structure."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from lcf3d.detectors.camera.mmdet import MmdetDetector
from lcf3d.errors import ConfigError, DetectorError, Lcf3dError


class Tensor:
    """As much of a torch tensor as the adapter uses."""

    def __init__(self, value):
        self.value = np.asarray(value)

    def detach(self):
        return self

    def cpu(self):
        return self

    def numpy(self):
        return self.value


class InstanceData(SimpleNamespace):
    """mmengine's container: attributes, and ``in`` for their names."""

    def __contains__(self, name):
        return name in vars(self)


@pytest.fixture
def stub(monkeypatch):
    seen = {}

    def init_detector(config, checkpoint, device):
        if checkpoint == "broken.pth":
            raise KeyError("DDQDETR is not in the registry")
        seen.update(config=config, checkpoint=checkpoint, device=device)
        return SimpleNamespace(dataset_meta={"classes": ("person", "car", "dog")})

    def inference_detector(model, images):
        seen["images"] = images
        mask = np.zeros((3, 20, 30), bool)
        mask[0, 5:10, 4:8] = True
        instances = InstanceData(
            bboxes=Tensor(np.array([[4, 5, 8, 10], [0, 0, 5, 5], [1, 1, 2, 2]], np.float32)),
            scores=Tensor(np.array([0.9, 0.6, 0.01], np.float32)),
            labels=Tensor(np.array([1, 2, 0])),
        )
        if seen["config"] == "mask.py":
            instances.masks = Tensor(mask)
        return [SimpleNamespace(pred_instances=instances) for _ in images]

    package, apis = ModuleType("mmdet"), ModuleType("mmdet.apis")
    apis.init_detector, apis.inference_detector = init_detector, inference_detector
    package.apis = apis
    monkeypatch.setitem(sys.modules, "mmdet", package)
    monkeypatch.setitem(sys.modules, "mmdet.apis", apis)
    return seen


def test_boxes_classes_and_channel_order(stub):
    detector = MmdetDetector("ddq.py,ddq.pth", class_names=("Car", "Pedestrian"), device="cuda:0")
    image = np.zeros((20, 30, 3), np.uint8)
    image[..., 0] = 255
    found = detector([image, image])
    assert (stub["config"], stub["checkpoint"], stub["device"]) == ("ddq.py", "ddq.pth", "cuda:0")
    assert stub["images"][0][0, 0].tolist() == [0, 0, 255]
    assert len(found) == 2
    # the dog has no class here, the person is below the threshold
    assert found[0].boxes.tolist() == [[4, 5, 8, 10]]
    assert found[0].scores[0] == pytest.approx(0.9)
    assert found[0].labels.tolist() == [0]
    assert found[0].masks is None


def test_masks(stub):
    found = MmdetDetector("mask.py,mask.pth")([np.zeros((20, 30, 3), np.uint8)])[0]
    assert found.class_names == ("person", "car", "dog")
    assert (found.masks[0].x, found.masks[0].y, found.masks[0].bitmap.shape) == (4, 5, (5, 4))


def test_errors(stub):
    with pytest.raises(ConfigError, match="CONFIG,CHECKPOINT"):
        MmdetDetector("config.py")
    with pytest.raises(DetectorError, match="not in the registry"):
        MmdetDetector("a.py,broken.pth")


def test_without_mmdet(monkeypatch):
    monkeypatch.setitem(sys.modules, "mmdet", None)
    monkeypatch.setitem(sys.modules, "mmdet.apis", None)
    with pytest.raises(Lcf3dError, match="mmdet 3 and mmcv"):
        MmdetDetector("a.py,b.pth")

"""torchvision's detectors by name, with random weights, and a folder in place of the download server."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
torchvision = pytest.importorskip("torchvision")

from lcf3d.detectors.camera import torchvision_models  # noqa: E402
from lcf3d.detectors.camera.torchvision_models import (  # noqa: E402
    MODELS,
    TorchvisionDetector,
    build_network,
    coco_parameters,
    current_names,
)
from lcf3d.detectors.classes import COCO_CLASSES  # noqa: E402
from lcf3d.detectors.named import load_detector  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError, MissingExtraError, ShapeError  # noqa: E402
from lcf3d.structures import KITTI_CLASSES  # noqa: E402

IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
OLD_NAMES = {
    "rpn.head.conv.0.0.weight": "rpn.head.conv.weight",
    "rpn.head.conv.0.0.bias": "rpn.head.conv.bias",
    "backbone.fpn.inner_blocks.2.0.weight": "backbone.fpn.inner_blocks.2.weight",
    "backbone.fpn.layer_blocks.0.0.bias": "backbone.fpn.layer_blocks.0.bias",
    "roi_heads.mask_head.0.0.weight": "roi_heads.mask_head.mask_fcn1.weight",
    "roi_heads.mask_head.3.0.bias": "roi_heads.mask_head.mask_fcn4.bias",
}


def random_state(name, outputs=4, frozen=False):
    """Parameters that make a network propose and score something, with the names that torchvision writes."""
    detection = torchvision.models.detection
    with torch.device("meta"):
        if name == "fasterrcnn_resnet101_fpn":
            network = detection.FasterRCNN(
                detection.backbone_utils.resnet_fpn_backbone(
                    backbone_name="resnet101", weights=None, norm_layer=torch.nn.BatchNorm2d
                ),
                outputs,
            )
        else:
            network = getattr(detection, name)(weights=None, weights_backbone=None, num_classes=outputs)
    torch.manual_seed(0)
    state = {}
    for key, value in network.state_dict().items():
        if key.endswith("num_batches_tracked"):
            if not frozen:
                state[key] = torch.zeros((), dtype=torch.int64)
        elif key.endswith("running_var"):
            state[key] = torch.ones(value.shape)
        elif value.ndim >= 2:
            state[key] = torch.empty(value.shape).normal_(0, (1.0 / value[0].numel()) ** 0.5)
        else:
            state[key] = torch.full(value.shape, 1.0 if key.endswith(("bn1.weight", "bn2.weight")) else 0.1)
    return state


def quick(detector):
    """The detector on small images, with few proposals."""
    detector.network.transform.min_size, detector.network.transform.max_size = (64,), 64
    detector.network.rpn._pre_nms_top_n = detector.network.rpn._post_nms_top_n = {"training": 20, "testing": 20}
    return detector


@pytest.fixture(scope="module")
def mask_file(tmp_path_factory):
    """As torchvision's training script writes it."""
    path = tmp_path_factory.mktemp("weights") / "model_25.pth"
    torch.save({"model": random_state("maskrcnn_resnet50_fpn"), "epoch": 25}, path)
    return path


@pytest.mark.parametrize("name", MODELS)
def test_every_network_runs_and_gives_what_torchvision_gives(name):
    state = random_state(name)
    network = build_network(name, state, 4, 0.0)
    detector = TorchvisionDetector.__new__(TorchvisionDetector)
    detector.network = network
    quick(detector)
    tensor = torch.from_numpy(IMAGE).permute(2, 0, 1).float() / 255
    with torch.inference_mode():
        found = network([tensor])[0]
    assert len(found["boxes"]) > 0
    assert torch.isfinite(found["boxes"]).all()
    assert ("masks" in found) == name.startswith("maskrcnn")
    if name in ("maskrcnn_resnet50_fpn", "fasterrcnn_resnet50_fpn_v2"):
        original = getattr(torchvision.models.detection, name)(
            weights=None, weights_backbone=None, num_classes=4, box_score_thresh=0.0, min_size=64, max_size=64
        )
        original.load_state_dict(state)
        original.rpn._pre_nms_top_n = original.rpn._post_nms_top_n = network.rpn._post_nms_top_n
        with torch.inference_mode():
            expected = original.eval()([tensor])[0]
        for key, value in expected.items():
            torch.testing.assert_close(found[key], value, rtol=1e-4, atol=1e-4)


def test_a_checkpoint_named_on_the_command_line(mask_file):
    names = "car,person,bicycle"
    detector = load_detector(
        f"torchvision:maskrcnn_resnet50_fpn?checkpoint={mask_file}&names={names}&score_threshold=0.2",
        "camera",
        KITTI_CLASSES,
    )
    first, second = quick(detector)([IMAGE, IMAGE[:40]])
    assert detector.own_class_names == ("car", "person", "bicycle")
    assert first.class_names == KITTI_CLASSES
    assert len(first) > 0
    assert (np.diff(first.scores) <= 0).all()
    assert (first.scores > 0.2).all()
    assert first.boxes[:, 2].max() <= 64
    assert second.boxes[:, 3].max(initial=0) <= 40
    assert len(first.masks) == len(first)
    with pytest.raises(ShapeError, match=r"\(H, W, 3\) uint8"):
        detector([IMAGE[..., 0]])
    with pytest.raises(ShapeError, match="float64"):
        detector([IMAGE / 255])


def test_masks_lie_where_the_probability_is_over_a_half():
    detector = TorchvisionDetector.__new__(TorchvisionDetector)
    detector.own_class_names, detector._own_labels = ("car",), np.array([-1, 0])
    masks = np.zeros((2, 1, 20, 30))
    masks[0, 0, 5:9, 3:8], masks[0, 0, 9, 3:8] = 0.6, 0.4
    found = detector._convert(
        {
            "boxes": np.array([[3.0, 5, 8, 10], [0, 0, 9, 9]]),
            "labels": np.array([1, 0]),
            "scores": np.array([0.9, 0.8]),
            "masks": masks,
        }
    )
    assert found.boxes.tolist() == [[3, 5, 8, 10]]
    assert (found.masks[0].x, found.masks[0].y, found.masks[0].bitmap.shape) == (3, 5, (4, 5))


def test_a_rider_of_coco_becomes_a_cyclist(monkeypatch):
    monkeypatch.setattr(torchvision_models, "coco_parameters", lambda name: random_state(name, 91, frozen=True))
    detector = TorchvisionDetector("fasterrcnn_resnet50_fpn", KITTI_CLASSES)
    assert detector.own_class_names == COCO_CLASSES
    categories = torchvision.models.get_model_weights("fasterrcnn_resnet50_fpn").DEFAULT.meta["categories"]
    output = {
        "boxes": torch.tensor([[10.0, 0, 20, 30], [5, 15, 25, 32], [40, 10, 60, 30]]),
        "labels": torch.tensor([categories.index(n) for n in ("person", "bicycle", "car")]),
        "scores": torch.tensor([0.64, 0.81, 0.9]),
    }
    detector.network = lambda images: [output]
    found = detector([IMAGE])[0]
    assert [KITTI_CLASSES[label] for label in found.labels] == ["Car", "Cyclist"]
    assert found.boxes[1].tolist() == [5, 0, 25, 32]
    assert found.scores[1] == pytest.approx(0.72)


def test_the_normalization_is_that_of_the_training():
    def eps(name, outputs, frozen):
        network = build_network(name, random_state(name, outputs, frozen), outputs, 0.5)
        return type(network.backbone.body.bn1).__name__, network.backbone.body.bn1.eps

    assert eps("fasterrcnn_resnet50_fpn", 91, True) == ("FrozenBatchNorm2d", 0.0)
    assert eps("fasterrcnn_resnet50_fpn", 4, True) == ("FrozenBatchNorm2d", 1e-5)
    assert eps("fasterrcnn_resnet50_fpn", 4, False) == ("BatchNorm2d", 1e-5)


def test_files_of_older_torchvision():
    assert current_names(dict.fromkeys(OLD_NAMES.values())).keys() == OLD_NAMES.keys()
    state = random_state("maskrcnn_resnet50_fpn")
    assert current_names(state).keys() == state.keys()
    assert OLD_NAMES.keys() <= state.keys()


@pytest.fixture
def served(tmp_path, monkeypatch):
    """The weights of a detector come from a folder, and torch's cache is empty."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "server"
    folder.mkdir()
    torch.save({"layer.weight": torch.ones(2)}, folder / "net.pth")
    digest = hashlib.sha256((folder / "net.pth").read_bytes()).hexdigest()[:8]
    good = folder / f"net-{digest}.pth"
    (folder / "net.pth").rename(good)
    weights = type(torchvision.models.get_model_weights("maskrcnn_resnet50_fpn").DEFAULT)

    def serve(path):
        monkeypatch.setattr(weights, "url", path.as_uri())
        return path

    serve(good)
    return serve, good


def test_weights_are_downloaded_once(served, capsys, tmp_path):
    _, good = served
    assert torch.equal(coco_parameters("maskrcnn_resnet50_fpn")["layer.weight"], torch.ones(2))
    assert "Downloading" not in capsys.readouterr().out
    cached = tmp_path / "cache" / "hub" / "checkpoints" / good.name
    assert cached.is_file()
    good.unlink()
    assert list(coco_parameters("maskrcnn_resnet50_fpn")) == ["layer.weight"]
    cached.write_bytes(b"half")
    with pytest.raises(DetectorError, match=f"{good.name}.*half downloaded"):
        coco_parameters("maskrcnn_resnet50_fpn")


def test_offline_the_message_says_what_to_put_where(served, tmp_path):
    serve, good = served
    missing = serve(tmp_path / "nowhere" / "net-12345678.pth")
    with pytest.raises(DetectorError) as caught:
        TorchvisionDetector("maskrcnn_resnet50_fpn")
    for part in (missing.as_uri(), str(tmp_path / "cache" / "hub" / "checkpoints" / missing.name), "?checkpoint=FILE"):
        assert part in str(caught.value)
    other = good.with_name("net-00000000.pth")
    other.write_bytes(good.read_bytes())
    serve(other)
    with pytest.raises(DetectorError, match="invalid hash value"):
        coco_parameters("maskrcnn_resnet50_fpn")
    assert not list((tmp_path / "cache" / "hub" / "checkpoints").iterdir())


def test_the_network_of_the_paper_needs_a_checkpoint():
    with pytest.raises(DetectorError, match=r"no COCO weights for fasterrcnn_resnet101_fpn.*checkpoint=FILE"):
        TorchvisionDetector("fasterrcnn_resnet101_fpn")


def test_checkpoints_that_do_not_fit(mask_file, tmp_path):
    def save(state):
        torch.save(state, tmp_path / "changed.pth")
        return tmp_path / "changed.pth"

    state = torch.load(mask_file, weights_only=True)["model"]
    names = ("car", "person", "bicycle")
    first = "backbone.body.layer2.0.conv1.weight"
    changed = save({**state, first: torch.ones(3, 3)})
    with pytest.raises(DetectorError, match=rf"maskrcnn_resnet50_fpn.*architecture: 1 of another shape: {first}"):
        TorchvisionDetector("maskrcnn_resnet50_fpn", checkpoint=changed, names=names)
    with pytest.raises(DetectorError, match=r"fasterrcnn_resnet50_fpn with 3 classes .*unexpected: roi_heads\.mask"):
        TorchvisionDetector("fasterrcnn_resnet50_fpn", checkpoint=mask_file, names=names)
    with pytest.raises(DetectorError, match=r"has 3 classes .*name them with names=first"):
        TorchvisionDetector("maskrcnn_resnet50_fpn", checkpoint=mask_file)
    with pytest.raises(DetectorError, match=r"has 3 classes .*gives 2"):
        TorchvisionDetector("maskrcnn_resnet50_fpn", checkpoint=mask_file, names="car,person")
    with pytest.raises(DetectorError, match=r"no maskrcnn_resnet50_fpn of torchvision: it lacks roi_heads"):
        TorchvisionDetector("maskrcnn_resnet50_fpn", checkpoint=save({"fc.weight": torch.ones(1)}))
    with pytest.raises(DetectorError, match=r"nowhere\.pth does not exist"):
        TorchvisionDetector("maskrcnn_resnet50_fpn", checkpoint=Path("nowhere.pth"))


def test_settings_that_make_no_sense():
    with pytest.raises(ConfigError, match=r"unknown torchvision detector 'retinanet'.*maskrcnn_resnet50_fpn_v2"):
        TorchvisionDetector("retinanet")
    with pytest.raises(ConfigError, match="score_threshold must be in"):
        TorchvisionDetector("maskrcnn_resnet50_fpn", score_threshold=2)
    with pytest.raises(ConfigError, match="leave them out for the COCO weights"):
        TorchvisionDetector("maskrcnn_resnet50_fpn", names="car")


def test_without_torchvision(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(MissingExtraError, match=r"needs torchvision.*lcf3d\[train\]"):
        TorchvisionDetector("maskrcnn_resnet50_fpn")

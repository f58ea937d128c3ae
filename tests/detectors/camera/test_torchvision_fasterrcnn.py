"""Faster R-CNN of OpenMMLab checkpoints: the original's maps with parameters filled by rule, and its parts by hand."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torchvision")

from lcf3d.detectors.camera.torchvision_boxes import (  # noqa: E402
    anchor_grid,
    decode_boxes,
    roi_features,
    select_detections,
)
from lcf3d.detectors.camera.torchvision_fasterrcnn import FasterRCNNNetwork, TorchvisionFasterRCNN  # noqa: E402
from lcf3d.detectors.camera.torchvision_masks import instance_masks  # noqa: E402
from lcf3d.detectors.camera.torchvision_styles import STYLES, find_style, normalization_of, parse_size  # noqa: E402
from lcf3d.detectors.classes import COCO_CLASSES  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError, ShapeError  # noqa: E402


def filled_state(folder, name):
    spec = importlib.util.spec_from_file_location("fill", folder / "fill.py")
    fill = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fill)
    shapes = json.loads((folder / f"{name}.shapes.json").read_text())
    return {key: torch.from_numpy(value) for key, value in fill.fill_state_dict(shapes).items()}


@pytest.mark.real
@pytest.mark.parametrize("name", ["fasterrcnn_kitti", "fasterrcnn_nus"])
@torch.inference_mode()
def test_the_original_maps(shared, name):
    folder = shared / "golden" / "models"
    info = json.loads((folder / f"{name}.json").read_text())
    with np.load(folder / f"{name}.npz") as file:
        data = dict(file)
    detector = TorchvisionFasterRCNN.from_state_dict(filled_state(folder, name))
    network = detector.network
    rgb = torch.from_numpy(data["input"][..., ::-1].copy()).permute(2, 0, 1)[None].float()

    def check(stage, value):
        expected = info["maps"][stage]
        assert list(value.shape) == expected["shape"], stage
        found = value.double().numpy().ravel()[data[f"map.{stage}.index"]]
        wanted = data[f"map.{stage}.value"]
        assert (np.abs(found - wanted) / np.maximum(np.abs(wanted), expected["std"])).max() < 1e-4, stage

    maps = network.backbone(detector.normalize(rgb))
    for i, value in enumerate(maps):
        check(f"backbone.{i}", value)
    maps = network.neck(maps)
    for i, value in enumerate(maps):
        check(f"neck.{i}", value)
    for kind, values in enumerate(network.rpn_head(maps)):
        for i, value in enumerate(values):
            check(f"rpn_head.{kind}.{i}", value)
    # the scores of both stages are 1 in float32: which regions of equal score come first is not defined
    height, width = data["input"].shape[:2]
    pooled = roi_features(maps[:4], network.propose(maps, height, width), (4, 8, 16, 32))
    expected = info["maps"]["roi_head.bbox_roi_extractor"]
    assert list(pooled.shape) == expected["shape"]
    assert float(pooled.std()) == pytest.approx(expected["std"], rel=0.01)
    if name == "fasterrcnn_nus":
        scores, boxes = network(maps, height, width)
        found = select_detections(boxes.numpy(), scores.numpy(), 0.05, 0.5, soft=False)
        wanted = data["prediction.bboxes"]
        np.testing.assert_allclose(sorted(found[0].tolist()), sorted(wanted.tolist()), atol=0.05)
        assert set(found[2]) == set(data["prediction.labels"])


@pytest.fixture(scope="module")
def random_file(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "fasterrcnn.pth"
    torch.save({"state_dict": FasterRCNNNetwork(50, STYLES["nuscenes"]).state_dict()}, path)
    return path


def test_a_checkpoint_runs_and_keeps_pixels_of_the_image(random_file):
    detector = TorchvisionFasterRCNN(
        random_file, class_names=("Car", "Pedestrian", "Cyclist"), score_threshold=0.0, size="320x320"
    )
    # 160 x 90 pixels fit twice, and are padded to multiples of 32
    assert detector.prepare(np.zeros((90, 160, 3), np.uint8))[0].shape == (1, 3, 192, 320)
    found = detector([np.zeros((90, 160, 3), np.uint8)])[0]
    assert found.class_names == ("Car", "Pedestrian", "Cyclist")
    assert len(found) > 0
    assert found.boxes.min() >= 0
    assert found.boxes[:, 2].max() <= 160
    assert found.boxes[:, 3].max() <= 90
    with pytest.raises(ShapeError, match=r"\(H, W, 3\)"):
        detector([np.zeros((90, 160), np.uint8)])


@pytest.mark.parametrize("size", ["320", "225x400", "400x20", "x", "400x225px"])
def test_sizes_that_are_none(size):
    with pytest.raises(ConfigError, match="size must read LONGERxSHORTER"):
        parse_size(size)


def test_checkpoints_of_other_networks(random_file):
    with pytest.raises(DetectorError, match=r"lacks roi_head\.bbox_head\.fc_cls\.weight"):
        TorchvisionFasterRCNN.from_state_dict({"weight": torch.ones(1)})
    state = torch.load(random_file, weights_only=True)["state_dict"]
    with pytest.raises(DetectorError, match=r"5 classes and 3 anchors"):
        find_style({**state, "roi_head.bbox_head.fc_cls.weight": torch.ones(6, 1024)})
    with pytest.raises(DetectorError, match="1 missing: neck"):
        TorchvisionFasterRCNN.from_state_dict({k: v for k, v in state.items() if k != "neck.fpn_convs.3.conv.bias"})
    with pytest.raises(ConfigError, match="style must be one of"):
        TorchvisionFasterRCNN.from_state_dict(state, style="waymo")


def test_anchors_by_hand():
    anchors = anchor_grid((1, 2), 4, 8, (0.25, 1.0))
    assert anchors.tolist() == [[-32, -8, 32, 8], [-16, -16, 16, 16], [-28, -8, 36, 8], [-12, -16, 20, 16]]


def test_residuals_by_hand():
    boxes = decode_boxes(torch.tensor([[10.0, 10, 30, 20]]), torch.tensor([[0.5, -1.0, float(np.log(2)), 0.0]]))
    torch.testing.assert_close(boxes, torch.tensor([[10.0, 0, 50, 10]]))


def test_regions_are_pooled_from_the_map_of_their_size():
    maps = [torch.full((1, 1, 64 // 2**i, 64 // 2**i), float(i)) for i in range(4)]
    regions = torch.tensor([[0.0, 0, 50, 50], [0, 0, 120, 120], [0, 0, 256, 250]])
    assert roi_features(maps, regions, (4, 8, 16, 32)).mean(dim=(1, 2, 3)).tolist() == [0, 1, 2]


def test_hard_and_soft_selection():
    boxes = np.array([[0.0, 0, 10, 10], [0, 0, 10, 9], [50, 50, 60, 60]])[:, None]
    scores = np.array([[0.9], [0.8], [0.04]])
    kept, values, labels = select_detections(boxes, scores, 0.05, 0.5, soft=False)
    assert kept.tolist() == [[0, 0, 10, 10]]
    assert labels.tolist() == [0]
    _, values, _ = select_detections(boxes, scores, 0.05, 0.5, soft=True)
    np.testing.assert_allclose(values, [0.9, 0.8 * (1 - 0.9)])
    none = select_detections(boxes, scores, 0.95, 0.5, soft=True)
    assert none[0].shape == (0, 4)


def test_the_cost_of_a_network(monkeypatch):
    from lcf3d.detectors.camera.torchvision_benchmarking import benchmark_camera

    monkeypatch.setitem(STYLES, "nuscenes", replace(STYLES["nuscenes"], image_size=(128, 128)))
    (cost,) = benchmark_camera(["fasterrcnn-r50-nuscenes"], np.zeros((9, 16, 3), np.uint8), repeats=1)
    assert cost.parameters == pytest.approx(41.4, abs=0.1)
    assert cost.milliseconds > 0
    with pytest.raises(ConfigError, match="unknown camera network 'yolo'"):
        benchmark_camera(["yolo"])


def saved(path, style, masks=False, **beside):
    torch.manual_seed(1)
    torch.save({**beside, "state_dict": FasterRCNNNetwork(50, style, masks).state_dict()}, path)
    return path


def test_a_file_of_nuimages_has_masks(tmp_path):
    """Names and sizes of the mask head as the published files have them; masks come out, in pixels of the image."""
    expected = {f"roi_head.mask_head.convs.{i}.conv.weight": (256, 256, 3, 3) for i in range(4)}
    expected["roi_head.mask_head.upsample.weight"] = (256, 256, 2, 2)
    expected["roi_head.mask_head.conv_logits.weight"] = (10, 256, 1, 1)
    path = saved(tmp_path / "mask.pth", STYLES["nuscenes"], masks=True)
    state = torch.load(path, weights_only=True)["state_dict"]
    found = {k: tuple(v.shape) for k, v in state.items() if "mask_head" in k and k.endswith("weight")}
    assert found == expected
    detector = TorchvisionFasterRCNN(path, score_threshold=0.0)
    detector.style = replace(detector.style, image_size=(320, 320))
    detections = detector([np.zeros((90, 160, 3), np.uint8)])[0]
    assert len(detections) == len(detections.masks) > 0
    for mask in detections.masks:
        assert mask.x + mask.bitmap.shape[1] <= 160
        assert mask.y + mask.bitmap.shape[0] <= 90


def test_masks_are_interpolated_as_by_torch():
    rng = np.random.default_rng(0)
    cells = rng.random((3, 28, 28))
    boxes = np.array([[3.2, 4.7, 40.1, 30.0], [-5.0, -3.0, 20.0, 9.5], [50.0, 20.0, 63.9, 47.9]])
    masks = instance_masks(cells, boxes, 48, 64)
    for values, (x1, y1, x2, y2), mask in zip(cells, boxes, masks, strict=True):
        x = torch.from_numpy((np.arange(64) + 0.5 - x1) / (x2 - x1) * 2 - 1)
        y = torch.from_numpy((np.arange(48) + 0.5 - y1) / (y2 - y1) * 2 - 1)
        grid = torch.stack([x[None].expand(48, 64), y[:, None].expand(48, 64)], dim=-1)[None]
        image = torch.nn.functional.grid_sample(torch.from_numpy(values)[None, None], grid, align_corners=False)
        whole = np.zeros((48, 64), bool)
        height, width = mask.bitmap.shape
        whole[mask.y : mask.y + height, mask.x : mask.x + width] = mask.bitmap
        assert np.array_equal(whole, image[0, 0].numpy() >= 0.5)
        assert 0 < whole.sum() < whole.size


def test_80_classes_are_coco(tmp_path):
    detector = TorchvisionFasterRCNN(saved(tmp_path / "coco.pth", STYLES["coco"]))
    assert detector.class_names == COCO_CLASSES
    assert not detector.style.bgr
    assert detector.style.image_size == (1333, 800)


PYTORCH = "model = dict(backbone=dict(depth=50, style='pytorch'))\nimg_norm = dict(std=[58.395], to_rgb=True)"
CAFFE = PYTORCH.replace("pytorch", "caffe").replace("58.395", "1.0").replace("True", "False")


@pytest.mark.parametrize(
    ("config", "kind"),
    [
        (PYTORCH, "pytorch"),
        (CAFFE, "caffe"),
        ("data_preprocessor=dict(bgr_to_rgb=True)", "pytorch"),
        ("data_preprocessor=dict(bgr_to_rgb=False)", "caffe"),
        ("", None),
    ],
)
def test_the_file_tells_the_normalization(config, kind):
    assert normalization_of(config) == kind


@pytest.mark.parametrize("key", ["cfg", "config"])
def test_normalization_and_classes_come_from_the_file_or_an_option(tmp_path, key):
    names = tuple("abcdefghij")
    path = saved(tmp_path / "x.pth", STYLES["nuscenes"], meta={key: PYTORCH, "dataset_meta": {"classes": names}})
    told = TorchvisionFasterRCNN(path)
    assert told.class_names == names
    # by hand: (255 - 123.675) / 58.395 for red, which stays first; the stride is in the second convolution
    white = told.normalize(torch.full((1, 3, 32, 32), 255.0))[0, :, 0, 0]
    torch.testing.assert_close(white, torch.tensor([2.2489083, 2.4285715, 2.64]), rtol=1e-5, atol=1e-5)
    assert told.network.backbone.layer2[0].conv1.stride == (1, 1)
    asked = TorchvisionFasterRCNN(path, normalization="caffe")
    white = asked.normalize(torch.full((1, 3, 32, 32), 255.0))[0, :, 0, 0]
    torch.testing.assert_close(white, torch.tensor([255 - 103.53, 255 - 116.28, 255 - 123.675]))
    assert asked.network.backbone.layer2[0].conv1.stride == (2, 2)
    with pytest.raises(ConfigError, match="normalization must be pytorch or caffe, got 'imagenet'"):
        TorchvisionFasterRCNN(path, normalization="imagenet")


def test_classes_of_ones_own_are_told_by_the_file(tmp_path):
    style = replace(STYLES["coco"], classes=("forklift", "person"))
    path = saved(tmp_path / "own.pth", style, meta={"CLASSES": ("forklift", "person")})
    assert TorchvisionFasterRCNN(path).class_names == ("forklift", "person")

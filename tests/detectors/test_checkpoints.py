"""Reading checkpoints: no code runs, the network is found from the parameters, and bad files are told in a sentence."""

from __future__ import annotations

import importlib
import os
import pickle
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.checkpoints import (  # noqa: E402
    detector_class,
    find_config,
    load_parameters,
    read_state_dict,
)
from lcf3d.detectors.lidar import PointPillars, load  # noqa: E402
from lcf3d.detectors.lidar.presets import PRESETS  # noqa: E402
from lcf3d.detectors.openpcdet import translate  # noqa: E402
from lcf3d.errors import DetectorError  # noqa: E402


def meta_state(preset):
    with torch.device("meta"):
        return detector_class(PRESETS[preset].architecture).build(PRESETS[preset]).state_dict()


@pytest.fixture(scope="module")
def pointpillars_file(tmp_path_factory):
    torch.manual_seed(0)
    network = PointPillars.build(PRESETS["pointpillars-kitti"])
    path = tmp_path_factory.mktemp("weights") / "pointpillars.pth"
    torch.save({"meta": {"epoch": 80}, "state_dict": network.state_dict()}, path)
    return path


@pytest.mark.parametrize("preset", [name for name in PRESETS if not name.endswith("openpcdet")])
def test_every_configuration_is_found_from_its_parameters(preset):
    found = find_config(meta_state(preset))
    # PV-RCNN apart, names say what a checkpoint is; all presets differ in some name or shape
    assert found.name == preset


def test_weights_in_the_layout_of_spconv_2_are_turned():
    torch.manual_seed(1)
    config = PRESETS["second-kitti"]
    state = detector_class("second").build(config).state_dict()
    turned = {name: v.permute(4, 0, 1, 2, 3).contiguous() if v.ndim == 5 else v for name, v in state.items()}
    assert find_config(turned).name == "second-kitti"
    network = detector_class("second").build(config)
    load_parameters(network, turned, "second")
    assert all(torch.equal(a, b) for a, b in zip(network.state_dict().values(), state.values(), strict=True))


@pytest.mark.parametrize("function", [os.mkdir, importlib.import_module])
def test_no_code_in_the_file_is_executed(tmp_path, monkeypatch, function):
    (tmp_path / "surprise.py").write_text("raise SystemExit")
    monkeypatch.syspath_prepend(tmp_path)

    class Payload:
        def __reduce__(self):
            return function, ("surprise" if function is importlib.import_module else str(tmp_path / "made"),)

    path = tmp_path / "evil.pth"
    torch.save({"state_dict": {"weight": torch.ones(2)}, "log": Payload()}, path)
    if function is os.mkdir:  # torch refuses modules of the operating system outright
        with pytest.raises(DetectorError, match="cannot be read"):
            read_state_dict(path)
    else:
        assert list(read_state_dict(path)) == ["weight"]
    assert not (tmp_path / "made").exists()


class History:
    """What training frameworks leave in a checkpoint: an object with a state."""

    def __init__(self):
        self.values = np.arange(3)


def test_training_logs_in_the_file_are_skipped(tmp_path):
    path = tmp_path / "epoch_80.pth"
    torch.save({"message_hub": {"loss": History()}, "state_dict": {"module.weight": torch.ones(2)}}, path)
    assert torch.equal(read_state_dict(path)["weight"], torch.ones(2))


def test_a_half_downloaded_file(pointpillars_file, tmp_path):
    path = tmp_path / "half.pth"
    path.write_bytes(pointpillars_file.read_bytes()[:100_000])
    with pytest.raises(DetectorError, match="half downloaded"):
        read_state_dict(path)
    path.write_bytes(b"")
    with pytest.raises(DetectorError, match="half downloaded"):
        read_state_dict(path)


def test_files_that_are_no_checkpoint(tmp_path):
    with pytest.raises(DetectorError, match="does not exist"):
        read_state_dict(tmp_path / "nothing.pth")
    torch.save([torch.ones(1)], tmp_path / "list.pth")
    with pytest.raises(DetectorError, match="holds no parameters"):
        read_state_dict(tmp_path / "list.pth")
    (tmp_path / "numbers.pth").write_bytes(pickle.dumps({"state_dict": {}}))
    with pytest.raises(DetectorError, match=r"holds no parameters|cannot be read"):
        read_state_dict(tmp_path / "numbers.pth")


def test_a_checkpoint_of_another_class_count(tmp_path):
    config = PRESETS["pointpillars-kitti"]
    two = replace(config, class_names=("Car", "Van"))
    torch.save(PointPillars.build(two).state_dict(), tmp_path / "two.pth")
    with pytest.raises(DetectorError, match=r"bbox_head.conv_cls.weight \(expected \(18, 384, 1, 1\), got \(12,"):
        load(str(tmp_path / "two.pth"))


def test_a_checkpoint_of_another_network(pointpillars_file, tmp_path):
    with pytest.raises(DetectorError, match=r"nearest is second-kitti"):
        load(str(pointpillars_file), architecture="second")
    torch.save({"layer.weight": torch.ones(3)}, tmp_path / "other.pth")
    with pytest.raises(DetectorError, match=r"1 unexpected: layer\.weight"):
        load(str(tmp_path / "other.pth"))


def test_a_loaded_detector_runs_in_the_wanted_classes(pointpillars_file):
    detector = load(str(pointpillars_file), ("car", "person", "bicycle"), nms="off", score_threshold=0.0)
    points = np.random.default_rng(0).uniform((1, -20, -2, 0), (40, 20, 0, 1), (500, 4)).astype(np.float32)
    found = detector(points)
    assert found.class_names == ("car", "person", "bicycle")
    assert len(found) > 0


def openpcdet_names(state):
    """The names OpenPCDet gives the layers of PointPillars and SECOND, spelt out independently of the translation."""
    renamed = {}
    for name, value in state.items():
        parts = name.split(".")
        if parts[0] == "voxel_encoder":
            parts[0] = "vfe"
        elif parts[0] == "backbone":
            parts[0], parts[3] = "backbone_2d", str(int(parts[3]) + 1)
        elif parts[0] == "neck":
            parts[0] = "backbone_2d"
        elif parts[0] == "bbox_head":
            parts[0] = "dense_head"
            parts[1] = parts[1].replace("conv_reg", "conv_box")
        elif parts[:2] == ["middle_encoder", "encoder_layers"]:
            parts[:3] = ["backbone_3d", parts[2].replace("encoder_layer", "conv")]
        elif parts[0] == "middle_encoder":
            parts[0] = "backbone_3d"
        renamed[".".join(parts)] = value
    return {**renamed, "global_step": torch.zeros(1)}


@pytest.mark.parametrize("preset", ["pointpillars-kitti-openpcdet", "second-kitti-openpcdet"])
def test_checkpoints_of_openpcdet(preset):
    state = meta_state(preset)
    foreign = openpcdet_names(state)
    assert set(translate(foreign)) == set(state)
    assert find_config(foreign).name == preset
    assert PRESETS[preset].class_names == ("Car", "Pedestrian", "Cyclist")


def test_second_stage_names_of_openpcdet():
    shapes = {
        "pfe.SA_layers.1.mlps.0.3.weight": (32, 32, 1, 1),
        "pfe.vsa_point_feature_fusion.0.weight": (128, 640),
        "point_head.cls_layers.4.running_mean": (256,),
        "roi_head.roi_grid_pool_layer.mlps.1.1.bias": (64,),
        "roi_head.shared_fc_layer.4.weight": (256, 256, 1),
        "roi_head.cls_layers.7.bias": (1,),
        "roi_head.reg_layers.0.weight": (256, 256, 1),
        "dense_head.conv_box.bias": (42,),
    }
    expected = {
        "points_encoder.voxel_sa_layers.1.mlps.0.layer1.conv.weight": (32, 32, 1, 1),
        "points_encoder.point_feature_fusion_layer.0.conv.weight": (128, 640, 1, 1),
        "roi_head.semantic_head.seg_cls_layer.4.running_mean": (256,),
        "roi_head.bbox_roi_extractor.roi_grid_pool_layer.mlps.1.layer0.bn.bias": (64,),
        "roi_head.bbox_head.shared_fc_layer.2.conv.weight": (256, 256, 1, 1),
        "roi_head.bbox_head.cls_layer.3.bias": (1,),
        "roi_head.bbox_head.reg_layer.0.conv.weight": (256, 256, 1, 1),
        "rpn_head.conv_reg.bias": (42,),
    }
    translated = translate({name: torch.empty(shape) for name, shape in shapes.items()})
    assert {name: tuple(value.shape) for name, value in translated.items()} == expected
    assert set(expected) <= set(meta_state("pv-rcnn-kitti"))

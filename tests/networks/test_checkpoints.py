"""Reading checkpoints: no code runs, the network is found from the parameters, and bad files are told in a sentence."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.lidar import PointPillars, load  # noqa: E402
from lcf3d.detectors.lidar.loading import detector_class, find_config, load_published  # noqa: E402
from lcf3d.detectors.lidar.presets import PRESETS  # noqa: E402
from lcf3d.detectors.openpcdet import translate  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError  # noqa: E402
from lcf3d.networks.checkpoints import read_state_dict  # noqa: E402


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
    load_published(network, turned, "second")
    assert all(torch.equal(a, b) for a, b in zip(network.state_dict().values(), state.values(), strict=True))


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


def test_half_precision_is_for_storage(pointpillars_file, tmp_path):
    state = torch.load(pointpillars_file, weights_only=True)["state_dict"]
    half = {name: value.half() if value.is_floating_point() else value for name, value in state.items()}
    torch.save(half, tmp_path / "half.pth")
    detector = PointPillars.from_checkpoint(tmp_path / "half.pth")
    assert all(p.dtype == torch.float32 for p in detector.network.parameters())


def test_parameters_of_a_failed_training(pointpillars_file, tmp_path):
    state = torch.load(pointpillars_file, weights_only=True)["state_dict"]
    state["backbone.blocks.0.0.weight"][0, 0, 0, 0] = float("nan")
    torch.save(state, tmp_path / "nan.pth")
    with pytest.raises(DetectorError, match=r"parameter backbone\.blocks\.0\.0\.weight is NaN"):
        load(str(tmp_path / "nan.pth"))


def test_devices_that_are_not_there(pointpillars_file):
    with pytest.raises(ConfigError, match=r"torch cannot use device 'gpu' here .*; use device=cpu"):
        load(str(pointpillars_file), device="gpu")
    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="torch cannot use device 'cuda' here"):
            load(str(pointpillars_file), device="cuda")


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


# the layers of OpenPCDet's pv_rcnn.yaml beside the sparse backbone and the first stage, and the shapes of their weights
OPENPCDET_SECOND_STAGE = {
    **{
        f"pfe.SA_{where}.mlps.{scale}.{layer}": shape
        for where, before, after in (
            ("rawpoints", 4, 16),
            ("layers.0", 19, 16),
            ("layers.1", 35, 32),
            ("layers.2", 67, 64),
            ("layers.3", 67, 64),
        )
        for scale in (0, 1)
        for layer, shape in ((0, (after, before, 1, 1)), (3, (after, after, 1, 1)))
    },
    "pfe.vsa_point_feature_fusion.0": (128, 640),
    "point_head.cls_layers.0": (256, 640),
    "point_head.cls_layers.3": (256, 256),
    "point_head.cls_layers.6": (1, 256),
    **{
        f"roi_head.roi_grid_pool_layer.mlps.{scale}.{layer}": (64, before, 1, 1)
        for scale in (0, 1)
        for layer, before in ((0, 131), (3, 64))
    },
    "roi_head.shared_fc_layer.0": (256, 27648, 1),
    "roi_head.shared_fc_layer.4": (256, 256, 1),
    "roi_head.cls_layers.0": (256, 256, 1),
    "roi_head.cls_layers.4": (256, 256, 1),
    "roi_head.cls_layers.7": (1, 256, 1),
    "roi_head.reg_layers.0": (256, 256, 1),
    "roi_head.reg_layers.4": (256, 256, 1),
    "roi_head.reg_layers.7": (7, 256, 1),
}


def test_a_whole_pv_rcnn_of_openpcdet():
    foreign = openpcdet_names(meta_state("second-kitti-openpcdet"))
    for layer, shape in OPENPCDET_SECOND_STAGE.items():
        head, _, number = layer.rpartition(".")
        foreign[f"{layer}.weight"] = torch.empty(shape, device="meta")
        if shape[0] in (1, 7):
            foreign[f"{layer}.bias"] = torch.empty(shape[:1], device="meta")
            continue
        for part in ("weight", "bias", "running_mean", "running_var"):
            foreign[f"{head}.{int(number) + 1}.{part}"] = torch.empty(shape[:1], device="meta")
    assert find_config(foreign).name == "pv-rcnn-kitti-openpcdet"

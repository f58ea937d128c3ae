import importlib.util
from pathlib import Path

import numpy as np
import pytest
import yaml

from lcf3d import FusionConfig, Lcf3dError
from lcf3d.fusion.config import PRESETS, STAGES
from lcf3d.fusion.evidence import ROLE_EVIDENCE, Evidence
from lcf3d.fusion.stereo import StereoConfig
from lcf3d.run.settings import build_config

spec = importlib.util.spec_from_file_location(
    "settings_table", Path(__file__).parents[2] / "benchmarks" / "figures" / "settings_table.py"
)
settings_table = importlib.util.module_from_spec(spec)
spec.loader.exec_module(settings_table)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_a_file(name, tmp_path):
    config = FusionConfig.preset(name)
    config.dump(tmp_path / "c.yaml")
    assert FusionConfig.load(str(tmp_path / "c.yaml")) == config
    assert FusionConfig.load(name) == config


def test_paper_preset_is_the_paper():
    paper = FusionConfig.preset("paper")
    assert (paper.cluster_iou, paper.match_iou, paper.confirm_iou) == (0.3, 0.4, 0.3)
    assert (paper.assignment, paper.unmatched, paper.ensemble) == ("paper", "drop", "product")
    assert (paper.enlargement, paper.min_points) == (0.05, 10)


def test_presets_take_other_classes():
    config = FusionConfig.preset("kitti", class_names=("car", "person"))
    assert config.class_names == ("car", "person")
    assert config.evidence_of("person") == ROLE_EVIDENCE["pedestrian"]
    assert build_config("kitti", ["class_names=[Car]"]).class_names == ("Car",)


def test_evidence_falls_back_to_the_role_of_a_class():
    mine = Evidence(base=-3.0)
    config = FusionConfig(class_names=("taxi", "Pedestrian", "bus"), evidence={"bus": mine})
    assert config.evidence_of("bus") == mine
    assert config.evidence_of("Pedestrian") == ROLE_EVIDENCE["pedestrian"]
    assert config.evidence_of("taxi") == ROLE_EVIDENCE["other"]
    by_role = FusionConfig(class_names=("car", "bus"), evidence={"vehicle": mine})
    assert by_role.evidence_of("car") == by_role.evidence_of("bus") == mine


def test_file_is_flat_and_says_what_each_setting_is():
    lines = FusionConfig().to_yaml().splitlines()
    assert [line for line in lines if line.startswith("# ")] == [f"# {STAGES[n]}" for n in STAGES if n != "pairs"]
    settings = [line for line in lines if line and not line.startswith("# ")]
    assert len(settings) == len(FusionConfig.model_fields)
    assert all("  # " in line for line in settings)
    assert set(yaml.safe_load("\n".join(lines))) == set(FusionConfig.model_fields)
    assert "# stereo pairs (section 4.2)" in StereoConfig().to_yaml()


@pytest.mark.parametrize(
    ("preset", "change", "condition"),
    [
        ("kitti", {"miss_likelihood": 0.3}, "an ensemble other than evidence"),
        ("kitti", {"priors": {"Car": 0.2}}, "ensemble: probabilistic or product"),
        ("kitti", {"representative": "camera_class"}, "class_aware: false"),
        ("paper", {"evidence": {"Car": Evidence(base=1.0)}}, "ensemble: evidence"),
        ("kitti", {"recovery": False, "min_points": 5}, "recovery: true"),
        ("kitti", {"ensemble": "none", "relabel_score": 0.5}, "an ensemble other than none"),
    ],
)
def test_settings_without_effect_are_refused(preset, change, condition):
    name = list(change)[-1]
    with pytest.raises(Lcf3dError, match=f"{name} has no effect here, it is used with .*{condition}"):
        FusionConfig.preset(preset).updated(**change)
    with pytest.raises(Lcf3dError, match="has no effect here"):
        FusionConfig.preset(preset, **change)


def test_settings_that_lose_their_effect_go_back_to_their_default():
    off = FusionConfig.preset("nuscenes").updated(recovery=False)
    assert (off.recovery, off.enlargement) == (False, 0.05)
    assert FusionConfig.load("kitti").updated(ensemble="none").evidence == dict(ROLE_EVIDENCE)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"match_iou": 1.5}, "match_iou: "),
        ({"match_iuo": 0.5}, "match_iuo: Extra inputs are not permitted"),
        ({"clustering": "kmeans"}, "clustering: "),
        ({"class_names": ["Car", "Car"]}, "must differ"),
        ({"priors": {"Tram": 0.1}}, "Tram"),
        ({"priors": {"Car": 0}}, "priors.Car"),
    ],
)
def test_senseless_values_are_named(values, message):
    with pytest.raises(Lcf3dError, match=message):
        FusionConfig.of(values)


@pytest.mark.parametrize(("text", "message"), [("a: [", "not valid YAML"), ("- 1", "name: value"), (None, "neither")])
def test_bad_files(tmp_path, text, message):
    path = tmp_path / "c.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(Lcf3dError, match=message):
        FusionConfig.load(str(path))


def test_priors():
    assert FusionConfig(ensemble="probabilistic").prior_array().tolist() == [0.5] * 3
    np.testing.assert_allclose(FusionConfig(ensemble="product").prior_array(), [1 / 3] * 3)
    some = FusionConfig(ensemble="probabilistic", priors={"Cyclist": 0.1})
    assert some.prior_array().tolist() == [0.5, 0.5, 0.1]


def test_the_page_of_settings_is_the_one_that_its_script_writes():
    page = settings_table.PAGE.read_text(encoding="utf-8")
    assert settings_table.updated(page) == page
    assert all(f"| `{name}` |" in page for name in {**FusionConfig.model_fields, **StereoConfig.model_fields})

from pathlib import Path

import numpy as np
import pytest
import yaml

from lcf3d import FusionConfig, Lcf3dError
from lcf3d.fusion.config import PRESETS
from lcf3d.fusion.stereo import StereoConfig


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


def test_file_is_flat_and_says_what_each_setting_is():
    text = FusionConfig().to_yaml()
    assert len(text.splitlines()) == len(FusionConfig.model_fields)
    assert all("  # " in line for line in text.splitlines())
    assert set(yaml.safe_load(text)) == set(FusionConfig.model_fields)


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
    assert FusionConfig().prior_array().tolist() == [0.5] * 3
    np.testing.assert_allclose(FusionConfig(ensemble="product").prior_array(), [1 / 3] * 3)
    assert FusionConfig(priors={"Cyclist": 0.1}).prior_array().tolist() == [0.5, 0.5, 0.1]


def test_every_setting_has_its_line_in_the_docs():
    page = (Path(__file__).parents[2] / "docs" / "configuration.md").read_text()
    settings = {**FusionConfig.model_fields, **StereoConfig.model_fields}
    assert [name for name, field in settings.items() if f"| `{name}` | {field.description} |" not in page] == []

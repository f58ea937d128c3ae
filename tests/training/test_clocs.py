from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.evaluation.calibration_study import open_study
from lcf3d.fusion.clocs import ClocsFusion
from lcf3d.run.setup import RunRequest
from lcf3d.training.clocs import SETTINGS, collect, cross_validate, train_class, train_clocs
from tests.evaluation.drive import write_drive

QUICK = replace(SETTINGS, steps=120, checkpoint_every=120)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    return root, *write_drive(root, 60)


@pytest.fixture(scope="module")
def study(drive):
    root, lidar, camera = drive
    return open_study(RunRequest(f"kitti:{root}", f"results:{lidar}", {"*": f"results:{camera}"}, "val"), folds=2)


def test_training_learns_to_tell_ghosts_from_cars(study):
    sample, scale = collect(study, "Car")
    # three cars and two ghosts in each of sixty frames, no two of which share a pair
    assert len(sample.frames) == 5 * 60
    assert sample.right.sum() == 3 * 60
    network = train_class(sample, scale, np.arange(40), QUICK)
    scores = network.scores(sample.pairs, len(sample.frames))
    held_out = sample.frames >= 40
    assert scores[held_out & (sample.right > 0)].min() > scores[held_out & (sample.right == 0)].max()
    # calibrated: what is right gets a probability near 1
    assert scores[held_out & (sample.right > 0)].mean() > 0.9


def test_torch_and_numpy_give_the_same(study):
    from lcf3d.networks.torch import torch
    from lcf3d.training.clocs import ClocsTask

    sample, scale = collect(study, "Car")
    task = ClocsTask(sample, np.arange(60))
    torch.manual_seed(0)
    module = task.network()
    layers = [layer for layer in module if hasattr(layer, "weight")]
    from lcf3d.fusion.clocs import ClocsNetwork

    ours = ClocsNetwork(
        tuple(layer.weight.detach().double().numpy().T for layer in layers),
        tuple(layer.bias.detach().double().numpy() for layer in layers),
        scale,
    )
    features, candidate, right = task.batch(0, np.random.default_rng(0))
    out = module(features)[:, 0].detach().numpy()
    best = [out[candidate.numpy() == i].max() for i in range(len(right))]
    from lcf3d.fusion.clocs import Pairs

    pairs = Pairs(features.double().numpy(), candidate.numpy())
    np.testing.assert_allclose(ours.outputs(pairs, len(right)), best, atol=1e-5)


def test_cross_validation_beats_the_lidar_branch_alone(study):
    found = cross_validate(study, ("Car",), QUICK)["Car"]
    alone = study.evaluation.figures(study.lidar_inputs)["Car"]
    assert found[1] > alone[1] + 5


def test_classes_that_cannot_be_trained_say_why(study):
    fusion, absent = train_clocs(study, replace(QUICK, steps=5))
    assert set(fusion.networks) == {"Car"}
    assert absent["Cyclist"] == "the camera branch detects none"
    sample, scale = collect(study, "Car")
    with pytest.raises(DatasetError, match="needs 20 right and 20 wrong candidates"):
        train_class(sample, scale, np.arange(3), QUICK)
    with pytest.raises(DatasetError, match="hold no Pedestrian"):
        collect(study, "Pedestrian")


def test_the_command_writes_networks_and_prints_the_comparison(tmp_path, drive):
    root, lidar, camera = drive
    out = tmp_path / "clocs.json"
    options = ["--split", "val", "--lidar", f"results:{lidar}", "--camera", f"results:{camera}", "--out", str(out)]
    result = CliRunner().invoke(app, ["train", "clocs", f"kitti:{root}", *options, "--folds", "2", "--steps", "40"])
    assert result.exit_code == 0, result.output
    assert "LiDAR alone" in result.output
    assert "CLOCs" in result.output
    assert set(ClocsFusion.load(out).networks) == {"Car"}
    refused = CliRunner().invoke(app, ["train", "clocs", f"kitti:{root}", *options, "--folds", "1"])
    assert isinstance(refused.exception, ConfigError)

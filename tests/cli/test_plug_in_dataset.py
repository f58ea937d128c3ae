"""A dataset that lcf3d has never heard of, installed as an entry point, goes through every verb."""

import json
from importlib.metadata import EntryPoint

import pytest
from typer.testing import CliRunner

from lcf3d import plugins
from lcf3d.cli.app import app
from lcf3d.errors import Lcf3dError
from tests.datasets.toy import write_toy


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("toy")
    write_toy(root, 30)
    return root


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    known = plugins._points
    toy = EntryPoint("toy", "tests.datasets.toy:ToyDataset", "lcf3d.datasets")
    monkeypatch.setattr(plugins, "_points", lambda g: {**known(g), **({"toy": toy} if g == toy.group else {})})


def lcf3d(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.stdout


def branches(root):
    return (f"toy:{root / 'data'}", "--lidar", f"results:{root / 'lidar'}", "--camera", f"results:{root / 'camera'}")


def test_check_run_view_and_eval(root, tmp_path):
    assert "all rules hold" in lcf3d("check", f"toy:{root / 'data'}")
    out = tmp_path / "fused"
    counts = json.loads(lcf3d("run", *branches(root), "--out", out, "--json"))
    assert counts["frames"] == 30
    assert counts["outputs"]["matched"] == {"car": 90, "person": 30}
    assert lcf3d("view", out, "--limit", 1).strip().endswith("f00.png")
    scores = {}
    for results in (root / "lidar", out):
        content = json.loads(lcf3d("eval", f"toy:{root / 'data'}", results, "--json"))["results"][0]
        scores[results.name] = content["metrics"]["mean_dist_aps"]["car"]
    assert scores["fused"] > scores["lidar"] + 0.02
    told = json.loads(lcf3d("eval", f"toy:{root / 'data'}", out, "--json"))["results"][0]["closer_look"]["car"]
    assert told["fusion"]["true_positives"] == {"matched": 90}
    table = lcf3d("eval", f"toy:{root / 'data'}", "--compare", root / "lidar", out, "--out", tmp_path / "report")
    assert "difference" in table
    assert "What the fusion did" in (tmp_path / "report" / "report.html").read_text()


def test_ablate_and_calibrate(root, tmp_path):
    rows = json.loads(lcf3d("ablate", *branches(root), "--json"))["rows"]
    ap = {row["name"]: row["ap"]["car"][0] for row in rows}
    assert ap["matching"] > ap["none: LiDAR alone"]
    text = lcf3d("calibrate", *branches(root), "--out", tmp_path / "c.json", "--folds", 3)
    assert "cross-validated, 3 folds" in text
    calibration = json.loads((tmp_path / "c.json").read_text())
    assert calibration["evidence"]["car"]["support"][-1] > 1
    lcf3d("run", *branches(root), "--out", tmp_path / "with", "--calibration", tmp_path / "c.json")


def test_a_split_and_frames_that_are_not_there(root, tmp_path):
    counts = json.loads(lcf3d("run", *branches(root), "--split", "half", "--out", tmp_path / "a", "--json"))
    assert counts["frames"] == 15
    with pytest.raises(Lcf3dError, match=r"has no frame 'f99' among its 30 frames; its first is 'f00'"):
        lcf3d("run", *branches(root), "--frame", "f99", "--out", tmp_path / "b")
    with pytest.raises(Lcf3dError, match="dataset kind 'toy' has no setting 'version'; its settings: split"):
        lcf3d("run", *branches(root), "--tables", "x", "--out", tmp_path / "c")
    stereo = ("--camera-left", "results:a", "--camera-right", "results:b")
    with pytest.raises(Lcf3dError, match="stereo pair, which this dataset does not have"):
        lcf3d("run", *branches(root)[:3], *stereo, "--out", tmp_path / "d")

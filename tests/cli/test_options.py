"""Options that no other test names: each shows its effect."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

import lcf3d as package
from lcf3d.cli.app import app
from lcf3d.errors import Lcf3dError
from tests.evaluation.drive import write_drive


def lcf3d(*arguments, **environment):
    result = CliRunner().invoke(app, [str(a) for a in arguments], env=environment)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    lidar, camera = write_drive(root, 12)
    return root, ("--lidar", f"results:{lidar}", "--camera", f"results:{camera}")


def test_version_and_completion():
    assert lcf3d("--version").stdout == f"lcf3d {package.__version__}\n"
    asked = {"_LCF3D_COMPLETE": "complete_bash", "COMP_WORDS": "lcf3d abl", "COMP_CWORD": "1"}
    told = subprocess.run(
        [sys.executable, "-c", "from lcf3d.cli.app import main; main()"],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "--install-completion" in lcf3d("--help", COLUMNS="200").output
    assert "Traceback" not in told.stderr


@pytest.mark.parametrize(("flags", "level"), [((), logging.WARNING), (("--verbose",), logging.INFO)])
def test_verbose_says_more(flags, level):
    lcf3d(*flags, "config")
    assert logging.getLogger().level == level


def test_config_with_the_settings_of_stereo_pairs():
    assert "epipolar_gate_px" not in lcf3d("config").stdout
    assert "epipolar_gate_px: 5.0" in lcf3d("config", "--stereo", "--set", "epipolar_gate_px=5.0").stdout


@pytest.fixture
def recipes(monkeypatch):
    """What ``lcf3d simulate`` asks for, without simulating."""
    from lcf3d.simulation import writer

    asked = []
    monkeypatch.setattr(writer, "write_dataset", lambda *arguments: asked.append(arguments) or ["000000"])
    return asked


def test_simulate_passes_on_what_is_asked(recipes, tmp_path):
    options = ("--seed", 7, "--sequence", "--street", "city", "--density", 2.5, "--jobs", 3, "--resume")
    lcf3d("simulate", tmp_path, "--preset", "kitti64", "--frames", 4, *options)
    ((recipe, out, jobs, resume, _),) = recipes
    assert (recipe.seed, recipe.sequence, recipe.street, recipe.density) == (7, True, "city", 2.5)
    assert (out, jobs, resume) == (tmp_path, 3, True)
    lcf3d("simulate", tmp_path)
    assert (recipes[1][0].seed, recipes[1][0].sequence, recipes[1][2], recipes[1][3]) == (0, False, 1, False)


def test_calibrate_and_ablate_change_settings(drive, tmp_path):
    root, branches = drive
    values = {}
    for iou in ("0.4", "0.999"):
        out = tmp_path / f"{iou}.json"
        command = ("calibrate", root, *branches, "--folds", 0, "--set", f"match_iou={iou}", "--out", out)
        lcf3d(*command)
        values[iou] = json.loads(out.read_text())["evidence"]["Car"]
        rows = json.loads(lcf3d("ablate", root, *branches, "--set", f"match_iou={iou}", "--json").stdout)["rows"]
        values[f"matched {iou}"] = next(r["matched"] for r in rows if r["name"] == "as they are")
    assert values["0.4"] != values["0.999"]
    assert values["matched 0.4"] > values["matched 0.999"]


def test_ablate_takes_localizer_and_tiles(drive, monkeypatch):
    root, branches = drive
    with pytest.raises(Lcf3dError, match="unknown localizer kind 'best'"):
        lcf3d("ablate", root, *branches, "--localizer", "best")
    seen = []
    from lcf3d.run import setup

    monkeypatch.setattr(setup, "open_cameras", lambda *a: seen.append(a[-1]) or {})
    with pytest.raises(Lcf3dError):
        lcf3d("ablate", root, "--lidar", branches[1], "--camera", "onnx:x", "--tiles", 3, "--localizer", "best")
    assert seen == [3]


def test_eval_resamples_by_its_seed(drive):
    root, branches = drive
    lidar = branches[1].removeprefix("results:")

    def intervals(seed):
        out = lcf3d("eval", root, "--compare", lidar, lidar, "--samples", 5, "--seed", seed, "--json").stdout
        return [row["first"] for row in json.loads(out)["comparison"]["rows"]]

    assert intervals(1) == intervals(1)
    assert intervals(1) != intervals(2)


def test_models_as_json_and_into_a_folder(tmp_path, monkeypatch):
    entries = json.loads(lcf3d("models", "--json").stdout)
    assert {"name", "url"} <= set(entries[0])
    from lcf3d.detectors import downloads

    monkeypatch.setattr(downloads, "download", lambda model, to: f"{to}/{model.name}")
    assert lcf3d("models", "get", entries[0]["name"], "--to", tmp_path).stdout.strip().startswith(str(tmp_path))


def test_bench_evaluates_given_results(drive):
    root, branches = drive
    lidar = branches[1].removeprefix("results:")
    out = lcf3d("bench", "eval", "--dataset", root, "--results", lidar, "--seconds", 0.01, "--json").stdout
    assert any("12 frames" in row["stage"] or row["per_second"] > 0 for row in json.loads(out))


def test_view_without_labels(drive, tmp_path):
    from PIL import Image

    root, _ = drive
    shown = {}
    for flag in ("--truth", "--no-truth"):
        lcf3d("view", f"kitti:{root}", "--frame", "000001", flag, "--out", tmp_path / f"{flag}.png")
        shown[flag] = Image.open(tmp_path / f"{flag}.png").tobytes()
    assert shown["--truth"] != shown["--no-truth"]


def test_generalize_changes_settings_and_prints_json(drive, tmp_path, monkeypatch):
    root, branches = drive
    task = f"kitti->kitti kitti:{root} lidar={branches[1]} camera={branches[3]} split=val"
    command = ("generalize", "--task", task, "--out", tmp_path / "out", "--class", "Car", "--json")
    (one,) = json.loads(lcf3d(*command, "--set", "match_iou=0.6").stdout)
    assert set(one["methods"]) == {"LiDAR", "fused"}
    assert "match_iou: 0.6" in (tmp_path / "out" / "config.yaml").read_text()

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lcf3d.cli.eval_nuscenes import eval_nuscenes

from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.errors import ConfigError, FormatError
from lcf3d.formats.nuscenes import write_submission
from tests.datasets.nuscenes_world import write_world


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_world(tmp_path)


@pytest.fixture
def results(root: Path, tmp_path: Path) -> Path:
    truth = NuscenesDataset(root).ground_truth()
    path = tmp_path / "results.json"
    write_submission(path, replace(truth, scores=np.full(len(truth), 0.5)))
    return path


def test_table(root: Path, results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    eval_nuscenes(root, results)
    printed = capsys.readouterr().out
    assert "results.json, mini_val, 3 samples, all around" in printed
    assert "NDS " in printed
    assert "no ground truth" in printed
    (car,) = [line for line in printed.splitlines() if line.startswith("car ")]
    assert car.split() == ["car", *["100.0"] * 5, *["0.000"] * 5]
    assert max(len(line) for line in printed.splitlines()) <= 80


def test_front_view_with_nds_hat(root: Path, results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metrics = eval_nuscenes(root, results, front=True, nds_hat=True)
    printed = capsys.readouterr().out
    assert f"NDS^ {100 * metrics.nds_hat:.2f}" in printed
    assert "front camera's view" in printed
    assert "AVE" not in printed


def test_json_and_files(root: Path, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metrics = eval_nuscenes(root, results, as_json=True, out=tmp_path / "out")
    printed = json.loads(capsys.readouterr().out)
    assert printed["nd_score"] == metrics.nd_score
    assert json.loads((tmp_path / "out/metrics_summary.json").read_text())["mean_ap"] == metrics.mean_ap
    assert len(json.loads((tmp_path / "out/metrics_details.json").read_text())) == 40


def test_bad_input(root: Path, results: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no scene of split 'train'"):
        eval_nuscenes(root, results, split="train")
    with pytest.raises(FormatError, match="does not exist"):
        eval_nuscenes(root, tmp_path / "none.json")

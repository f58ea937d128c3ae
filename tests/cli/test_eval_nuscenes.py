import json
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.evaluation.nuscenes_task import NuscenesEvaluation
from lcf3d.evaluation.protocol import EvaluationOptions
from lcf3d.formats.nuscenes import read_submission, write_submission
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


def lcf3d(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.stdout


def test_table(root: Path, results: Path) -> None:
    printed = lcf3d("eval", f"nuscenes:{root}", results)
    assert "results.json, 3 samples, all around" in printed
    assert "NDS " in printed
    assert "no ground truth" in printed
    (car,) = [line for line in printed.splitlines() if line.startswith("car ")]
    assert car.split() == ["car", *["100.0"] * 5, *["0.000"] * 5]
    table = printed[: printed.index("NDS ")]
    assert max(len(line.rstrip()) for line in table.splitlines()) <= 80


def test_front_view_with_nds_hat(root: Path, results: Path) -> None:
    options = EvaluationOptions(front=True, nds_hat=True)
    metrics = NuscenesEvaluation(NuscenesDataset(root), None, options).read(results, "x").official
    printed = lcf3d("eval", f"nuscenes:{root}", results, "--front", "--nds-hat")
    assert f"NDS^ {100 * metrics.nds_hat:.2f}" in printed
    assert "front camera's view" in printed
    assert "AVE" not in printed


def test_json_and_files(root: Path, results: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    printed = json.loads(lcf3d("eval", f"nuscenes:{root}", results, "--json", "--out", out))["results"][0]
    assert printed["metrics"]["nd_score"] > 0
    assert printed["closer_look"]["car"]["best_f1"]["misses"] == 0
    assert json.loads((out / "metrics_summary.json").read_text())["mean_ap"] == printed["metrics"]["mean_ap"]
    assert len(json.loads((out / "metrics_details.json").read_text())) == 40
    assert '"heading":"nuScenes' in (out / "report.html").read_text()


def test_a_result_compared_with_a_worse_one(root: Path, results: Path, tmp_path: Path) -> None:
    truth = NuscenesDataset(root).ground_truth()
    # objects without points are no labels, so that their boxes would be wrong
    truth = truth[truth.point_counts > 0]
    write_submission(results, replace(truth, scores=np.full(len(truth), 0.5)))
    half = truth[truth.samples > 0]
    write_submission(tmp_path / "half.json", replace(half, scores=np.full(len(half), 0.5)))
    command = ("eval", f"nuscenes:{root}", "--compare", tmp_path / "half.json", results, "--samples", 20)
    rows = json.loads(lcf3d(*command, "--json"))["comparison"]["rows"]
    assert {row["class_name"] for row in rows} >= {"car", "mean"}
    mean = next(row for row in rows if row["class_name"] == "mean")
    assert mean["second"] == {"value": pytest.approx(100), "low": pytest.approx(100), "high": pytest.approx(100)}
    assert mean["first"]["value"] < 100
    assert "half.json" in lcf3d(*command)


def test_bad_input(root: Path, results: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no sample of split 'train'"):
        lcf3d("eval", f"nuscenes:{root}", results, "--split", "train")
    with pytest.raises(FormatError, match="does not exist"):
        lcf3d("eval", f"nuscenes:{root}", tmp_path / "none.json")
    with pytest.raises(ConfigError, match="--iou does not go with"):
        lcf3d("eval", f"nuscenes:{root}", results, "--iou", "car=0.5")


@pytest.mark.parametrize("missing", ["error", "empty"])
def test_boxes_are_measured_as_they_are(
    root: Path, results: Path, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boxes without an attribute get none, whatever is done about samples that the file lacks."""
    content = json.loads(results.read_text())
    for box in chain(*content["results"].values()):
        box["attribute_name"] = ""
    results.write_text(json.dumps(content))
    evaluation = NuscenesEvaluation(NuscenesDataset(root), None, EvaluationOptions())
    measured, official = [], evaluation.official
    monkeypatch.setattr(evaluation, "official", lambda boxes, *meta: measured.append(boxes) or official(boxes, *meta))
    evaluation.read(results, "x", missing)
    written, _ = read_submission(results)
    assert (measured[0].attributes == -1).all()
    np.testing.assert_array_equal(measured[0].rotations, written.rotations)
    np.testing.assert_array_equal(measured[0].velocities, written.velocities)

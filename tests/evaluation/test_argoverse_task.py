import json
from pathlib import Path

import numpy as np
import pytest

from lcf3d.datasets.argoverse2 import Argoverse2Dataset
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.evaluation.argoverse_task import ArgoverseEvaluation
from lcf3d.evaluation.opening import open_evaluation
from lcf3d.evaluation.protocol import EvaluationOptions
from tests.datasets.argoverse_log import LOG, cuboid, sweep_time, write_log, write_submission_rows

pytest.importorskip("pyarrow", reason="needs pyarrow (extra formats)")


@pytest.fixture
def dataset(tmp_path: Path) -> Argoverse2Dataset:
    write_log(tmp_path)
    return Argoverse2Dataset(tmp_path)


def found(path: Path, times: list[int]) -> Path:
    cars = [cuboid(t, "REGULAR_VEHICLE", (21.0 - i, 0.3, 1.5)) for i, t in enumerate(times)]
    write_submission_rows(path, cars, [0.9] * len(cars))
    return path


def test_results_measured(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    evaluation = open_evaluation(dataset)
    assert isinstance(evaluation, ArgoverseEvaluation)
    assert evaluation.frame_ids == dataset.ids
    results = evaluation.read(found(tmp_path / "f.feather", [sweep_time(i) for i in range(3)]), "mine")
    metrics = results.to_json()
    assert metrics["REGULAR_VEHICLE"]["AP"] == 1
    assert metrics["REGULAR_VEHICLE"]["ATE"] == pytest.approx(0.3)
    assert metrics["PEDESTRIAN"]["AP"] == 0
    (table,) = results.tables()
    assert [row[0] if row else None for row in table.rows] == ["PEDESTRIAN", "REGULAR_VEHICLE", None, "mean"]
    assert table.rows[1] is not None
    assert table.rows[1][1:6] == ("100.0",) * 5
    assert "mine, 3 annotated sweeps" in table.title
    study = results.study()
    assert {part.class_name for part in study.classes} == {"REGULAR_VEHICLE", "PEDESTRIAN"}
    assert study.missed.tolist() == [1, 0, 0]
    json.dumps(study.to_json())


def test_figures_of_detections(dataset: Argoverse2Dataset) -> None:
    evaluation = open_evaluation(dataset)
    labels = [frame.labels for frame in dataset]
    figures = evaluation.figures([part for part in labels if part is not None])
    assert figures["REGULAR_VEHICLE"] == (100.0,)
    assert np.isnan(figures["DOG"][0])
    verdict = evaluation.judge_lidar([part for part in labels if part is not None])
    assert verdict.right.tolist() == [1.0] * 4


def test_single_frames(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    evaluation = open_evaluation(dataset, dataset.ids[1:])
    path = found(tmp_path / "f.feather", [sweep_time(i) for i in range(3)])
    results = evaluation.read(path, "mine")
    assert results.tables()[0].notes[-1] == "1 boxes are of sweeps that are not evaluated and were left out"
    assert results.to_json()["REGULAR_VEHICLE"]["ground_truth"] == 2
    comparison = evaluation.compare(results, results, samples=10, seed=0)
    assert {row.class_name for row in comparison} >= {"REGULAR_VEHICLE"}


def test_what_does_not_go(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--front does not go with Argoverse 2"):
        open_evaluation(dataset, options=EvaluationOptions(front=True))
    with pytest.raises(DatasetError, match="none of the 3 frames"):
        open_evaluation(dataset).read(found(tmp_path / "f.feather", [5]), "mine")
    (tmp_path / "val" / LOG / "annotations.feather").unlink()
    with pytest.raises(DatasetError, match="holds no annotations"):
        open_evaluation(Argoverse2Dataset(tmp_path))

import json

import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.errors import Lcf3dError


def bench(*arguments):
    result = CliRunner().invoke(app, ["bench", *arguments], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.stdout


def test_figures_as_json_and_as_a_table():
    rows = json.loads(bench("fusion", "--seconds", "0.01", "--json"))
    assert {"stage", "median_ms", "budget_ms", "reference_ms", "times_faster"} <= set(rows[0])
    assert "semantic fusion" in bench("fusion", "--seconds", "0.01")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["everything"], "bench measures fusion, eval, simulate, detectors"),
        (["eval", "--dataset", "kitti:."], "together"),
        (["detectors", "--name", "resnet"], "unknown detector 'resnet'"),
    ],
)
def test_bad_arguments(arguments, message):
    if arguments[0] == "detectors":
        pytest.importorskip("torch")
    with pytest.raises(Lcf3dError, match=message):
        bench(*arguments)


def test_networks_by_name(monkeypatch):
    pytest.importorskip("torchvision")
    from lcf3d.detectors.camera import torchvision_benchmarking
    from lcf3d.detectors.lidar import benchmarking

    def costs(runtime):
        return lambda names: [benchmarking.Cost(name, runtime, "cpu", None, 1.0, None, 2.0, None) for name in names]

    monkeypatch.setattr(benchmarking, "benchmark", costs("lidar"))
    monkeypatch.setattr(torchvision_benchmarking, "benchmark_camera", costs("camera"))
    rows = json.loads(
        bench("detectors", "--name", "fasterrcnn-r50-nuscenes", "--name", "second-kitti", "--name", "yolo", "--json")
    )
    assert [(row["name"], row["runtime"]) for row in rows] == [
        ("second-kitti", "lidar"),
        ("yolo", "lidar"),
        ("fasterrcnn-r50-nuscenes", "camera"),
    ]

"""Bad input to the rivals and to the paper's tables: one sentence each that says what to do, and nothing is written."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.detectors.lidar.kinds import shipped_path
from lcf3d.errors import Lcf3dError
from tests.evaluation.drive import write_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    return root, *write_drive(root, 4, scans=True)


@pytest.fixture
def files(tmp_path, drive):
    """Names of what is wrong, by what stands for it in the cases."""
    _, lidar, _ = drive
    (tmp_path / "cut.onnx").write_bytes(shipped_path("kitti").read_bytes()[:5000])
    (tmp_path / "cut.pth").write_bytes(b"PK\x03\x04" + bytes(100))
    others = tmp_path / "others"
    shutil.copytree(lidar, others)
    for number, path in enumerate(sorted(others.glob("*.txt"))):
        path.rename(others / f"{900000 + number:06d}.txt")
    return {name: str(tmp_path / name) for name in ("cut.onnx", "cut.pth", "others")}


CASES = {
    "wrong split": ("train clocs kitti:ROOT --split nope --lidar results:LIDAR --camera results:CAMERA", "nope"),
    "result files of other frames": (
        "train clocs kitti:ROOT --split val --lidar results:others --camera results:CAMERA",
        "others",
    ),
    "rows from result files of other frames": (
        "paper table-2 --kitti ROOT --row LoGoNet --results LoGoNet=others --json",
        "others",
    ),
    "half a network that is to paint": (
        "run kitti:ROOT --split val --lidar painted:cut.onnx --camera results:CAMERA",
        "cannot be read as an ONNX file",
    ),
    "half a download": ("run kitti:ROOT --split val --lidar mvxnet:cut.pth --camera results:CAMERA", "cut.pth"),
    "half a network to begin with": ("train lidar kitti:ROOT --split val --init cut.onnx --held-out 1", "cut.onnx"),
    "plain weights to paint with": (
        "run kitti:ROOT --split val --lidar painted:SHIPPED --camera results:CAMERA",
        "takes plain points",
    ),
    "plain weights for frustums": (
        "run kitti:ROOT --split val --lidar frustum-pillars:SHIPPED --camera results:CAMERA",
        "was not trained on frustums",
    ),
    "scans without images to be painted": (
        "train lidar kitti:ROOT --split val --paint masks:shipped:kitti --held-out 1",
        "has no image",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_one_sentence_says_what_is_wrong(name, drive, files, monkeypatch, tmp_path):
    root, lidar, camera = drive
    command, message = CASES[name]
    if "mvxnet" in command or "train" in command:
        pytest.importorskip("torch")
    if "--init" in command:
        pytest.importorskip("onnx")
    _register(monkeypatch)
    places = {"ROOT": root, "LIDAR": lidar, "CAMERA": camera, "SHIPPED": shipped_path("kitti"), **files}
    for word, path in places.items():
        command = command.replace(word, str(path))
    result = CliRunner().invoke(app, [*command.split(), "--out", str(tmp_path / "out")])
    told = str(result.exception) if isinstance(result.exception, Lcf3dError) else result.output
    assert isinstance(result.exception, Lcf3dError) or name.startswith("rows"), result.exception
    assert message in told
    if isinstance(result.exception, Lcf3dError):
        assert "\n" not in told
        assert len(told) < 400


def test_networks_of_something_else_are_no_clocs(tmp_path):
    from lcf3d.fusion.clocs import ClocsFusion

    path = tmp_path / "other.json"
    path.write_text(json.dumps({"format": "something else"}))
    with pytest.raises(Lcf3dError, match="holds no CLOCs networks; expected a file of 'lcf3d train clocs'"):
        ClocsFusion.load(path)
    path.write_text(json.dumps({"format": "lcf3d.clocs/1", "networks": {"Car": {"weights": np.eye(3).tolist()}}}))
    with pytest.raises(Lcf3dError, match="is damaged"):
        ClocsFusion.load(path)


def _register(monkeypatch):
    """The kinds of this source tree, whatever is installed."""
    from importlib.metadata import EntryPoint

    from lcf3d import plugins

    group, here = "lcf3d.lidar_detectors", "lcf3d.detectors.fusion."
    points = dict(plugins._points(group))
    for kind, target in (("painted", "painting:painted"), ("frustum-pillars", "frustum_pillars:frustum_pillars")):
        points.setdefault(kind, EntryPoint(kind, here + target, group))
    original = plugins._points
    monkeypatch.setattr(plugins, "_points", lambda name: points if name == group else original(name))

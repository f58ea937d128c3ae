"""The tutorial docs/my-own-data.md, executed as it stands on a small drive."""

import re
import shlex
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from lcf3d import plugins
from lcf3d.cli.app import app
from lcf3d.datasets.folder import FolderDataset
from tests.datasets.plain_folder import FRONT_FROM_LIDAR, write_plain_folder, write_sensors

PAGE = (Path(__file__).parents[1] / "docs" / "my-own-data.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    known = plugins._points
    folder = EntryPoint("folder", "lcf3d.datasets.folder:FolderDataset", "lcf3d.datasets")
    monkeypatch.setattr(plugins, "_points", lambda g: {**known(g), **({"folder": folder} if g == folder.group else {})})


def test_the_tutorial_runs_as_it_stands(tmp_path, monkeypatch, capsys):
    root = write_plain_folder(tmp_path / "drive", frames=6)
    (root / "sensors.yaml").unlink()
    monkeypatch.chdir(tmp_path)
    outputs = {}
    for number, block in enumerate(blocks("sh")):
        for command in block.strip().splitlines():
            name, *arguments = shlex.split(command)
            assert name == "lcf3d"
            result = CliRunner().invoke(app, arguments)
            assert result.exception is None, f"{command}: {result.exception!r} {result.output}"
            outputs[command] = result.output
        if number == 0:
            # what the reader does by hand
            (described,) = blocks("yaml")
            (root / "sensors.yaml").write_text(described)
    check = outputs["lcf3d check folder:drive --picture check.png"]
    assert "camera left: 640 x 320, pinhole, looks left (+90 degrees)" in check
    assert "labels: JSON of our own: 18 car, 6 person" in check
    assert "all rules hold" in check
    assert (tmp_path / "check.png").stat().st_size > 10_000
    assert "difference" in outputs["lcf3d eval folder:drive --compare drive/lidar_results fused"]
    (code,) = blocks("python")
    exec(code, {})
    assert "['front', 'left']" in capsys.readouterr().out
    assert yaml.safe_load((tmp_path / "copy/sensors.yaml").read_text())["classes"] == ["car", "person"]


def test_the_messages_that_the_page_shows_are_those_of_the_check(tmp_path):
    """Both mistakes of the page, made."""

    root = write_plain_folder(tmp_path / "drive", frames=2)
    inverse = np.linalg.inv(FRONT_FROM_LIDAR).tolist()
    write_sensors(root, lambda values: values["cameras"]["front"].update(camera_from_lidar=inverse))
    shown = [f"{f.id} {f.severity}: {f.message}" for f in FolderDataset(root).check(root / "camera_results")]
    assert next(line for line in shown if line.startswith("FLD02")) in PAGE
    write_sensors(root, lambda values: values["lidars"]["top"].update(axes="right-forward-up"))
    shown = [f"{f.id} {f.severity}: {f.message}" for f in FolderDataset(root).check()]
    assert next(line for line in shown if line.startswith("FLD04")) in PAGE

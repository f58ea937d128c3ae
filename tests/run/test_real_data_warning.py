import logging
from types import SimpleNamespace

import pytest

from lcf3d.run import sources

NAMES = ("Car", "Pedestrian", "Cyclist")


@pytest.fixture
def heard(caplog, monkeypatch):
    monkeypatch.setattr(sources, "load_detector", lambda *_: lambda points: points)
    sources._warn_once.cache_clear()
    caplog.set_level(logging.WARNING, "lcf3d")
    return caplog


def test_a_shipped_network_on_real_data_warns_once_with_the_figures_of_its_card(heard, tmp_path):
    dataset = SimpleNamespace(root=tmp_path)
    for _ in range(2):
        sources.open_lidar("shipped:kitti?threads=1", dataset, NAMES)
    assert len(heard.messages) == 1
    assert heard.messages[0].startswith("the lidar network shipped:kitti has seen simulation only. On real data: ")
    sources.open_cameras({"left": "shipped:kitti", "right": "shipped:kitti"}, dataset, NAMES)
    assert len(heard.messages) == 2
    assert "camera network" in heard.messages[1]


def test_simulated_data_and_other_detectors_are_quiet(heard, tmp_path):
    sources.open_lidar("onnx-lidar:own.onnx", SimpleNamespace(root=tmp_path), NAMES)
    (tmp_path / "simulation.json").write_text("{}")
    sources.open_lidar("shipped:kitti", SimpleNamespace(root=tmp_path), NAMES)
    assert heard.messages == []


def test_the_folder_that_simulate_writes_is_known_by_its_file():
    from lcf3d.simulation.writer import SETTINGS_FILE

    assert sources.SIMULATED == SETTINGS_FILE


def test_note_is_one_line_of_the_card():
    assert sources.real_data_note("# x\n\nOn real data: poor.\nmore") == "On real data: poor."
    assert sources.real_data_note("# x\n") == ""

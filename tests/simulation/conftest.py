"""Simulated frames small enough for tests, made once."""

from dataclasses import replace

import pytest

from lcf3d.simulation import presets as presets_module
from lcf3d.simulation.frames import simulate_drive, simulate_frame
from lcf3d.simulation.presets import get_preset

pytest.importorskip("embreex")


def tiny(name):
    preset = get_preset(name).resized(0.2, 300)
    return replace(preset, lidar=replace(preset.lidar, noise_m=0.0))


@pytest.fixture(scope="session")
def frames():
    """Single frames of every kind of street, without range noise."""
    preset = tiny("kitti64")
    return [simulate_frame(preset, 3, k, street=s) for k, s in enumerate(("residential", "city", "square", "avenue"))]


@pytest.fixture(scope="session")
def drive():
    """Three consecutive frames, 0.1 s apart."""
    return list(simulate_drive(tiny("kitti64"), 5, 3, street="residential"))


@pytest.fixture(scope="session")
def nuscenes_frame():
    return simulate_frame(tiny("nuscenes32"), 2, 0, street="city")


def shrink_presets(patch):
    """Make every named preset tiny, also for the writer and the command line."""
    table = {name: tiny(name) for name in presets_module.all_presets()}
    patch.setattr(presets_module, "all_presets", lambda: table)


@pytest.fixture
def tiny_presets(monkeypatch):
    """All named presets, shrunk."""
    shrink_presets(monkeypatch)

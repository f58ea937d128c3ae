"""Simulated street scenes in KITTI and nuScenes layout: rays into triangle meshes, with exact labels.

``simulate_frame`` and ``simulate_drive`` give frames in memory; ``lcf3d simulate`` writes data sets. Needs the extra
``simulate``.
"""

from lcf3d.simulation.bench import benchmark
from lcf3d.simulation.frames import SimulatedFrame, capture, simulate_drive, simulate_frame
from lcf3d.simulation.presets import Preset, all_presets, get_preset

__all__ = [
    "Preset",
    "SimulatedFrame",
    "all_presets",
    "benchmark",
    "capture",
    "get_preset",
    "simulate_drive",
    "simulate_frame",
]

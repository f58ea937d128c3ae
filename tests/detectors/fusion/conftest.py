"""Frames that the parity data of the fusion networks were made from."""

from __future__ import annotations

from pathlib import Path

import pytest

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.frame import Frame


@pytest.fixture
def kitti_frame(shared: Path) -> Frame:
    return KittiDataset(shared / "data" / "kitti").frame("000008")


@pytest.fixture
def nuscenes_frame(shared: Path) -> Frame:
    return NuscenesDataset(shared / "data" / "nuscenes").frame("ca9a282c9e77460f8360f564131a8af5")

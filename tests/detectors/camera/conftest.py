"""Fixtures of the camera detector tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lcf3d.structures import Detections2D


@pytest.fixture
def black() -> NDArray[np.uint8]:
    """A 128 x 64 image (width x height)."""
    return np.zeros((64, 128, 3), dtype=np.uint8)


@pytest.fixture
def detections_2d() -> Callable[..., Detections2D]:
    """Detections from ``(class name, score, box)`` rows."""

    def build(rows: list[tuple[str, float, list[float]]], class_names: tuple[str, ...]) -> Detections2D:
        boxes = np.array([row[2] for row in rows], dtype=float).reshape(-1, 4)
        labels = [class_names.index(row[0]) for row in rows]
        return Detections2D(boxes, np.array([row[1] for row in rows]), np.array(labels, dtype=int), class_names)

    return build


@pytest.fixture
def weights(shared: Path) -> Path:
    return shared / "weights"

"""Parity data of the networks in ../shared/golden/models (see its README), and what compares with them."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest


@dataclass
class Golden:
    """One model's parity data."""

    folder: Path
    name: str
    fill: ModuleType
    info: dict[str, Any] = field(init=False)
    arrays: dict[str, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        self.info = json.loads((self.folder / f"{self.name}.json").read_text())
        with np.load(self.folder / f"{self.name}.npz") as file:
            self.arrays = dict(file)

    def state(self) -> dict[str, Any]:
        """Every parameter and buffer by its published name."""
        import torch

        shapes = json.loads((self.folder / f"{self.name}.shapes.json").read_text())
        return {name: torch.from_numpy(value) for name, value in self.fill.fill_state_dict(shapes).items()}

    def points(self, columns: tuple[int, ...] = (0, 1, 2, 3)) -> np.ndarray:
        """(N, 5) the scan as a user would give it: ``columns`` says where each column of the input goes."""
        points = np.zeros((len(self.arrays["input"]), 5), np.float32)
        points[:, columns] = self.arrays["input"]
        return points

    def check(self, stage: str, value: Any, tolerance: float) -> None:
        """Compare a whole map (torch, any number of axes) with the sampled values and statistics of ``stage``."""
        expected_shape = self.info["maps"][stage]["shape"]
        assert list(value.shape) == expected_shape, stage
        array = value.detach().cpu().double().numpy().ravel()
        index, expected = self.arrays[f"map.{stage}.index"], self.arrays[f"map.{stage}.value"].astype(np.float64)
        scale = np.maximum(np.abs(expected), self.info["maps"][stage]["std"])
        error = np.abs(array[index] - expected) / scale
        assert error.max() < tolerance, f"{stage}: relative error {error.max():.2e}"
        np.testing.assert_allclose(array.std(), self.info["maps"][stage]["std"], rtol=10 * tolerance, err_msg=stage)
        np.testing.assert_allclose(np.abs(array).max(), self.info["maps"][stage]["absmax"], rtol=10 * tolerance)

    def check_predictions(self, detections: Any, tolerance: float = 1e-3) -> None:
        """Compare final boxes, as sets, with the original's."""
        from lcf3d.geometry.boxes import mmdet3d_from_canonical

        boxes = mmdet3d_from_canonical(detections.boxes)
        expected = self.arrays["prediction.bboxes_3d"].astype(np.float64)
        if expected.shape[1] == 9:
            boxes = np.concatenate([boxes, detections.velocities], axis=1)
        scores, labels = self.arrays["prediction.scores_3d"], self.arrays["prediction.labels_3d"]
        assert len(detections) == len(expected)
        distance = np.abs(boxes[:, None, :3] - expected[None, :, :3]).max(axis=2)
        distance += np.abs(detections.scores[:, None] - scores[None]) + (detections.labels[:, None] != labels[None])
        nearest = distance.argmin(axis=1)
        assert len(set(nearest)) == len(expected)
        difference = np.abs(boxes - expected[nearest])
        difference[:, 6] = np.abs((difference[:, 6] + np.pi) % (2 * np.pi) - np.pi)
        assert (difference <= tolerance * (1 + np.abs(expected[nearest]))).all(), difference.max(axis=0)
        assert np.abs(detections.scores - scores[nearest]).max(initial=0) < tolerance
        assert (detections.labels == labels[nearest]).all()


@pytest.fixture(scope="session")
def golden(shared: Path) -> Callable[[str], Golden]:
    """Parity data by model name."""
    folder = shared / "golden" / "models"
    spec = importlib.util.spec_from_file_location("fill", folder / "fill.py")
    assert spec is not None and spec.loader is not None
    fill = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fill)
    return lambda name: Golden(folder, name, fill)


@pytest.fixture
def capture() -> Callable[[Any, dict[str, Any]], dict[str, Any]]:
    """Record module outputs: ``capture(network, {"stage": module})`` returns a dictionary that fills on a forward."""

    def register(modules: dict[str, Any]) -> dict[str, Any]:
        outputs: dict[str, Any] = {}
        for stage, module in modules.items():
            module.register_forward_hook(lambda _, inputs, output, stage=stage: outputs.__setitem__(stage, output))
            module.register_forward_hook(
                lambda _, inputs, output, stage=stage: outputs.__setitem__(f"{stage}.input", inputs)
            )
        return outputs

    return register

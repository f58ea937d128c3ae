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
        """Every parameter and buffer by its published name, without the constants that no rule fills."""
        import torch

        shapes = json.loads((self.folder / f"{self.name.removesuffix('.one_thread')}.shapes.json").read_text())
        state = {name: torch.from_numpy(value) for name, value in self.fill.fill_state_dict(shapes).items()}
        for ending, factor in self.info.get("filled_values_multiplied_by", {}).items():
            chosen = [name for name in state if name.endswith(ending.removeprefix("*"))]
            state.update({name: state[name] * self._factor(state, name, factor) for name in chosen})
        constants = self.info.get("constants_not_filled", {})
        return {name: value for name, value in state.items() if name not in constants}

    @staticmethod
    def _factor(state: dict[str, Any], name: str, factor: float | str) -> float:
        """The number that a filled parameter is multiplied by; of standardized convolutions it is told in words."""
        if not isinstance(factor, str):
            return factor
        weights = state[name.rpartition(".")[0] + ".weight"][0].numel()
        return 1 / weights if factor == "1 / n" else weights**-0.5

    def points(self, columns: tuple[int, ...] = (0, 1, 2, 3)) -> np.ndarray:
        """(N, 5) the scan as a user would give it: ``columns`` says where each column of the input goes.

        The nuScenes models were recorded in the raw LIDAR_TOP frame, x right and y forward; a user's x is forward.
        """
        points = np.zeros((len(self.arrays["input"]), 5), np.float32)
        points[:, columns] = self.arrays["input"]
        if "_nus" in self.name:
            points[:, 0], points[:, 1] = points[:, 1].copy(), -points[:, 0].copy()
        return points

    def check(self, stage: str, value: Any, tolerance: float) -> None:
        """Compare a whole map (torch, any number of axes) with the sampled values and statistics of ``stage``."""
        expected_shape = self.info["maps"][stage]["shape"]
        assert list(value.shape) == expected_shape, stage
        array = np.asarray(value, dtype=np.float64).ravel()
        error = self.errors(stage, array)
        assert error.max() < tolerance, f"{stage}: relative error {error.max():.2e}"
        np.testing.assert_allclose(array.std(), self.info["maps"][stage]["std"], rtol=10 * tolerance, err_msg=stage)
        np.testing.assert_allclose(np.abs(array).max(), self.info["maps"][stage]["absmax"], rtol=10 * tolerance)

    def errors(self, stage: str, array: np.ndarray) -> np.ndarray:
        """Errors of a map at the sampled places (and at the samples among what is not 0), relative to the values."""
        flat, errors = array.ravel(), []
        for samples in (f"map.{stage}", f"map.{stage}.nonzero"):
            if f"{samples}.index" in self.arrays:
                index = self.arrays[f"{samples}.index"]
                expected = self.arrays[f"{samples}.value"].astype(np.float64)
                scale = np.maximum(np.abs(expected), self.info["maps"][stage]["std"])
                errors.append(np.abs(flat[index] - expected) / scale)
        return np.concatenate(errors)

    def check_most(self, stage: str, value: Any, tolerance: float, share: float = 0.01) -> None:
        """Compare a whole map with the samples of ``stage``, of which a ``share`` may be off."""
        assert list(value.shape) == self.info["maps"][stage]["shape"], stage
        off = np.mean(self.errors(stage, np.asarray(value, dtype=np.float64)) > tolerance)
        assert off <= share, f"{stage}: {off:.1%} of the samples are off by more than {tolerance}"

    def predictions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The original's final boxes (bottom centre, with velocities if any), scores and labels; x forward."""
        boxes, scores, labels = (self.arrays[f"prediction.{n}_3d"] for n in ("bboxes", "scores", "labels"))
        boxes = boxes.astype(np.float64)
        if "_nus" in self.name:
            for x in (0, 7):
                boxes[:, x], boxes[:, x + 1] = boxes[:, x + 1].copy(), -boxes[:, x].copy()
            boxes[:, 6] -= np.pi / 2
        return boxes, scores.astype(np.float64), labels

    def check_predictions(self, detections: Any, tolerance: float = 1e-3) -> None:
        """Every final box of the original whose score is not tied is there, and there are as many boxes."""
        boxes, scores, labels = self.predictions()
        assert len(detections) == len(boxes)
        _, inverse, counts = np.unique(scores, return_inverse=True, return_counts=True)
        untied = counts[inverse] == 1
        assert untied.any(), "all scores are tied: compare candidates instead"
        self.check_contained(detections, boxes[untied], scores[untied], labels[untied], tolerance)

    @staticmethod
    def check_contained(detections: Any, boxes: Any, scores: Any, labels: Any, tolerance: float) -> None:
        """Each given box (bottom centre) with its score and label is one of ``detections``, no two the same one."""
        from lcf3d.geometry.boxes import mmdet3d_from_canonical

        ours = mmdet3d_from_canonical(detections.boxes)
        if boxes.shape[1] == 9:
            ours = np.concatenate([ours, detections.velocities], axis=1)
        difference = np.abs(boxes[:, None] - ours[None])
        difference[..., 6] = np.abs((difference[..., 6] + np.pi) % (2 * np.pi) - np.pi)
        difference /= 1 + np.abs(boxes[:, None])
        worst = np.maximum(difference.max(axis=2), np.abs(scores[:, None] - detections.scores[None]))
        worst[labels[:, None] != detections.labels[None]] = np.inf
        assert worst.min(axis=1).max(initial=0) < tolerance
        assert len(set(worst.argmin(axis=1))) == len(boxes)


@pytest.fixture(scope="session")
def golden(shared: Path) -> Callable[[str], Golden]:
    """Parity data by model name."""
    folder = shared / "golden" / "models"
    spec = importlib.util.spec_from_file_location("fill", folder / "fill.py")
    assert spec is not None
    assert spec.loader is not None
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

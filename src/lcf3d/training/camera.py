"""Training of the small camera detector: its batches, its loss and its measure, for `lcf3d.training.loop.train`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.structures import IntArray
from lcf3d.training.camera_augmentation import Augmentation, draw_view
from lcf3d.training.camera_evaluation import evaluate_detector
from lcf3d.training.camera_images import ABSENT, LabelledImage
from lcf3d.training.loop import import_torch

if TYPE_CHECKING:
    from lcf3d.detectors.camera.small_network import SmallConfig, SmallDetector

COARSEST = 32
MASK_PARTS = ("fine", "coarse", "prototype")
"""Parts of `SmallDetector` that a network without masks lacks."""


@dataclass(frozen=True)
class CameraTask:
    """What the camera detector learns from.

    Attributes:
        images: to learn from.
        held_out: to measure with; may be empty.
        config: size of the network; its classes are KITTI's three.
        batch_size: views a step.
        view: (height, width) of the views, multiples of 32.
        augmentation: how views are drawn.
        data: what the images are, in words.
        begin: exported network whose weights are begun with, see `lcf3d.training.camera_start`.
    """

    images: Sequence[LabelledImage]
    held_out: Sequence[LabelledImage]
    config: SmallConfig
    batch_size: int = 8
    view: tuple[int, int] = (192, 416)
    augmentation: Augmentation = field(default_factory=Augmentation)
    data: str = ""
    begin: Path | None = None

    def __post_init__(self) -> None:
        if not self.images:
            raise ConfigError("the camera detector needs at least one image to learn from, got none")
        if self.batch_size < 1 or any(side < COARSEST or side % COARSEST for side in self.view):
            raise ConfigError(
                f"batch_size must be 1 or more and views multiples of {COARSEST} pixels, "
                f"got {self.batch_size} and {self.view[0]} x {self.view[1]}"
            )
        if self.config.prototypes and any(image.owner is None for image in self.images):
            raise ConfigError("these images have no instance masks to learn from; train with --no-masks")

    def network(self) -> SmallDetector:
        """A detector with random weights, or with those of the exported network that it begins with."""
        from lcf3d.detectors.camera.small_network import SmallDetector

        network: SmallDetector = SmallDetector(self.config).to(memory_format=import_torch().channels_last)
        if self.begin is not None:
            from lcf3d.training.camera_start import begin_with

            begin_with(network, self.begin, self.batch(0, np.random.default_rng(7)))
        return network

    def described(self) -> dict[str, Any]:
        """What batches depend on, as plain data."""
        told = {"data": self.data, "images": len(self.images), "held_out": len(self.held_out)}
        network: dict[str, Any] = {"prototypes": self.config.prototypes}
        if self.begin is not None:
            network["begin"] = self.begin.name
        return {**told, **network, "batch_size": self.batch_size, "view": self.view, **asdict(self.augmentation)}

    def starting(self, weights: dict[str, Any]) -> dict[str, Any]:
        """Weights to begin with; those of a network with masks serve one without, but for what makes its masks."""
        if self.config.prototypes:
            return weights
        outputs = 4 + self.config.classes
        kept = {name: value for name, value in weights.items() if name.partition(".")[0] not in MASK_PARTS}
        return {name: value[:outputs] if name.startswith("predict.") else value for name, value in kept.items()}

    def batch(self, step: int, rng: np.random.Generator) -> dict[str, Any]:
        """Views of random images: uint8 pixels and the objects of all views one after the other."""
        torch = import_torch()
        chosen = [self._draw(rng) for _ in range(self.batch_size)]
        views = [draw_view(self.images[i], self.view, self.augmentation, rng) for i in chosen]
        most = max(1, *(len(view.labels) for view in views))
        batch = {
            "pixels": np.stack([view.image for view in views]).transpose(0, 3, 1, 2),
            "boxes": np.stack([padded(view.boxes.astype(np.float32), most, 0) for view in views]),
            "visible": np.stack([padded(view.visible.astype(np.float32), most, 0) for view in views]),
            "labels": np.stack([padded(view.labels, most, ABSENT) for view in views]),
            "numbers": np.stack([padded(view.numbers, most, 0) for view in views]),
        }
        if self.config.prototypes:
            batch["owner"] = np.stack([view.owner for view in views if view.owner is not None])
        # the strides of transposed pixels are those of torch's channels_last
        return {name: torch.from_numpy(value) for name, value in batch.items()}

    @cached_property
    def _rare(self) -> IntArray:
        """Images with pedestrians or cyclists."""
        return np.array([i for i, image in enumerate(self.images) if (image.labels > 0).any()], dtype=np.int64)

    def _draw(self, rng: np.random.Generator) -> int:
        """A random image, more often one with pedestrians or cyclists."""
        if len(self._rare) and rng.random() < self.augmentation.sought:
            return int(rng.choice(self._rare))
        return int(rng.integers(len(self.images)))

    def loss(self, network: Any, batch: Any) -> dict[str, Any]:
        """Weighted terms of score, box and mask."""
        from lcf3d.training.camera_losses import Targets, losses

        outputs = network(batch["pixels"].float() / 255)
        targets = Targets(batch["boxes"], batch["visible"], batch["labels"], batch.get("owner"), batch["numbers"])
        return losses(outputs, targets, self.view)

    def validate(self, network: Any) -> dict[str, float]:
        """Average precision and mask IoU of the exported network on the held-out images."""
        if not self.held_out:
            return {}
        from lcf3d.detectors.camera.onnx import OnnxDetector
        from lcf3d.detectors.camera.small_export import export_small

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "camera.onnx"
            export_small(network, path)
            detector = OnnxDetector(path, score_threshold=0.02, threads=1)
            return evaluate_detector(detector, self.held_out).figures()


def padded(values: NDArray[Any], rows: int, filling: float) -> NDArray[Any]:
    """Values with ``rows`` rows: cut, or filled up."""
    result = np.full((rows, *values.shape[1:]), filling, dtype=values.dtype)
    result[: len(values)] = values[:rows]
    return result

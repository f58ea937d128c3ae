"""The base of the camera detectors in torch that load OpenMMLab's COCO checkpoints."""

# mypy: allow-subclassing-any
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from typing_extensions import Self

from lcf3d.detectors.base import Image
from lcf3d.detectors.classes import COCO_CLASSES, to_classes
from lcf3d.detectors.downloads import local_path
from lcf3d.detectors.lidar.fusing import fuse_batch_norm
from lcf3d.detectors.resizing import fitted_size, resize_bilinear
from lcf3d.errors import ConfigError, DetectorError, ShapeError
from lcf3d.networks.checkpoints import load_parameters, read_state_dict
from lcf3d.networks.torch import Tensor, nn, torch, torch_device, torchvision
from lcf3d.structures import KITTI_CLASSES, Detections2D, FloatArray, IntArray

IMAGE_SIZE = (1333, 800)
"""Longer and shorter side that an image is brought into, in pixels."""
MEAN = np.array([123.675, 116.28, 103.53], np.float32)
STD = np.array([58.395, 57.12, 57.375], np.float32)
"""Of the image's channels red, green, blue."""


class CheckpointDetector(ABC):
    """A camera detector from a checkpoint file; a `CameraDetector`.

    Args:
        path: checkpoint file, of which no code is executed, or the name of a published one, downloaded at first use.
        class_names: classes the detections shall have, mapped by name; the network's own without it.
        score_threshold: boxes need a higher score.
        classes: the checkpoint's own classes, comma-separated, where they are not COCO's 80 or KITTI's 3.
        device: torch device.

    Raises:
        DetectorError: the file cannot be read, or is of another network.
        ConfigError: another number of classes than the checkpoint's, a threshold out of range, or unknown device.
    """

    name: ClassVar[str]
    """What the network is called in messages."""
    marks: ClassVar[tuple[str, ...]]
    """Parameters that such a checkpoint has."""
    multiple: ClassVar[int] = 1
    """Pixels that the sides of an input are multiples of."""

    def __init__(
        self,
        path: Path | str,
        class_names: Sequence[str] | None = None,
        score_threshold: float = 0.05,
        classes: str = "",
        device: str = "cpu",
    ) -> None:
        self._setup(read_state_dict(local_path(str(path), "camera")), class_names, score_threshold, classes, device)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], **options: Any) -> Self:
        """The detector with given weights; options as of the class."""
        detector = cls.__new__(cls)
        settings = {"class_names": None, "score_threshold": 0.05, "classes": "", "device": "cpu", **options}
        detector._setup(state, **settings)
        return detector

    def _setup(
        self,
        state: Mapping[str, Any],
        class_names: Sequence[str] | None,
        score_threshold: float,
        classes: str,
        device: str,
    ) -> None:
        torchvision()
        if not 0 <= score_threshold < 1:
            raise ConfigError(f"score_threshold must be in [0, 1), got {score_threshold}")
        lacking = [name for name in self.marks if name not in state]
        if lacking:
            raise DetectorError(f"the checkpoint is no {self.name} of OpenMMLab: it lacks {' and '.join(lacking)}")
        self.network_classes = network_classes(self.class_count(state), classes)
        with torch.device("meta"):
            network = self.build(state)
        load_parameters(network, self.own_parameters(state), f"the checkpoint for {self.name}")
        self.device = torch_device(device)
        self.network = fuse_batch_norm(network.eval()).requires_grad_(False).to(self.device)
        self.class_names = self.network_classes if class_names is None else tuple(class_names)
        self.score_threshold = score_threshold

    @classmethod
    @abstractmethod
    def build(cls, state: Mapping[str, Any]) -> nn.Module:
        """The network that a checkpoint is for."""

    @classmethod
    @abstractmethod
    def class_count(cls, state: Mapping[str, Any]) -> int:
        """Number of a checkpoint's classes."""

    @classmethod
    @abstractmethod
    def own_parameters(cls, state: Mapping[str, Any]) -> dict[str, Any]:
        """A checkpoint's parameters as the network has them."""

    @abstractmethod
    def find(self, image: Tensor, width: int, height: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """(N, 4) boxes ``x1 y1 x2 y2`` in pixels, scores and labels.

        Args:
            image: (1, 3, H, W) of `prepare`.
            width: of what in it is image, in pixels.
            height: likewise.
        """

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detections in (H, W, 3) uint8 RGB images."""
        return [self._detect(image) for image in images]

    def _detect(self, image: Image) -> Detections2D:
        tensor, size = self.prepare(image)
        with torch.inference_mode():
            boxes, scores, labels = self.find(tensor, *size)
        own = np.tile([image.shape[1], image.shape[0]], 2)
        boxes = np.clip(boxes * (own / np.tile(size, 2)), 0, own)
        kept = scores > self.score_threshold
        found = Detections2D(boxes[kept], scores[kept], labels[kept], self.network_classes)
        return to_classes(found, self.class_names)

    def prepare(self, image: Image, image_size: tuple[int, int] | None = IMAGE_SIZE) -> tuple[Tensor, tuple[int, int]]:
        """(1, 3, H, W) input of the network, and width and height of what in it is image.

        Args:
            image: (H, W, 3) uint8 RGB.
            image_size: see `IMAGE_SIZE`; None leaves the image at its size.

        Raises:
            ShapeError: not an RGB image.
        """
        if image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise ShapeError(f"an image must have shape (H, W, 3), got {image.shape}")
        if image_size is not None:
            image = resize_bilinear(image, *fitted_size(image.shape[1], image.shape[0], image_size))
        height, width = image.shape[:2]
        padded = np.zeros((1, 3, height + -height % self.multiple, width + -width % self.multiple), np.float32)
        padded[0, :, :height, :width] = ((image - MEAN) / STD).transpose(2, 0, 1)
        return torch.from_numpy(padded).to(self.device), (width, height)


def network_classes(count: int, names: str) -> tuple[str, ...]:
    """Names of a checkpoint's classes: those given, or COCO's 80 or KITTI's 3.

    Raises:
        ConfigError: neither, or another number of names.
    """
    if names:
        given = tuple(name.strip() for name in names.split(","))
        if len(given) != count:
            raise ConfigError(f"the checkpoint has {count} classes, {len(given)} are named")
        return given
    for known in (COCO_CLASSES, KITTI_CLASSES):
        if len(known) == count:
            return known
    raise ConfigError(f"the checkpoint has {count} classes: name them in their order, ?classes=Car,Pedestrian,...")

"""The base of the detectors that take a whole frame: points, images and calibration."""

# mypy: allow-subclassing-any
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from numpy.typing import NDArray

from lcf3d.detectors.base import SCAN, CloudRequest
from lcf3d.detectors.classes import class_mapping
from lcf3d.detectors.lidar.detector import channels_innermost
from lcf3d.detectors.lidar.fusing import fuse_batch_norm
from lcf3d.detectors.lidar.loading import load_published
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.frame import Frame
from lcf3d.networks.torch import nn, torch, torch_device
from lcf3d.structures import Detections3D

Arrays = dict[str, NDArray[Any]]


class FusionDetector(ABC):
    """A detector of frames: ``detector.detect_frame(frame) -> Detections3D``.

    It may stand where a LiDAR branch stands: alone, or before the fusion with a camera branch.

    Args:
        network: with its weights.
        class_names: classes of the detections; the network's own without it.
        score_threshold: boxes need a higher score.
        device: a torch device, for example ``cpu`` or ``cuda``.

    Raises:
        ConfigError: ``score_threshold`` makes no sense, or there is no such device.
    """

    network_classes: ClassVar[tuple[str, ...]]
    cloud: CloudRequest = SCAN

    def __init__(
        self,
        network: nn.Module,
        class_names: Sequence[str] | None = None,
        score_threshold: float = 0.0,
        device: str = "cpu",
    ) -> None:
        if not 0 <= score_threshold < 1:
            raise ConfigError(f"score_threshold must be in [0, 1), got {score_threshold}")
        self.score_threshold = score_threshold
        self.class_names = self.network_classes if class_names is None else tuple(class_names)
        self.device = torch_device(device)
        self.network = channels_innermost(fuse_batch_norm(network.eval()).requires_grad_(False).to(self.device))

    def detect_frame(self, frame: Frame) -> Detections3D:
        """Detections in a frame, in its LiDAR frame; none where no point lies in the network's range.

        Raises:
            DatasetError: the frame has no scan, or not the images that the network needs.
        """
        if frame.points is None:
            raise DatasetError(f"frame {frame.id} has no scan, which the network needs beside the images")
        inputs = self.inputs(frame)
        if inputs is None:
            return Detections3D.empty(self.class_names)
        with torch.inference_mode():
            found = self.decode(self.network(**self.tensors(inputs)))
        return found.with_classes(self.class_names, class_mapping(found.class_names, self.class_names))

    def tensors(self, inputs: Arrays) -> dict[str, Any]:
        """Input arrays as tensors on the detector's device."""
        return {name: torch.from_numpy(value).to(self.device) for name, value in inputs.items()}

    @abstractmethod
    def inputs(self, frame: Frame) -> Arrays | None:
        """The network's input arrays by name, or None when no point lies in its range."""

    @abstractmethod
    def decode(self, maps: Any) -> Detections3D:
        """Detections, with the network's classes, from the network's output."""


def filled(build: Any, state: Mapping[str, Any], name: str) -> nn.Module:
    """The network that ``build()`` makes, with the parameters of a checkpoint.

    Args:
        build: makes the network, whose weights are then replaced.
        state: parameter name -> tensor, as in the checkpoint.
        name: what the network is called in the message.

    Raises:
        DetectorError: names or shapes differ from the network's.
    """
    with torch.device("meta"):
        network: nn.Module = build()
    load_published(network, state, name)
    return network

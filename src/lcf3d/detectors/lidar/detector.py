"""The base of the LiDAR detectors in torch: a network, its configuration, and how boxes are thresholded."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from lcf3d.detectors.base import CloudRequest
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.fusing import fuse_batch_norm
from lcf3d.detectors.lidar.grounding import ground_of, grounded, levelled
from lcf3d.detectors.lidar.inputs import Inputs, map_detections, pillar_inputs
from lcf3d.detectors.lidar.suppression import NmsMode, suppression_threshold
from lcf3d.detectors.lidar.upright import checked
from lcf3d.errors import ConfigError
from lcf3d.networks.torch import Tensor, nn, torch, torch_device
from lcf3d.structures import Detections3D


class TorchLidarDetector(ABC):
    """A LiDAR detector: ``detector(points) -> Detections3D``.

    Args:
        network: built by `build` and filled with weights; it is put into evaluation mode.
        config: its configuration.
        nms: ``off`` (the paper's choice), ``low`` (only near-copies go) or ``keep`` (the network's own suppression).
        score_threshold: boxes need a higher score; the configuration's own without one.
        device: a torch device, for example ``cpu`` or ``cuda``.
        candidates: best boxes considered before suppression; the configuration's own number without it.
        first_stage_nms: the same as ``nms`` for the proposals of a two-stage network. ``keep`` without it; the LCF3D
            authors raise the first stage's overlap with the last one's, which is ``off`` where ``nms`` is.

    Raises:
        ConfigError: ``nms``, ``first_stage_nms``, ``score_threshold`` or ``candidates`` makes no sense, or there is no
            such device.
    """

    architecture: ClassVar[str]

    def __init__(
        self,
        network: nn.Module,
        config: LidarConfig,
        nms: NmsMode = "keep",
        score_threshold: float | None = None,
        device: str = "cpu",
        candidates: int | None = None,
        first_stage_nms: NmsMode = "keep",
    ) -> None:
        suppression_threshold(nms, 0.0)
        suppression_threshold(first_stage_nms, 0.0)
        if first_stage_nms != "keep" and config.proposals is None:
            raise ConfigError(f"{config.name} has one stage; leave first_stage_nms={first_stage_nms} out, or set nms")
        if score_threshold is not None and not 0 <= score_threshold < 1:
            raise ConfigError(f"score_threshold must be in [0, 1), got {score_threshold}")
        self.config = config if candidates is None else config.with_candidates(candidates)
        self.nms = nms
        self.first_stage_nms = first_stage_nms
        self.score_threshold = config.suppression.score_threshold if score_threshold is None else score_threshold
        self.device = torch_device(device)
        self.network = channels_innermost(network.eval().requires_grad_(False).to(self.device))

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        raise NotImplementedError

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], config: LidarConfig, **options: Any) -> Self:
        """A detector with the given weights, named as in the published checkpoints.

        Args:
            state: parameter name -> tensor.
            config: the configuration that the weights were trained with.
            options: see the class.

        Raises:
            DetectorError: names or shapes differ from the network's.
        """
        from lcf3d.detectors.lidar.loading import load_published

        with torch.device("meta"):
            network = cls.build(config)
        load_published(network, state, config.name)
        return cls(fuse_batch_norm(network.eval()), config, **options)

    @classmethod
    def from_checkpoint(cls, path: Path | str, preset: str | None = None, **options: Any) -> Self:
        """A detector from a checkpoint file of OpenMMLab or OpenPCDet; no code in it is executed.

        Args:
            path: the file.
            preset: name of a configuration; found from the names and shapes of the parameters without it.
            options: see the class.

        Raises:
            DetectorError: the file is damaged, or holds another network or number of classes.
        """
        from lcf3d.detectors.lidar.loading import read_lidar_checkpoint

        state, config = read_lidar_checkpoint(Path(path), preset, cls.architecture)
        return cls.from_state_dict(state, config, **options)

    @property
    def cloud(self) -> CloudRequest:
        """The cloud that the network was trained on, see `lcf3d.detectors.lidar.sweeps.cloud_of`."""
        return self.config.cloud

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes that labels index."""
        return self.config.class_names

    def __call__(self, points: NDArray[np.floating]) -> Detections3D:
        """Detections in a point cloud.

        Args:
            points: (N, 4 or more) ``x, y, z, intensity[, time lag in seconds]`` in the LiDAR frame. Points that are
                not finite or out of range are left out; without any left there are no detections.

        Raises:
            ShapeError: too few columns.
        """
        ground = ground_of(points, self.config)
        inputs = self.inputs(levelled(points, ground, self.config))
        if inputs is None:
            empty = Detections3D.empty(self.class_names)
            return (
                Detections3D(**{**vars(empty), "velocities": np.zeros((0, 2))}) if self.config.has_velocity else empty
            )
        with torch.inference_mode():
            found = self.detect({name: torch.from_numpy(value).to(self.device) for name, value in inputs.items()})
        return checked(grounded(found, ground, self.config), points, self.config, self.score_threshold)

    @abstractmethod
    def inputs(self, points: NDArray[np.floating]) -> Inputs | None:
        """The network's input arrays, or None when no point lies in its range."""

    @abstractmethod
    def detect(self, inputs: dict[str, Tensor]) -> Detections3D:
        """Detections from input tensors on the detector's device."""


class OneStageDetector(TorchLidarDetector):
    """A detector whose head's maps are decoded to the final boxes."""

    def detect(self, inputs: dict[str, Tensor]) -> Detections3D:
        """Detections from input tensors on the detector's device."""
        return map_detections(to_arrays(self.network(**inputs)), self.config, self.score_threshold, self.nms)


class PillarDetector(OneStageDetector):
    """A one-stage detector on pillars."""

    def inputs(self, points: NDArray[np.floating]) -> Inputs | None:
        """See `pillar_inputs`."""
        return pillar_inputs(points, self.config)


def channels_innermost(network: nn.Module) -> nn.Module:
    """``network`` with the weights of its 2D convolutions laid out for maps whose channels are innermost in memory."""
    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
            module.to(memory_format=torch.channels_last)
    return network


def to_arrays(maps: Any) -> Any:
    """Tensors at any depth of lists, tuples and dictionaries as arrays without their batch axis."""
    if isinstance(maps, Tensor):
        return maps[0].cpu().numpy()
    if isinstance(maps, dict):
        return {name: to_arrays(value) for name, value in maps.items()}
    return type(maps)(to_arrays(value) for value in maps)

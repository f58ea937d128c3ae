"""The small network that ships with lcf3d: pillar statistics, a light backbone, centres."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.backbones import SecondBackbone
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.detector import OneStageDetector
from lcf3d.detectors.lidar.encoders import StatisticsEncoder, scatter_pillars
from lcf3d.detectors.lidar.heads import LightCenterHead
from lcf3d.detectors.lidar.inputs import Inputs, encoder_inputs
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.statistics import FEATURES, OF_PAINT
from lcf3d.networks.torch import Tensor, nn, torch


def statistics_width(config: LidarConfig) -> int:
    """Values of a pillar that the network takes."""
    return FEATURES + OF_PAINT * len(config.painted)


class CompactNetwork(nn.Module):
    """Encoder of pillar statistics, scatter, backbone, neck and centre head; one scan or a batch of them."""

    def __init__(self, config: LidarConfig) -> None:
        super().__init__()
        assert config.centers is not None
        self.width, self.height, _ = config.voxels.grid
        self.voxel_encoder = StatisticsEncoder(statistics_width(config), 64, 32)
        self.backbone = SecondBackbone(32, (32, 64, 128), layers=(2, 3, 3), strides=(2, 2, 2))
        self.neck = SecondFPN((32, 64, 128), (24, 24, 24), (1, 2, 4), convolve_unscaled=True)
        self.bbox_head = LightCenterHead(72, 48, config.centers)

    def forward(
        self, features: Tensor, cells: Tensor, scans: int = 1, grid: tuple[int, int] | None = None
    ) -> Sequence[Any]:
        """Output maps of the head.

        Args:
            features: (P, `statistics_width`) pillar statistics of all scans.
            cells: (P,) int64 flat cell of each pillar; those of scan ``i`` start at ``i * height * width``.
            scans: number of scans.
            grid: width and height of the maps in pillars, multiples of 8; those of the configuration without it.
        """
        width, height = grid or (self.width, self.height)
        # in full precision also where the convolutions are not: heights matter to the centimetre
        with torch.autocast(features.device.type, enabled=False):
            canvas = scatter_pillars(self.voxel_encoder(features), cells, height, width, scans)
        if self.training and canvas.device.type == "cpu":
            # gradients of convolutions are quicker with the channels outermost, the convolutions themselves innermost
            canvas = canvas.contiguous()
        maps: Sequence[Any] = self.bbox_head(self.neck(self.backbone(canvas)))
        return maps


class CompactPillars(OneStageDetector):
    """A pillar network of 3.5 GFLOPs for KITTI's classes and range, made to run in real time on a laptop's CPU."""

    architecture: ClassVar[str] = "compact-pillars"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        network = CompactNetwork(config)
        for module in network.modules():
            if isinstance(module, (nn.BatchNorm1d, nn.BatchNorm2d)):
                # trainings are short: the running statistics must keep up
                module.momentum = 0.1
        return network

    def inputs(self, points: NDArray[np.floating]) -> Inputs | None:
        """See `encoder_inputs`."""
        return encoder_inputs(points, self.config)

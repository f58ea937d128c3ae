"""CenterPoint (Yin et al., "Center-based 3D Object Detection and Tracking", CVPR 2021), first stage."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.backbones import SecondBackbone
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.encoders import PillarFeatureNet
from lcf3d.detectors.lidar.heads import CenterHead
from lcf3d.detectors.lidar.inputs import Inputs, pillar_inputs
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.pillars import PillarNetwork
from lcf3d.detectors.lidar.sparse_encoders import SparseEncoder, sparse_shape
from lcf3d.detectors.lidar.voxels import VoxelDetector, VoxelNetwork
from lcf3d.networks.torch import nn


class CenterPoint(VoxelDetector):
    """CenterPoint on nuScenes, with pillars of 0.2 m (variant ``pillar``) or voxels of 0.1 m (variant ``voxel``)."""

    architecture: ClassVar[str] = "centerpoint"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        assert config.centers is not None
        if config.variant == "voxel":
            encoder = SparseEncoder(len(config.channels), sparse_shape(config.voxels), residual=True)
            neck = SecondFPN((128, 256), (256, 256), (1, 2), convolve_unscaled=True)
            return VoxelNetwork(encoder, neck, CenterHead(512, config.centers))
        backbone = SecondBackbone(64, (64, 128, 256), layers=(3, 5, 5), strides=(2, 2, 2))
        neck = SecondFPN((64, 128, 256), (128, 128, 128), (0.5, 1, 2), convolve_unscaled=True)
        head = CenterHead(384, config.centers)
        return PillarNetwork(config, PillarFeatureNet(len(config.channels) + 6), backbone, neck, head)

    def inputs(self, points: NDArray[np.floating]) -> Inputs | None:
        """See `pillar_inputs` and `voxel_inputs`."""
        return super().inputs(points) if self.config.variant == "voxel" else pillar_inputs(points, self.config)

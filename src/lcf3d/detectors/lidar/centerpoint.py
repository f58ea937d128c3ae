"""CenterPoint (Yin et al., "Center-based 3D Object Detection and Tracking", CVPR 2021), first stage."""

from __future__ import annotations

from typing import ClassVar

from lcf3d.detectors.lidar._torch import nn
from lcf3d.detectors.lidar.backbones import SecondBackbone
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.detector import PillarDetector
from lcf3d.detectors.lidar.encoders import PillarFeatureNet
from lcf3d.detectors.lidar.heads import CenterHead
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.pillars import PillarNetwork


class CenterPoint(PillarDetector):
    """CenterPoint on nuScenes with pillars of 0.2 m."""

    architecture: ClassVar[str] = "centerpoint"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        assert config.centers is not None
        encoder = PillarFeatureNet(len(config.channels) + 6)
        backbone = SecondBackbone(64, (64, 128, 256), layers=(3, 5, 5), strides=(2, 2, 2))
        neck = SecondFPN((64, 128, 256), (128, 128, 128), (0.5, 1, 2), convolve_unscaled=True)
        return PillarNetwork(config, encoder, backbone, neck, CenterHead(384, config.centers))

"""PointPillars (Lang et al., "PointPillars: Fast Encoders for Object Detection from Point Clouds", CVPR 2019)."""

from __future__ import annotations

from typing import ClassVar

from lcf3d.detectors.lidar.backbones import SecondBackbone
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.detector import PillarDetector
from lcf3d.detectors.lidar.encoders import HardVFE, PillarFeatureNet
from lcf3d.detectors.lidar.heads import AnchorHead
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.pillars import PillarNetwork
from lcf3d.networks.convolution import FeaturePyramid
from lcf3d.networks.torch import nn


class PointPillars(PillarDetector):
    """PointPillars on KITTI (variant ``secfpn``) and on nuScenes (variant ``fpn``, OpenMMLab's stronger form).

    Pillars of 0.16 m and the neck of the paper on KITTI; pillars of 0.25 m, a second point layer and a feature pyramid
    with one set of anchors for each of three levels on nuScenes.
    """

    architecture: ClassVar[str] = "pointpillars"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        assert config.anchors is not None
        classes = len(config.class_names)
        point_channels = len(config.channels) + 6
        backbone = SecondBackbone(64, (64, 128, 256), layers=(3, 5, 5), strides=(2, 2, 2))
        if config.variant == "fpn":
            head = AnchorHead(256, config.anchors, classes)
            neck = FeaturePyramid((64, 128, 256), eps=1e-3, norm=True, relu=True)
            return PillarNetwork(config, HardVFE(point_channels), backbone, neck, head)
        deblocks = SecondFPN((64, 128, 256), (128, 128, 128), (1, 2, 4))
        head = AnchorHead(384, config.anchors, classes)
        return PillarNetwork(config, PillarFeatureNet(point_channels), backbone, deblocks, head)

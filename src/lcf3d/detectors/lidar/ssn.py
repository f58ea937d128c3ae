"""SSN (Zhu et al., "SSN: Shape Signature Networks for Multi-class Object Detection from Point Clouds", ECCV 2020)."""

from __future__ import annotations

from typing import ClassVar

from lcf3d.detectors.lidar.backbones import RegNet400MF, SecondBackbone
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.detector import PillarDetector
from lcf3d.detectors.lidar.encoders import HardVFE
from lcf3d.detectors.lidar.heads import ShapeAwareHead
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.pillars import PillarNetwork
from lcf3d.networks.torch import nn


class SSN(PillarDetector):
    """SSN on nuScenes: pillars, and one head for each group of similarly shaped classes.

    The variant ``regnet`` has a RegNetX-400MF backbone. The shape signature of the paper is a training target only.
    """

    architecture: ClassVar[str] = "ssn"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        assert config.anchors is not None
        if config.variant == "regnet":
            backbone, channels = RegNet400MF(64), (64, 160, 384)
        else:
            backbone, channels = SecondBackbone(64, (64, 128, 256), layers=(3, 5, 5), strides=(2, 2, 2)), (64, 128, 256)
        neck = SecondFPN(channels, (128, 128, 128), (1, 2, 4))
        head = ShapeAwareHead(384, config.anchors, len(config.class_names))
        return PillarNetwork(config, HardVFE(len(config.channels) + 6), backbone, neck, head)

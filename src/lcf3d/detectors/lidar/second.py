"""SECOND (Yan et al., "SECOND: Sparsely Embedded Convolutional Detection", Sensors 2018)."""

from __future__ import annotations

from typing import ClassVar

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.heads import AnchorHead
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.sparse_encoders import SparseEncoder, sparse_shape
from lcf3d.detectors.lidar.voxels import VoxelDetector, VoxelNetwork
from lcf3d.networks.torch import nn


class SECOND(VoxelDetector):
    """SECOND on KITTI: means of 5 cm voxels, a sparse encoder, anchors."""

    architecture: ClassVar[str] = "second"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        assert config.anchors is not None
        encoder = SparseEncoder(len(config.channels), sparse_shape(config.voxels))
        head = AnchorHead(512, config.anchors, len(config.class_names))
        return VoxelNetwork(encoder, SecondFPN((128, 256), (256, 256), (1, 2)), head)

"""What the sparse-convolution networks share around the network."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.backbones import SecondBackbone
from lcf3d.detectors.lidar.detector import OneStageDetector
from lcf3d.detectors.lidar.inputs import Inputs, network_points, voxel_inputs
from lcf3d.detectors.lidar.voxelization import voxelize
from lcf3d.networks.torch import Tensor, nn


class VoxelNetwork(nn.Module):
    """Sparse encoder, 2D backbone, neck and head of a one-stage voxel detector."""

    def __init__(self, middle_encoder: nn.Module, neck: nn.Module, bbox_head: nn.Module) -> None:
        super().__init__()
        self.middle_encoder = middle_encoder
        self.backbone = voxel_backbone()
        self.neck = neck
        self.bbox_head = bbox_head

    def forward(self, features: Tensor, coordinates: Tensor) -> Sequence[Any]:
        """Output maps of the head, from (V, C) voxel features at (V, 3) ``z, y, x``."""
        maps: Sequence[Any] = self.bbox_head(self.neck(self.backbone(self.middle_encoder(features, coordinates))))
        return maps


def voxel_backbone() -> SecondBackbone:
    """The 2D backbone after a sparse encoder."""
    return SecondBackbone(256, (128, 256), layers=(5, 5), strides=(1, 2))


class VoxelDetector(OneStageDetector):
    """A one-stage detector on voxels."""

    def inputs(self, points: NDArray[np.floating]) -> Inputs | None:
        """See `voxel_inputs`."""
        voxels = voxelize(network_points(points, self.config), self.config.voxels)
        return voxel_inputs(voxels) if len(voxels) else None

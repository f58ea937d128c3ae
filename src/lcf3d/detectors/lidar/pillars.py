"""What the pillar networks (PointPillars, SSN, CenterPoint) share around the network: inputs, network, detections."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.encoders import scatter_pillars
from lcf3d.networks.torch import Tensor, nn


class PillarNetwork(nn.Module):
    """Encoder, scatter, backbone, neck and head of a pillar detector.

    The parameter names are those of the OpenMMLab checkpoints, without the prefix ``pts_`` of the nuScenes models.
    """

    def __init__(
        self, config: LidarConfig, voxel_encoder: nn.Module, backbone: nn.Module, neck: nn.Module, bbox_head: nn.Module
    ) -> None:
        super().__init__()
        self.width, self.height, _ = config.voxels.grid
        self.voxel_encoder = voxel_encoder
        self.backbone = backbone
        self.neck = neck
        self.bbox_head = bbox_head

    def forward(self, features: Tensor, pillar: Tensor, padded: Tensor, cells: Tensor) -> Sequence[Any]:
        """Output maps of the head; the arguments are those of `lcf3d.detectors.lidar.inputs.pillar_inputs`."""
        canvas = scatter_pillars(self.voxel_encoder(features, pillar, padded), cells, self.height, self.width)
        maps: Sequence[Any] = self.bbox_head(self.neck(self.backbone(canvas)))
        return maps

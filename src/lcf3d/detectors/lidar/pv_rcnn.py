"""PV-RCNN (Shi et al., "PV-RCNN: Point-Voxel Feature Set Abstraction for 3D Object Detection", CVPR 2020)."""

# mypy: allow-subclassing-any
from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import LidarConfig, VoxelSpec
from lcf3d.detectors.lidar.decoding import detections, sigmoid
from lcf3d.detectors.lidar.detector import TorchLidarDetector, to_arrays
from lcf3d.detectors.lidar.heads import AnchorHead
from lcf3d.detectors.lidar.inputs import Inputs, network_points, voxel_inputs
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.point_ops import bilinear, farthest_point_sampling
from lcf3d.detectors.lidar.roi import LinearModule, Proposals, propose, refine, region_grid
from lcf3d.detectors.lidar.set_abstraction import SetAbstraction
from lcf3d.detectors.lidar.sparse import SparseTensor
from lcf3d.detectors.lidar.sparse_encoders import SparseEncoder, sparse_shape
from lcf3d.detectors.lidar.suppression import bev_nms, suppression_threshold
from lcf3d.detectors.lidar.voxelization import voxelize
from lcf3d.detectors.lidar.voxels import voxel_backbone
from lcf3d.networks.convolution import ConvModule
from lcf3d.networks.torch import Tensor, nn, torch
from lcf3d.structures import Detections3D

KEYPOINTS = 2048
GRID = 6
"""Grid points of a region along each axis."""


class PointsEncoder(nn.Module):
    """Voxel set abstraction: key points see the map, the raw points and every sparse stage (section 3.2)."""

    def __init__(self, voxels: VoxelSpec) -> None:
        super().__init__()
        self.voxels = voxels
        self.rawpoints_sa_layer = SetAbstraction(1, (0.4, 0.8), (16, 16), 16)
        self.voxel_sa_layers = nn.ModuleList(
            [
                SetAbstraction(16, (0.4, 0.8), (16, 16), 16),
                SetAbstraction(32, (0.8, 1.2), (16, 32), 32),
                SetAbstraction(64, (1.2, 2.4), (16, 32), 64),
                SetAbstraction(64, (2.4, 4.8), (16, 32), 64),
            ]
        )
        self.point_feature_fusion_layer = nn.Sequential(ConvModule(640, 128, 1, eps=1e-5))

    def forward(self, points: Tensor, stages: list[SparseTensor], bev: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Key points (K, 3), their features (K, 640) and the fused features (K, 128)."""
        positions = points[:, :3].contiguous()
        keypoints = positions[farthest_point_sampling(positions, KEYPOINTS)]
        low, size = (positions.new_tensor(value) for value in (self.voxels.area[:3], self.voxels.size))
        cells = (keypoints - low) / size / 8
        parts = [bilinear(bev[0], cells[:, 0], cells[:, 1])]
        parts.append(self.rawpoints_sa_layer(positions, points[:, 3:], keypoints))
        for scale, layer, stage in zip((1, 2, 4, 8), self.voxel_sa_layers, stages, strict=True):
            centers = (stage.sites.coordinates[:, [3, 2, 1]].float() + 0.5) * (size * scale) + low
            parts.append(layer(centers, stage.features, keypoints))
        features = torch.cat(parts, dim=1)
        fused = self.point_feature_fusion_layer(features[:, :, None, None])[:, :, 0, 0]
        return keypoints, features, fused


class SemanticHead(nn.Module):
    """Foreground score of every key point (section 3.3)."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before in (640, 256):
            layers += [nn.Linear(before, 256, bias=False), nn.BatchNorm1d(256, eps=1e-5), nn.ReLU()]
        self.seg_cls_layer = nn.Sequential(*layers, nn.Linear(256, 1))

    def forward(self, features: Tensor) -> Tensor:
        """(K, 1) logits."""
        return self.seg_cls_layer(features)


class GridExtractor(nn.Module):
    """RoI-grid pooling: key points around every grid point of a region (section 3.3)."""

    def __init__(self) -> None:
        super().__init__()
        self.roi_grid_pool_layer = SetAbstraction(128, (0.8, 1.6), (16, 16), 64)

    def forward(self, keypoints: Tensor, features: Tensor, regions: Tensor) -> Tensor:
        """(R, 6, 6, 6, 128)."""
        grid = region_grid(regions, GRID).reshape(-1, 3)
        return self.roi_grid_pool_layer(keypoints, features, grid).reshape(len(regions), GRID, GRID, GRID, -1)


class BoxHead(nn.Module):
    """A score and a refinement of each region."""

    def __init__(self) -> None:
        super().__init__()
        first, second = LinearModule(128 * GRID**3, 256, 2), LinearModule(256, 256, 2)
        self.shared_fc_layer = nn.Sequential(first, nn.Dropout(0.3), second)
        self.cls_layer = self._branch(1)
        self.reg_layer = self._branch(7)

    @staticmethod
    def _branch(out_channels: int) -> nn.Sequential:
        first, second = LinearModule(256, 256, 2), LinearModule(256, 256, 2)
        return nn.Sequential(first, nn.Dropout(0.3), second, nn.Conv2d(256, out_channels, 1))

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """(R,) logits and (R, 7) residuals."""
        x = self.shared_fc_layer(pooled.permute(0, 4, 1, 2, 3).reshape(len(pooled), -1, 1, 1))
        return self.cls_layer(x).reshape(-1), self.reg_layer(x).reshape(-1, 7)


class RoIHead(nn.Module):
    """The second stage."""

    def __init__(self) -> None:
        super().__init__()
        self.semantic_head = SemanticHead()
        self.bbox_roi_extractor = GridExtractor()
        self.bbox_head = BoxHead()

    def forward(self, keypoints: Tensor, features: Tensor, fused: Tensor, regions: Tensor) -> tuple[Tensor, Tensor]:
        """(R,) logits and (R, 7) residuals of (R, 7) regions, from the outputs of `PointsEncoder`."""
        weighted = fused * torch.sigmoid(self.semantic_head(features))
        logits, residuals = self.bbox_head(self.bbox_roi_extractor(keypoints, weighted, regions))
        return logits, residuals


class PVRCNNNetwork(nn.Module):
    """First stage like SECOND; key points and RoI-grid pooling in the second."""

    def __init__(self, config: LidarConfig) -> None:
        super().__init__()
        assert config.anchors is not None
        self.middle_encoder = SparseEncoder(len(config.channels), sparse_shape(config.voxels))
        self.backbone = voxel_backbone()
        self.neck = SecondFPN((128, 256), (256, 256), (1, 2))
        self.rpn_head = AnchorHead(512, config.anchors, len(config.class_names))
        self.points_encoder = PointsEncoder(config.voxels)
        self.roi_head = RoIHead()


class PVRCNN(TorchLidarDetector):
    """PV-RCNN on KITTI."""

    architecture: ClassVar[str] = "pv-rcnn"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        return PVRCNNNetwork(config)

    def inputs(self, points: NDArray[np.floating]) -> Inputs | None:
        """Voxel means, coordinates and the ``points`` (M, 4) in range; None when there are none."""
        selected = network_points(points, self.config)
        voxels = voxelize(selected, self.config.voxels)
        return {**voxel_inputs(voxels), "points": selected} if len(voxels) else None

    def detect(self, inputs: dict[str, Tensor]) -> Detections3D:
        """Detections from input tensors on the detector's device."""
        network = self.network
        stages = network.middle_encoder.stages(inputs["features"], inputs["coordinates"])
        bev = network.middle_encoder.flatten(stages[-1])
        maps = network.rpn_head(network.neck(network.backbone(bev)))
        proposals = propose(to_arrays(maps), self.config, self.first_stage_nms)
        if not len(proposals.boxes):
            return Detections3D.empty(self.class_names)
        return self.refine(network.points_encoder(inputs["points"], stages, bev), proposals)

    def refine(self, encoded: tuple[Tensor, Tensor, Tensor], proposals: Proposals) -> Detections3D:
        """The second stage: scores of the refined boxes, suppressed over all classes together."""
        regions = torch.from_numpy(proposals.boxes).float().to(self.device)
        logits, residuals = self.network.roi_head(*encoded, regions)
        boxes, scores = refine(proposals.boxes, residuals.double().cpu().numpy()), sigmoid(logits.cpu().numpy())
        passed = np.flatnonzero(scores >= self.score_threshold)
        threshold = suppression_threshold(self.nms, self.config.suppression.iou_threshold)
        kept = passed[bev_nms(boxes[passed], scores[passed], threshold)]
        return detections(boxes[kept], scores[kept], proposals.labels[kept], self.config)

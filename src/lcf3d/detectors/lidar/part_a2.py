"""Part-A2 (Shi et al., "From Points to Parts: 3D Object Detection from Point Cloud with Part-aware and
Part-aggregation Network", TPAMI 2020), anchor-based."""

# mypy: allow-subclassing-any
from __future__ import annotations

from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.decoding import detections, sigmoid
from lcf3d.detectors.lidar.detector import TorchLidarDetector, to_arrays
from lcf3d.detectors.lidar.heads import AnchorHead
from lcf3d.detectors.lidar.inputs import Inputs, network_points, voxel_inputs
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.roi import (
    LinearModule,
    Proposals,
    pool_in_regions,
    pooled_maximum,
    pooled_mean,
    propose,
    refine,
)
from lcf3d.detectors.lidar.sparse import SparseBlock, SparseTensor, SubmanifoldConv
from lcf3d.detectors.lidar.sparse_encoders import sparse_shape
from lcf3d.detectors.lidar.sparse_sites import Sites, swap_table
from lcf3d.detectors.lidar.sparse_unet import SparseUNet
from lcf3d.detectors.lidar.suppression import bev_nms, suppression_threshold
from lcf3d.detectors.lidar.voxelization import voxelize
from lcf3d.detectors.lidar.voxels import voxel_backbone
from lcf3d.networks.torch import Tensor, nn, torch
from lcf3d.structures import Detections3D, FloatArray

GRID = 14
"""Cells of a region along each axis."""
FOREGROUND = 0.3
"""Score above which a voxel counts as part of an object."""


class SemanticHead(nn.Module):
    """Foreground score and position within the object, of every voxel (section 3.2)."""

    def __init__(self) -> None:
        super().__init__()
        self.seg_cls_layer = nn.Linear(16, 1)
        self.seg_reg_layer = nn.Linear(16, 3)

    def forward(self, features: Tensor) -> Tensor:
        """(V, 4) part offsets, 0 in the background, and foreground score."""
        scores = torch.sigmoid(self.seg_cls_layer(features))
        offsets = torch.sigmoid(self.seg_reg_layer(features)) * (scores > FOREGROUND)
        return torch.cat([offsets, scores], dim=1)


class DownConv(nn.Module):
    """Sparse convolutions on the region grid, before and after halving it."""

    def __init__(self) -> None:
        super().__init__()
        self.merge_conv = nn.Sequential(*(SparseBlock(SubmanifoldConv(128, 128)) for _ in range(2)))
        self.down_conv = nn.Sequential(SparseBlock(SubmanifoldConv(128, 128)), SparseBlock(SubmanifoldConv(128, 256)))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features of 256 channels on a grid of half the size."""
        for block in self.merge_conv:
            x = block(x)
        sites, table = x.sites.strided_table((2, 2, 2), (2, 2, 2), (0, 0, 0))
        padded = torch.cat([x.features, torch.full_like(x.features[:1], -torch.inf)])
        x = SparseTensor(padded[swap_table(table, len(sites))].amax(dim=1), sites)
        for block in self.down_conv:
            x = block(x)
        return x


class PartHead(nn.Module):
    """From pooled parts and features to a score and a refinement of each region (section 3.4)."""

    def __init__(self) -> None:
        super().__init__()
        self.part_conv = nn.Sequential(SparseBlock(SubmanifoldConv(4, 64)), SparseBlock(SubmanifoldConv(64, 64)))
        self.seg_conv = nn.Sequential(SparseBlock(SubmanifoldConv(16, 64)), SparseBlock(SubmanifoldConv(64, 64)))
        self.conv_down = DownConv()
        widths = (256 * (GRID // 2) ** 3, 512, 512, 512)
        shared: list[nn.Module] = []
        for before, after in pairwise(widths):
            shared += [LinearModule(before, after, 1, 1e-3), nn.Dropout(0.1)]
        self.shared_fc = nn.Sequential(*shared[:-1])
        self.conv_cls = self._branch(1)
        self.conv_reg = self._branch(7)

    @staticmethod
    def _branch(out_channels: int) -> nn.Sequential:
        first, second = LinearModule(512, 256, 1, 1e-3), LinearModule(256, 256, 1, 1e-3)
        return nn.Sequential(first, nn.Dropout(0.1), second, LinearModule(256, out_channels, 1, norm=False))

    def forward(self, seg: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        """(R,) logits and (R, 7) residuals from pooled (R, 14, 14, 14, 16) features and (R, 14, 14, 14, 4) parts."""
        regions = len(part)
        cells = torch.nonzero(part.sum(dim=-1))
        index = cells.unbind(1)
        sites = Sites(cells, (GRID, GRID, GRID))
        x_part = self.part_conv(SparseTensor(part[index], sites))
        x_seg = self.seg_conv(SparseTensor(seg[index], sites))
        merged = x_part.with_features(torch.cat([x_seg.features, x_part.features], dim=1))
        x = self.shared_fc(self.conv_down(merged).dense(regions).reshape(regions, -1, 1))
        return self.conv_cls(x).reshape(-1), self.conv_reg(x).reshape(-1, 7)


class RoIHead(nn.Module):
    """The second stage: part-aware features pooled in every region."""

    def __init__(self) -> None:
        super().__init__()
        self.semantic_head = SemanticHead()
        self.bbox_head = PartHead()

    def forward(self, features: Tensor, centers: Tensor, regions: Tensor) -> tuple[Tensor, Tensor]:
        """(R,) logits and (R, 7) residuals of (R, 7) regions, from (V, 16) features at (V, 3) voxel centres."""
        point, cell = pool_in_regions(regions, centers, GRID)
        count = len(regions) * GRID**3
        shape = (len(regions), GRID, GRID, GRID, -1)
        seg = pooled_maximum(features[point], cell, count).reshape(shape)
        part = pooled_mean(self.semantic_head(features)[point], cell, count).reshape(shape)
        logits, residuals = self.bbox_head(seg, part)
        return logits, residuals


class PartA2Network(nn.Module):
    """First stage like SECOND, on a sparse U-Net; second stage `RoIHead`."""

    def __init__(self, config: LidarConfig) -> None:
        super().__init__()
        assert config.anchors is not None
        self.middle_encoder = SparseUNet(len(config.channels), sparse_shape(config.voxels))
        self.backbone = voxel_backbone()
        self.neck = SecondFPN((128, 256), (256, 256), (1, 2))
        self.rpn_head = AnchorHead(512, config.anchors, len(config.class_names))
        self.roi_head = RoIHead()


class PartA2(TorchLidarDetector):
    """Part-A2 on KITTI."""

    architecture: ClassVar[str] = "part-a2"

    @classmethod
    def build(cls, config: LidarConfig) -> nn.Module:
        """The network of ``config``, with untrained weights."""
        return PartA2Network(config)

    def inputs(self, points: NDArray[np.floating]) -> Inputs | None:
        """Voxel means, coordinates and ``centers`` (V, 3) in metres; None when no point lies in range."""
        spec = self.config.voxels
        voxels = voxelize(network_points(points, self.config), spec)
        if not len(voxels):
            return None
        low, size = np.array(spec.area[:3], np.float32), np.array(spec.size, np.float32)
        centers = (voxels.coordinates[:, ::-1].astype(np.float32) + np.float32(0.5)) * size + low
        return {**voxel_inputs(voxels), "centers": centers}

    def detect(self, inputs: dict[str, Tensor]) -> Detections3D:
        """Detections from input tensors on the detector's device."""
        network = self.network
        bev, features = network.middle_encoder(inputs["features"], inputs["coordinates"])
        maps = network.rpn_head(network.neck(network.backbone(bev)))
        return self.refine(features, inputs["centers"], propose(to_arrays(maps), self.config, self.first_stage_nms))

    def refine(self, features: Tensor, centers: Tensor, proposals: Proposals) -> Detections3D:
        """The second stage; scores are the sigmoid of the original's raw score."""
        if not len(proposals.boxes):
            return Detections3D.empty(self.class_names)
        regions = torch.from_numpy(proposals.boxes).float().to(self.device)
        logits, residuals = self.network.roi_head(features, centers, regions)
        boxes = refine(proposals.boxes, residuals.double().cpu().numpy())
        return self._suppress(boxes, sigmoid(logits.cpu().numpy()), proposals)

    def _suppress(self, boxes: FloatArray, scores: FloatArray, proposals: Proposals) -> Detections3D:
        """Class by class, ranked by the first stage's scores, as in the original."""
        threshold = suppression_threshold(self.nms, self.config.suppression.iou_threshold)
        kept = []
        for label in range(proposals.scores.shape[1]):
            rank = proposals.scores[:, label]
            passed = np.flatnonzero(rank >= self.score_threshold)
            kept.append(passed[bev_nms(boxes[passed], rank[passed], threshold)])
        index = np.concatenate(kept) if self.nms == "keep" else np.unique(np.concatenate(kept))
        return detections(boxes[index], scores[index], proposals.labels[index], self.config)

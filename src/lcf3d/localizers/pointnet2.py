"""Frustum PointNet ``v2``: the PointNet++ form of the LCF3D authors, with their parameter names, for their checkpoints.

Segmentation by multi-scale set abstraction and feature propagation, a T-Net, and a single-scale box network (Qi et
al., NeurIPS 2017; Qi et al., CVPR 2018); sizes as in the authors' release.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence

from lcf3d.detectors.lidar.point_ops import ball_query, farthest_point_sampling, three_nn_interpolation
from lcf3d.localizers.pointnet import FrustumOutputs
from lcf3d.localizers.spec import LocalizerSpec
from lcf3d.networks.convolution import ConvModule
from lcf3d.networks.torch import Tensor, functional, nn, torch

EPS = 1e-5
FEWEST, MOST = 16, 128
"""Points that the box network gets at least and at most."""


def shared_layers(channels: Sequence[int], bias: bool) -> nn.Sequential:
    """1 x 1 convolutions with batch normalization and ReLU, named ``layer0``, ``layer1``, ..."""
    layers = nn.Sequential()
    for i in range(len(channels) - 1):
        layers.add_module(f"layer{i}", ConvModule(channels[i], channels[i + 1], 1, eps=EPS, bias=bias))
    return layers


class Abstraction(nn.Module):
    """Set abstraction: at ``centres`` farthest points, for each radius, the maximum over neighbours.

    Args:
        channels: of the points' features.
        centres: how many points are kept; None for one group of all.
        radii: in metres.
        neighbours: at each radius.
        widths: output channels of the shared layers, at each radius.
        bias: whether the convolutions have a bias.
    """

    def __init__(
        self,
        channels: int,
        centres: int | None,
        radii: Sequence[float],
        neighbours: Sequence[int],
        widths: Sequence[Sequence[int]],
        bias: bool,
    ) -> None:
        super().__init__()
        self.centres, self.radii, self.neighbours = centres, tuple(radii), tuple(neighbours)
        self.mlps = nn.ModuleList([shared_layers((channels + 3, *row), bias) for row in widths])

    def forward(self, positions: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """(K, M, 3) and (K, M', C') of (K, N, 3) positions and (K, N, C) features; one group of all has M = 1."""
        if self.centres is None:
            grouped = torch.cat([positions, features], dim=2).transpose(1, 2)[:, :, None]
            return positions[:, :1], self.mlps[0](grouped).amax(dim=3).transpose(1, 2)
        chosen = torch.stack([farthest_point_sampling(p, self.centres) for p in positions])
        centres = _taken(positions, chosen)
        parts = []
        for radius, count, mlp in zip(self.radii, self.neighbours, self.mlps, strict=True):
            index = torch.stack([ball_query(c, p, radius, count) for c, p in zip(centres, positions, strict=True)])
            flat = index.clamp(min=0).flatten(1)
            shape = (*index.shape, -1)
            offsets = _taken(positions, flat).reshape(shape) - centres[:, :, None]
            grouped = torch.cat([offsets, _taken(features, flat).reshape(shape)], dim=3)
            parts.append(mlp(grouped.permute(0, 3, 1, 2)).amax(dim=3))
        return centres, torch.cat(parts, dim=1).transpose(1, 2)


def _taken(values: Tensor, index: Tensor) -> Tensor:
    """(K, M, C) rows of (K, N, C) at (K, M)."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[2]))


class Backbone(nn.Module):
    """Set abstractions one after the other."""

    def __init__(self, modules: Sequence[Abstraction]) -> None:
        super().__init__()
        self.SA_modules = nn.ModuleList(modules)

    def forward(self, positions: Tensor, features: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Positions and features of every level, the input first."""
        levels, values = [positions], [features]
        for module in self.SA_modules:
            positions, features = module(positions, features)
            levels.append(positions)
            values.append(features)
        return levels, values


class Propagation(nn.Module):
    """Features carried from a coarse level to a fine one, and joined with those that are there."""

    def __init__(self, channels: Sequence[int]) -> None:
        super().__init__()
        self.mlps = shared_layers(channels, bias=False)

    def forward(self, fine: Tensor, coarse: Tensor, there: Tensor | None, carried: Tensor) -> Tensor:
        """(K, N, C') at (K, N, 3) fine positions."""
        if coarse.shape[1] == 1:
            moved = carried.expand(-1, fine.shape[1], -1)
        else:
            rows = zip(fine, coarse, carried, strict=True)
            moved = torch.stack([three_nn_interpolation(f, c, v) for f, c, v in rows])
        joined = moved if there is None else torch.cat([moved, there], dim=2)
        values: Tensor = self.mlps(joined.transpose(1, 2)[..., None])
        return values[..., 0].transpose(1, 2)


class PointConv(nn.Module):
    """A point-wise convolution with batch normalization and ReLU under the names ``conv`` and ``bn``."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(in_channels, out_channels, 1)
        self.bn = nn.BatchNorm1d(out_channels, eps=EPS)

    def forward(self, x: Tensor) -> Tensor:
        """(K, in, N) -> (K, out, N)."""
        return functional.relu(self.bn(self.conv(x)))


class MaskHead(nn.Module):
    """Feature propagation back to the points, and two logits for each."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        widths = ((1024 + classes + 640, 128, 128), (128 + 320, 128, 128), (128, 128, 128))
        self.FP_modules = nn.ModuleList([Propagation(row) for row in widths])
        self.pre_seg_conv = PointConv(128, 128)
        self.conv_seg = nn.Conv1d(128, 2, 1)

    def forward(self, levels: Sequence[Tensor], values: Sequence[Tensor], one_hot: Tensor) -> Tensor:
        """(K, 2, N) logits: not the object's, the object's."""
        carried = torch.cat([values[3], one_hot[:, None]], dim=2)
        for i, module in enumerate(self.FP_modules):
            there = values[2 - i] if i < 2 else None
            carried = module(levels[2 - i], levels[3 - i], there, carried)
        logits: Tensor = self.conv_seg(self.pre_seg_conv(carried.transpose(1, 2)))
        return logits


class TNet(nn.Module):
    """Where the centre lies, seen from the mean of the mask."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.conv1, self.conv2, self.conv3 = nn.Conv1d(3, 64, 1), nn.Conv1d(64, 128, 1), nn.Conv1d(128, 256, 1)
        self.fc1, self.fc2, self.fc3 = nn.Linear(256 + classes, 256), nn.Linear(256, 128), nn.Linear(128, 3)
        self.bn1, self.bn2, self.bn3 = nn.BatchNorm1d(64), nn.BatchNorm1d(128), nn.BatchNorm1d(256)
        self.bn4, self.bn5 = nn.BatchNorm1d(256), nn.BatchNorm1d(128)

    def forward(self, points: Tensor, one_hot: Tensor) -> Tensor:
        """(K, 3) of (K, 3, M) points."""
        x = functional.relu(self.bn1(self.conv1(points)))
        x = functional.relu(self.bn2(self.conv2(x)))
        x = functional.relu(self.bn3(self.conv3(x))).amax(dim=2)
        x = functional.relu(self.bn4(self.fc1(torch.cat([x, one_hot], dim=1))))
        step: Tensor = self.fc3(functional.relu(self.bn5(self.fc2(x))))
        return step


class FrustumPointNet2(nn.Module):
    """Segmentation, centre, box of (K, 5, 128) points in the frustum frame and (K, NS) class one-hots."""

    def __init__(self, spec: LocalizerSpec) -> None:
        super().__init__()
        classes = len(spec.class_names)
        self.seg_backbone = Backbone(
            [
                Abstraction(
                    2, 128, (0.2, 0.4, 0.8), (32, 64, 128), ((32, 32, 64), (64, 64, 128), (64, 96, 128)), bias=True
                ),
                Abstraction(
                    320,
                    32,
                    (0.4, 0.8, 1.6),
                    (64, 64, 128),
                    ((64, 64, 128), (128, 128, 256), (128, 128, 256)),
                    bias=True,
                ),
                Abstraction(640, None, (0.0,), (0,), ((128, 256, 1024),), bias=True),
            ]
        )
        self.seg_decode_head = MaskHead(classes)
        self.tnet = TNet(classes)
        self.box_estimation_backbone = Backbone(
            [
                Abstraction(2, 32, (0.2,), (32,), ((64, 64, 128),), bias=False),
                Abstraction(128, 16, (0.4,), (16,), ((128, 128, 256),), bias=False),
                Abstraction(256, None, (0.0,), (0,), ((256, 256, 512),), bias=False),
            ]
        )
        self.fc_layers = nn.ModuleList([nn.Linear(512 + classes, 512), nn.Linear(512, 256)])
        self.bn_layers = nn.ModuleList([nn.BatchNorm1d(512), nn.BatchNorm1d(256)])
        self.output_fc = nn.Linear(256, spec.outputs)

    def forward(self, points: Tensor, one_hot: Tensor) -> FrustumOutputs:
        """See `FrustumOutputs`; the quality is the mean certainty of the mask, since this form predicts none."""
        rows = points.transpose(1, 2)
        positions, features = rows[:, :, :3].contiguous(), rows[:, :, 3:]
        logits = self.seg_decode_head(*self.seg_backbone(positions, features), one_hot)
        on = logits[:, 1] > logits[:, 0]
        count = on.sum(dim=1, keepdim=True)
        mean = (positions * on[..., None]).sum(dim=1) / (count + 1e-4)
        kept = _kept(on)
        seen = _taken(positions, kept) - mean[:, None]
        coarse = mean + self.tnet(seen.transpose(1, 2), one_hot)
        x = self._box_features(_taken(positions, kept) - coarse[:, None], _taken(features, kept))
        x = torch.cat([x, one_hot], dim=1)
        for layer, norm in zip(self.fc_layers, self.bn_layers, strict=True):
            x = functional.relu(norm(layer(x)))
        values = self.output_fc(x)
        difference = logits[:, 1] - logits[:, 0]
        sure = (torch.sigmoid(difference) * on).sum(dim=1) / count.clamp(min=1)[:, 0]
        quality = torch.logit(sure, eps=1e-3)
        return FrustumOutputs(difference, coarse, coarse + values[:, :3], values, quality)

    def _box_features(self, positions: Tensor, features: Tensor) -> Tensor:
        _, values = self.box_estimation_backbone(positions.contiguous(), features)
        return values[-1][:, 0]


def _kept(on: Tensor) -> Tensor:
    """(K, M) indices of the mask's points in order, M between `FEWEST` and `MOST`; repeated where there are fewer.

    A mask without any point takes the first points.
    """
    order = torch.argsort(~on, dim=1, stable=True)
    count = on.sum(dim=1, keepdim=True).clamp(min=1)
    wanted = int(count.max().clamp(FEWEST, MOST))
    index = torch.arange(wanted, device=on.device)[None] % count
    return order.gather(1, index)

"""Frustum PointNet ``v1`` (Qi et al., CVPR 2018): segmentation, T-Net, box network; narrow, for a CPU.

Differences from the paper, each for accuracy at this size or for a fixed ONNX graph: coordinates relative to where an
object of the class would fill the 2D box; the 2D box's geometry joins the class one-hot; instead of gathering the
points of the mask, the maxima run over the mask; one more output says how well the box is believed to fit.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lcf3d.errors import MissingExtraError
from lcf3d.files import atomic_path
from lcf3d.localizers.frustum_inputs import CONTEXT, POINT_CHANNELS
from lcf3d.localizers.onnx import INPUTS, OUTPUTS, SPEC_KEY
from lcf3d.localizers.spec import LocalizerSpec
from lcf3d.networks.torch import Tensor, functional, nn, torch

OPSET = 17
OUTSIDE = -1e4
"""Takes the place of features off the mask, so that no maximum is one of them."""


class FrustumOutputs(NamedTuple):
    """What a frustum network gives.

    Attributes:
        mask: (K, N) logits of a point being the object's.
        coarse: (K, 3) mask mean plus T-Net, in input coordinates.
        centre: (K, 3) the same plus the box network's residual.
        box: (K, spec.outputs) of the box head.
        quality: (K,) logit of the 3D IoU that the box is believed to have.
    """

    mask: Tensor
    coarse: Tensor
    centre: Tensor
    box: Tensor
    quality: Tensor


class PointLayers(nn.Sequential):
    """Shared layers on (K, C, N) points, each with batch normalization and ReLU."""

    def __init__(self, channels: Sequence[int]) -> None:
        layers: list[nn.Module] = []
        for a, b in itertools.pairwise(channels):
            layers += [nn.Conv1d(a, b, 1, bias=False), nn.BatchNorm1d(b), nn.ReLU()]
        super().__init__(*layers)


class DenseLayers(nn.Sequential):
    """Layers on (K, C) vectors, each with batch normalization and ReLU."""

    def __init__(self, channels: Sequence[int]) -> None:
        layers: list[nn.Module] = []
        for a, b in itertools.pairwise(channels):
            layers += [nn.Linear(a, b, bias=False), nn.BatchNorm1d(b), nn.ReLU()]
        super().__init__(*layers)


class FrustumPointNet(nn.Module):
    """Segmentation, centre, box of (K, 6, N) points and (K, NS + CONTEXT) contexts."""

    def __init__(self, spec: LocalizerSpec) -> None:
        super().__init__()
        known = len(spec.class_names) + CONTEXT
        self.point_layers = PointLayers((POINT_CHANNELS, 64, 64))
        self.wide_layers = PointLayers((64, 128, 192))
        # the global feature meets every point: what is the same for all points is computed once
        self.global_layer = nn.Linear(192 + known, 128)
        self.local_layer = nn.Conv1d(64, 128, 1)
        self.mask_layers = nn.Sequential(nn.BatchNorm1d(128), nn.ReLU(), *PointLayers((128, 64)), nn.Conv1d(64, 1, 1))
        self.tnet_points = PointLayers((POINT_CHANNELS, 64, 128))
        self.tnet_layers = nn.Sequential(*DenseLayers((128 + known, 128, 64)), nn.Linear(64, 3))
        self.box_points = PointLayers((POINT_CHANNELS, 64, 128, 256))
        self.box_layers = nn.Sequential(*DenseLayers((256 + known + 3, 256, 128)), nn.Linear(128, spec.outputs + 1))

    def forward(self, points: Tensor, context: Tensor) -> FrustumOutputs:
        """See `FrustumOutputs`."""
        local = self.point_layers(points)
        everywhere = torch.cat([self.wide_layers(local).amax(dim=2), context], dim=1)
        mask = self.mask_layers(self.local_layer(local) + self.global_layer(everywhere)[:, :, None])[:, 0]
        # at least the likeliest point is the object's
        on = mask >= mask.amax(dim=1, keepdim=True).clamp(max=0)
        share = on.to(points.dtype) / on.sum(dim=1, keepdim=True).to(points.dtype)
        mean = (points[:, :3] * share[:, None]).sum(dim=2)
        step = self.tnet_layers(torch.cat([self._pool(self.tnet_points, points, mean, on), context], dim=1))
        coarse = mean + step
        pooled = self._pool(self.box_points, points, coarse, on)
        values = self.box_layers(torch.cat([pooled, context, coarse], dim=1))
        return FrustumOutputs(mask, coarse, coarse + values[:, :3], values[:, :-1], values[:, -1])

    @staticmethod
    def _pool(layers: nn.Module, points: Tensor, centre: Tensor, on: Tensor) -> Tensor:
        """(K, C) maximum over the mask of features of the points seen from ``centre``."""
        seen = torch.cat([points[:, :3] - centre[:, :, None], points[:, 3:]], dim=1)
        return torch.where(on[:, None], layers(seen), OUTSIDE).amax(dim=2)


class _Flat(nn.Module):
    """A network with the outputs that inference needs."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, points: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Centres, box head, quality in [0, 1]."""
        outputs = self.network(points, context)
        return outputs.centre, outputs.box, torch.sigmoid(outputs.quality)


def export_onnx(network: nn.Module, spec: LocalizerSpec, path: Path) -> None:
    """Write a ``v1`` network for `lcf3d.localizers.onnx.OnnxLocalizer`; any number of frustums at once.

    Raises:
        MissingExtraError: the package onnx is not installed.
    """
    try:
        import onnx
    except ModuleNotFoundError:
        raise MissingExtraError("onnx", "train", "exporting a network") from None
    example = (torch.zeros(2, POINT_CHANNELS, spec.points), torch.zeros(2, len(spec.class_names) + CONTEXT))
    with atomic_path(path) as temporary:
        torch.onnx.export(
            _Flat(network).eval(),
            example,
            str(temporary),
            input_names=list(INPUTS),
            output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "frustums"} for name in (*INPUTS, *OUTPUTS)},
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(str(temporary))
        entry = model.metadata_props.add()
        entry.key, entry.value = SPEC_KEY, spec.to_json()
        onnx.save(model, str(temporary))


def smooth_l1(values: Tensor, beta: float = 1.0) -> Tensor:
    """(...,) Huber loss of differences, quadratic below ``beta``."""
    return functional.smooth_l1_loss(values, torch.zeros_like(values), beta=beta, reduction="none")

"""DetectoRS (Qiao et al., CVPR 2021): a backbone that looks twice, with convolutions that choose how far they reach.

The form is OpenMMLab's ``detectors_cascade-rcnn_r50_1x_coco`` (recursive feature pyramid, switchable atrous
convolution, Cascade R-CNN), whose checkpoints load, with 80 classes or others.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lcf3d.detectors.camera.checkpoint_detector import CheckpointDetector
from lcf3d.detectors.camera.torchvision_boxes import clip_boxes, decode_boxes, roi_features, select_detections
from lcf3d.detectors.camera.torchvision_fasterrcnn import STRIDES, BoxHead, RPNHead
from lcf3d.networks.convolution import FeaturePyramid
from lcf3d.networks.resnet import ResNet
from lcf3d.networks.torch import Tensor, functional, nn, torch, torchvision
from lcf3d.structures import FloatArray, IntArray

ANCHOR_SCALE, ANCHOR_RATIOS = 8, (0.5, 1.0, 2.0)
DEVIATIONS = ((0.1, 0.1, 0.2, 0.2), (0.05, 0.05, 0.1, 0.1), (0.033, 0.033, 0.067, 0.067))
"""What the residuals of each stage of the cascade are multiplied by."""
IOU_THRESHOLD = 0.5
"""Of the final suppression, per class."""
_GAMMA, _BETA = "weight_gamma", "weight_beta"


class SwitchableConv(nn.Module):
    """A 3 x 3 deformable convolution with a near and a far reach, mixed as a switch says (section 4)."""

    def __init__(self, channels: int, stride: int) -> None:
        super().__init__()
        self.stride = stride
        self.weight = nn.Parameter(torch.zeros(channels, channels, 3, 3))
        self.weight_diff = nn.Parameter(torch.zeros(channels, channels, 3, 3))
        self.switch = nn.Conv2d(channels, 1, 1, stride)
        self.pre_context = nn.Conv2d(channels, channels, 1)
        self.post_context = nn.Conv2d(channels, channels, 1)
        self.offset_s = nn.Conv2d(channels, 18, 3, stride, 1)
        self.offset_l = nn.Conv2d(channels, 18, 3, stride, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C, H / stride, W / stride)."""
        x = x + self.pre_context(functional.adaptive_avg_pool2d(x, 1))
        around = functional.avg_pool2d(functional.pad(x, (2, 2, 2, 2), mode="reflect"), 5, 1)
        switch = self.switch(around)
        deform = torchvision().ops.deform_conv2d
        near = deform(x, self.offset_s(around), self.weight, None, self.stride, 1, 1)
        far = deform(x, self.offset_l(around), self.weight + self.weight_diff, None, self.stride, 3, 3)
        out = switch * near + (1 - switch) * far
        return out + self.post_context(functional.adaptive_avg_pool2d(out, 1))


class SwitchableResNet(ResNet):
    """ResNet-50 whose 3 x 3 convolutions are switchable from the second stage on.

    Args:
        recursive: it also takes the maps of a first look.
    """

    def __init__(self, recursive: bool) -> None:
        super().__init__(50, caffe=False)
        for layer in (self.layer2, self.layer3, self.layer4):
            for block in layer:
                block.conv2 = SwitchableConv(block.conv2.in_channels, block.conv2.stride[0])
            if recursive:
                layer[0].rfp_conv = nn.Conv2d(256, layer[0].conv3.out_channels, 1)

    def look_again(self, image: Tensor, first: Sequence[Tensor]) -> list[Tensor]:
        """The four maps, from the image and what a first look said at strides 8, 16 and 32."""
        x = functional.relu(self.bn1(self.conv1(image)))
        maps = [self.layer1(functional.max_pool2d(x, 3, 2, 1))]
        for layer, seen in zip((self.layer2, self.layer3, self.layer4), first, strict=True):
            block = layer[0]
            x = functional.relu(block.bn1(block.conv1(maps[-1])))
            x = functional.relu(block.bn2(block.conv2(x)))
            x = block.bn3(block.conv3(x)) + block.downsample(maps[-1])
            maps.append(layer[1:](functional.relu(x + block.rfp_conv(seen))))
        return maps


class AtrousPooling(nn.Module):
    """Each cell with what lies near, further away, far away and anywhere (atrous spatial pyramid pooling)."""

    def __init__(self) -> None:
        super().__init__()
        shapes = ((1, 1), (3, 3), (3, 6), (1, 1))
        self.aspp = nn.ModuleList(
            [
                nn.Conv2d(256, 64, kernel, padding=dilation * (kernel // 2), dilation=dilation)
                for kernel, dilation in shapes
            ]
        )

    def forward(self, x: Tensor) -> Tensor:
        """(N, 256, H, W) -> (N, 256, H, W)."""
        *near, anywhere = self.aspp
        parts = [conv(x) for conv in near]
        parts.append(anywhere(functional.adaptive_avg_pool2d(x, 1)).expand_as(parts[0]))
        return functional.relu(torch.cat(parts, dim=1))


class RecursivePyramid(FeaturePyramid):
    """A feature pyramid that tells a second backbone what it saw and takes in what that sees then (section 3)."""

    def __init__(self) -> None:
        super().__init__((256, 512, 1024, 2048), extra=True)
        self.rfp_modules = nn.ModuleList([SwitchableResNet(recursive=True)])
        self.rfp_aspp = AtrousPooling()
        self.rfp_weight = nn.Conv2d(256, 1, 1)

    def look(self, image: Tensor, maps: Sequence[Tensor]) -> list[Tensor]:
        """Five maps of 256 channels from the image and the first backbone's maps."""
        first = self(maps)
        again = self.rfp_modules[0].look_again(image, [self.rfp_aspp(x) for x in first[1:4]])
        mixed = []
        for old, new in zip(first, self(again), strict=True):
            share = self.rfp_weight(new).sigmoid()
            mixed.append(share * new + (1 - share) * old)
        return mixed


class _Cascade(nn.Module):
    """The box heads under the name ``bbox_head``."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.bbox_head = nn.ModuleList([BoxHead(classes, agnostic=True) for _ in DEVIATIONS])


class DetectoRSNetwork(nn.Module):
    """The whole network, for one image at a time."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.backbone = SwitchableResNet(recursive=False)
        self.neck = RecursivePyramid()
        self.rpn_head = RPNHead(len(ANCHOR_RATIOS))
        self.roi_head = _Cascade(classes)

    def forward(self, image: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """(R, K) scores and (R, 4) boxes of the regions of a padded (1, 3, H, W) image of height x width pixels."""
        maps = self.neck.look(image, self.backbone(image))
        regions, _ = self.rpn_head.propose(maps, ANCHOR_SCALE, ANCHOR_RATIOS, height, width)
        return self.refine(maps, regions, height, width)

    def refine(self, maps: Sequence[Tensor], regions: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Scores and boxes of (R, 4) regions after three rounds, each on the boxes of the one before."""
        total = regions.new_zeros(())
        for head, deviations in zip(self.roi_head.bbox_head, DEVIATIONS, strict=True):
            logits, residuals = head(roi_features(maps[:4], regions, STRIDES))
            total = total + logits
            regions = clip_boxes(decode_boxes(regions, residuals * residuals.new_tensor(deviations)), height, width)
        return (total / len(DEVIATIONS)).softmax(dim=1)[:, :-1], regions


class DetectoRSDetector(CheckpointDetector):
    """DetectoRS on Cascade R-CNN with ResNet-50; see `CheckpointDetector` for its settings."""

    name = "DetectoRS"
    marks = ("roi_head.bbox_head.0.fc_cls.weight", "neck.rfp_weight.weight")
    multiple = 32

    @classmethod
    def build(cls, state: Mapping[str, Any]) -> nn.Module:
        """The network that a checkpoint is for."""
        return DetectoRSNetwork(cls.class_count(state))

    @classmethod
    def class_count(cls, state: Mapping[str, Any]) -> int:
        """Number of a checkpoint's classes."""
        return len(state[cls.marks[0]]) - 1

    @classmethod
    def own_parameters(cls, state: Mapping[str, Any]) -> dict[str, Any]:
        """Convolutions with the weights that they have after standardization (which nothing changes any more)."""
        parameters = {}
        for name, value in state.items():
            module, _, kind = name.rpartition(".")
            if kind in (_GAMMA, _BETA):
                continue
            gamma, beta = state.get(f"{module}.{_GAMMA}"), state.get(f"{module}.{_BETA}")
            standardized = kind == "weight" and gamma is not None and beta is not None
            parameters[name] = standardize(value, gamma, beta) if standardized else value
        return parameters

    def find(self, image: Tensor, width: int, height: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """At most 100 boxes after suppression by class; see `CheckpointDetector.find`."""
        scores, boxes = (values.cpu().numpy() for values in self.network(image, height, width))
        by_class = np.broadcast_to(boxes[:, None], (*scores.shape, 4))
        return select_detections(by_class, scores, self.score_threshold, IOU_THRESHOLD, soft=False)


def standardize(weight: Tensor, gamma: Tensor, beta: Tensor) -> Tensor:
    """A convolution's weight with mean ``beta`` and deviation ``gamma`` in every output channel (Qiao et al., 2019)."""
    flat = weight.double().flatten(1)
    mean, variance = flat.mean(dim=1, keepdim=True), flat.var(dim=1, keepdim=True)
    scaled = ((flat - mean) / (variance + 1e-5).sqrt()).reshape(weight.shape)
    return (scaled * gamma + beta).to(weight.dtype)

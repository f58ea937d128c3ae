"""MVX-Net (Sindagi et al., "MVX-Net: Multimodal VoxelNet for 3D Object Detection", ICRA 2019), PointFusion form.

Every point takes along what a ResNet-FPN says about its pixel; then it is SECOND. The form is OpenMMLab's
``mvxnet_fpn_dv_second_secfpn_8xb2-80e_kitti-3d-3class``, whose checkpoints load.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import Image
from lcf3d.detectors.downloads import local_path
from lcf3d.detectors.fusion.detector import Arrays, FusionDetector, filled
from lcf3d.detectors.fusion.images import image_of
from lcf3d.detectors.lidar.detector import to_arrays
from lcf3d.detectors.lidar.encoders import pillar_maximum
from lcf3d.detectors.lidar.heads import AnchorHead, AnchorMaps
from lcf3d.detectors.lidar.inputs import map_detections, network_points
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.presets import SECOND_KITTI
from lcf3d.detectors.lidar.sparse_encoders import SparseEncoder, sparse_shape
from lcf3d.detectors.lidar.suppression import NmsMode, suppression_threshold
from lcf3d.detectors.lidar.sweeps import in_view
from lcf3d.detectors.lidar.voxelization import decorate, voxelize
from lcf3d.detectors.lidar.voxels import voxel_backbone
from lcf3d.detectors.resizing import fitted_size, resize_bilinear
from lcf3d.frame import Frame
from lcf3d.networks.checkpoints import read_state_dict
from lcf3d.networks.convolution import ConvModule, FeaturePyramid
from lcf3d.networks.resnet import ResNet
from lcf3d.networks.torch import Tensor, functional, nn, torch
from lcf3d.structures import Camera, Detections3D

CONFIG = replace(
    SECOND_KITTI,
    name="mvxnet-kitti",
    architecture="mvxnet",
    # dynamic voxelization: no point and no voxel is left out
    voxels=replace(SECOND_KITTI.voxels, max_points=sys.maxsize, max_voxels=sys.maxsize),
)
IMAGE_SIZE = (1280, 384)
"""Longer and shorter side that an image is brought into, keeping its proportions, in pixels."""
MEAN_BGR = np.array([102.9801, 115.9465, 122.7717], np.float32)
"""Subtracted from the image's channels blue, green, red."""
IMAGE_CHANNELS = (256, 512, 1024, 2048)


class PointFusion(nn.Module):
    """What the image says about each point, added to what is known of the point (section III-C1)."""

    def __init__(self) -> None:
        super().__init__()
        self.lateral_convs = nn.ModuleList(
            [ConvModule(256, 128, 3, bias=True, norm=False, relu=False) for _ in range(5)]
        )
        self.img_transform = nn.Sequential(nn.Linear(5 * 128, 128), nn.BatchNorm1d(128, eps=1e-3))
        self.pts_transform = nn.Sequential(nn.Linear(64, 128), nn.BatchNorm1d(128, eps=1e-3))

    def forward(self, maps: Sequence[Tensor], pixels: Tensor, points: Tensor) -> Tensor:
        """(M, 128) fused features.

        Args:
            maps: the (1, 256, H, W) levels of the image's feature pyramid, finest first.
            pixels: (M, 2) where each point lies in the image, from -1 at its left and upper to 1 at its other border.
            points: (M, 64) features of the points.
        """
        sampled = [
            functional.grid_sample(conv(x), pixels[None, None], align_corners=False)[0, :, 0]
            for conv, x in zip(self.lateral_convs, maps, strict=True)
        ]
        return functional.relu(self.img_transform(torch.cat(sampled).t()) + self.pts_transform(points))


class FusedVoxelEncoder(nn.Module):
    """Two layers on points, each of which then sees its voxel's maximum; after the second the image joins."""

    def __init__(self, in_channels: int) -> None:
        super().__init__()
        self.vfe_layers = nn.ModuleList(
            [
                nn.Sequential(nn.Linear(before, 64, bias=False), nn.BatchNorm1d(64, eps=1e-3), nn.ReLU())
                for before in (in_channels, 128)
            ]
        )
        self.fusion_layer = PointFusion()

    def forward(self, features: Tensor, voxel: Tensor, voxels: int, maps: Sequence[Tensor], pixels: Tensor) -> Tensor:
        """(V, 128) voxel features.

        Args:
            features: (M, in) decorated points.
            voxel: (M,) int64 voxel of each.
            voxels: their number V.
            maps: of the image, see `PointFusion`.
            pixels: (M, 2), see `PointFusion`.
        """
        first, second = self.vfe_layers
        points = first(features)
        # everything has passed a ReLU, so that the maximum may start from zero
        pooled = pillar_maximum(points, voxel, points.new_zeros(voxels, 64))
        points = second(torch.cat([points, pooled[voxel]], dim=1))
        fused = self.fusion_layer(maps, pixels, points)
        return pillar_maximum(fused, voxel, fused.new_zeros(voxels, 128))


class MVXNetwork(nn.Module):
    """The whole network."""

    def __init__(self) -> None:
        super().__init__()
        assert CONFIG.anchors is not None
        self.img_backbone = ResNet(50, caffe=True)
        self.img_neck = FeaturePyramid(IMAGE_CHANNELS, norm=True, extra=True)
        self.voxel_encoder = FusedVoxelEncoder(len(CONFIG.channels) + 6)
        self.middle_encoder = SparseEncoder(128, sparse_shape(CONFIG.voxels))
        self.backbone = voxel_backbone()
        self.neck = SecondFPN((128, 256), (256, 256), (1, 2))
        self.bbox_head = AnchorHead(512, CONFIG.anchors, len(CONFIG.class_names))

    def forward(
        self, features: Tensor, voxel: Tensor, coordinates: Tensor, image: Tensor, pixels: Tensor
    ) -> AnchorMaps:
        """Output maps of the anchor head.

        Args:
            features: (M, 10) decorated points.
            voxel: (M,) int64 voxel of each.
            coordinates: (V, 3) int64 ``z, y, x`` of the voxels.
            image: (1, 3, H, W) normalized and padded.
            pixels: (M, 2), see `PointFusion`.
        """
        maps = self.img_neck(self.img_backbone(image))
        encoded = self.voxel_encoder(features, voxel, len(coordinates), maps, pixels)
        bev: Tensor = self.middle_encoder(encoded, coordinates)
        found: AnchorMaps = self.bbox_head(self.neck(self.backbone(bev)))
        return found


class MVXNet(FusionDetector):
    """MVX-Net on KITTI: points and the image of one camera, of which only what both see is looked at.

    Args:
        network: with its weights.
        class_names: classes of the detections; the network's own without it.
        nms: ``off`` (the paper's choice for a LiDAR branch), ``low`` or ``keep`` (the network's own suppression).
        score_threshold: boxes need a higher score; the network's own (0.1) without it.
        device: a torch device.
        camera: name of the camera.

    Raises:
        ConfigError: a setting makes no sense.
    """

    network_classes: ClassVar[tuple[str, ...]] = CONFIG.class_names

    def __init__(
        self,
        network: nn.Module,
        class_names: Sequence[str] | None = None,
        nms: NmsMode = "keep",
        score_threshold: float | None = None,
        device: str = "cpu",
        camera: str = "left",
    ) -> None:
        suppression_threshold(nms, 0.0)
        own = CONFIG.suppression.score_threshold
        super().__init__(network, class_names, own if score_threshold is None else score_threshold, device)
        self.nms: NmsMode = nms
        self.camera = camera

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], **options: Any) -> MVXNet:
        """The detector with the parameters of a checkpoint; options as of the class.

        Raises:
            DetectorError: names or shapes differ from the network's.
        """
        return cls(filled(MVXNetwork, state, CONFIG.name), **options)

    def inputs(self, frame: Frame, image_size: tuple[int, int] | None = IMAGE_SIZE) -> Arrays | None:
        """The network's input arrays by name, or None when no point lies in its range and in the image.

        Args:
            frame: the frame.
            image_size: see `IMAGE_SIZE`; None leaves the image as it is.

        Raises:
            ConfigError: the frame has no such camera.
            DatasetError: it has no image of it.
        """
        camera = frame.camera(self.camera)
        image = image_of(frame, camera)
        points = frame.points
        assert points is not None
        voxels = voxelize(network_points(in_view(points, camera), CONFIG), CONFIG.voxels)
        if not len(voxels):
            return None
        width, height = camera.width, camera.height
        if image_size is not None:
            width, height = fitted_size(width, height, image_size)
        prepared = prepare_image(image, width, height)
        return {
            "features": decorate(voxels, CONFIG.voxels, offsets_replace_position=False),
            "voxel": voxels.voxel_of_point,
            "coordinates": voxels.coordinates,
            "image": prepared,
            "pixels": relative_pixels(voxels.points, camera, (width, height), (prepared.shape[3], prepared.shape[2])),
        }

    def decode(self, maps: AnchorMaps) -> Detections3D:
        """Detections from the head's output maps."""
        return map_detections(to_arrays(maps), CONFIG, self.score_threshold, self.nms)


def prepare_image(image: Image, width: int, height: int) -> NDArray[np.float32]:
    """(1, 3, H, W) input of the network: resized, blue first, mean subtracted, zeros up to multiples of 32."""
    if image.shape[:2] != (height, width):
        image = resize_bilinear(image, width, height)
    prepared = np.zeros((1, 3, height + -height % 32, width + -width % 32), np.float32)
    prepared[0, :, :height, :width] = (image[..., ::-1] - MEAN_BGR).transpose(2, 0, 1)
    return prepared


def relative_pixels(
    points: NDArray[np.floating], camera: Camera, size: tuple[int, int], padded: tuple[int, int]
) -> NDArray[np.float32]:
    """(M, 2) where the camera sees each point, from -1 to 1 over the padded image.

    Args:
        points: (M, 3 or more), all in front of the camera.
        camera: that sees them.
        size: (width, height) that the image was resized to.
        padded: (width, height) of the network's input.
    """
    homogeneous = points[:, :3].astype(np.float64) @ camera.pixels_from_lidar[:, :3].T + camera.pixels_from_lidar[:, 3]
    scale = np.array(size) / (camera.width, camera.height)
    pixels = homogeneous[:, :2] / homogeneous[:, 2:] * scale
    return (2 * pixels / padded - 1).astype(np.float32)


def mvxnet(
    path: str,
    class_names: Sequence[str] | None = None,
    nms: NmsMode = "off",
    score_threshold: float | None = None,
    device: str = "cpu",
    camera: str = "left",
) -> MVXNet:
    """``mvxnet:CHECKPOINT``: MVX-Net from a file, or a published one by its name; settings as of `MVXNet`.

    Raises:
        DetectorError: the file cannot be read, or holds another network.
    """
    options = {"nms": nms, "score_threshold": score_threshold, "device": device, "camera": camera}
    return MVXNet.from_state_dict(read_state_dict(local_path(path, "lidar")), class_names=class_names, **options)

"""BEVFusion (Liu et al., ICRA 2023): cameras and LiDAR meet in one bird's-eye-view map.

The forms are OpenMMLab's ``bevfusion_lidar-cam_voxel0075_second_secfpn_8xb4-cyclic-20e_nus-3d`` and its LiDAR-only
sibling, whose checkpoints load. They live in the raw LIDAR_TOP frame of nuScenes, x right and y forward.
"""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from lcf3d.detectors.base import CloudRequest, Image
from lcf3d.detectors.downloads import local_path
from lcf3d.detectors.fusion import view_transform
from lcf3d.detectors.fusion.detector import Arrays, FusionDetector, filled
from lcf3d.detectors.fusion.images import image_of
from lcf3d.detectors.fusion.transfusion import TransFusionHead, decode_queries
from lcf3d.detectors.fusion.view_transform import IMAGE_SHAPE, DepthViewTransform
from lcf3d.detectors.lidar.config import CHANNELS, VoxelSpec
from lcf3d.detectors.lidar.frames import canonical_boxes, turned_points
from lcf3d.detectors.lidar.necks import SecondFPN
from lcf3d.detectors.lidar.sparse_encoders import SparseEncoder, sparse_shape
from lcf3d.detectors.lidar.sweeps import cloud_of
from lcf3d.detectors.lidar.voxelization import in_area, select_channels, voxelize
from lcf3d.detectors.lidar.voxels import voxel_backbone
from lcf3d.errors import DatasetError, DetectorError
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import canonical_from_mmdet3d
from lcf3d.networks.checkpoints import read_state_dict
from lcf3d.networks.convolution import ConvModule
from lcf3d.networks.swin import SwinTransformer
from lcf3d.networks.torch import Tensor, functional, nn, torch
from lcf3d.structures import Camera, Detections3D, FloatArray

CLASSES = (
    "car",
    "truck",
    "construction_vehicle",
    "bus",
    "trailer",
    "barrier",
    "motorcycle",
    "bicycle",
    "pedestrian",
    "traffic_cone",
)
VOXELS = VoxelSpec((0.075, 0.075, 0.2), (-54.0, -54.0, -5.0, 54.0, 54.0, 3.0), 10, 160000)
RAW_FROM_LIDAR: FloatArray = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)
"""(4, 4) the network's frame from the LiDAR frame."""
RESIZED_WIDTH = 768
"""Width that an image is brought to before the network's `IMAGE_SHAPE` is cut out of its lower middle, in pixels."""
MEAN = np.array([123.675, 116.28, 103.53], np.float32)
STD = np.array([58.395, 57.12, 57.375], np.float32)
"""Of the image's channels red, green, blue."""


class CameraNeck(nn.Module):
    """From coarse to fine: the coarser map, enlarged, is concatenated to the finer one and convolved twice."""

    def __init__(self, in_channels: Sequence[int] = (192, 384, 768), channels: int = 256) -> None:
        super().__init__()
        coarser = (*[channels] * (len(in_channels) - 2), in_channels[-1])
        inputs = [a + b for a, b in zip(in_channels, coarser, strict=False)]
        self.lateral_convs = nn.ModuleList([ConvModule(count, channels, 1, eps=1e-5) for count in inputs])
        self.fpn_convs = nn.ModuleList([ConvModule(channels, channels, 3, eps=1e-5) for _ in inputs])

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """One map fewer than came in, all of ``channels`` channels, finest first."""
        outputs: list[Tensor] = []
        coarse = maps[-1]
        for i in range(len(maps) - 2, -1, -1):
            enlarged = functional.interpolate(coarse, size=maps[i].shape[-2:], mode="bilinear", align_corners=False)
            coarse = self.fpn_convs[i](self.lateral_convs[i](torch.cat([maps[i], enlarged], dim=1)))
            outputs.insert(0, coarse)
        return outputs


class BEVFusionNetwork(nn.Module):
    """The whole network.

    Args:
        cameras: whether there is a camera branch.
    """

    def __init__(self, cameras: bool) -> None:
        super().__init__()
        self.middle_encoder = SparseEncoder(len(CHANNELS), sparse_shape(VOXELS), residual=True)
        self.backbone = voxel_backbone()
        self.neck = SecondFPN((128, 256), (256, 256), (1, 2), convolve_unscaled=True)
        self.bbox_head = TransFusionHead(512, len(CLASSES))
        if cameras:
            self.img_backbone = SwinTransformer(96, (2, 2, 6, 2), (3, 6, 12, 24), window=7, outputs=(1, 2, 3))
            self.img_neck = CameraNeck()
            self.view_transform = DepthViewTransform()
            lidar, camera = 256, view_transform.CHANNELS
            fuser = nn.Conv2d(camera + lidar, lidar, 3, padding=1, bias=False)
            self.fusion_layer = nn.Sequential(fuser, nn.BatchNorm2d(lidar), nn.ReLU())

    def forward(
        self,
        features: Tensor,
        coordinates: Tensor,
        images: Tensor | None = None,
        depths: Tensor | None = None,
        cells: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Values of the queries, see `TransFusionHead.predict`.

        Args:
            features: (V, 5) voxel means.
            coordinates: (V, 3) int64 ``z, y, x``.
            images: (N, 3, 256, 704) of N cameras; with a camera branch only, as the following.
            depths: (N, 1, 256, 704), see `view_transform.depth_map`.
            cells: (N, 118, 32, 88), see `view_transform.bev_cells`.
        """
        # the network's rows are x, its columns y
        bev = self.middle_encoder(features, coordinates).transpose(2, 3)
        if images is not None:
            seen = self.view_transform(self.img_neck(self.img_backbone(images))[0], depths, cells)
            bev = self.fusion_layer(torch.cat([seen, bev], dim=1))
        found: dict[str, Tensor] = self.bbox_head(self.neck(self.backbone(bev))[0])
        return found


class BEVFusion(FusionDetector):
    """BEVFusion on nuScenes: points and the images of any number of cameras, or points alone.

    A camera that a frame lacks adds nothing to the bird's-eye view; a frame without any image is refused by a network
    with a camera branch.

    Args:
        network: with its weights.
        class_names: classes of the detections; the network's own without it.
        score_threshold: boxes need a higher score. The network has neither a threshold nor a suppression of its own.
        device: a torch device.

    Raises:
        ConfigError: a setting makes no sense.
    """

    network_classes: ClassVar[tuple[str, ...]] = CLASSES
    cloud = CloudRequest(sweeps=9, remove_close=True, repeat_scan=True)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any], **options: Any) -> BEVFusion:
        """The detector with the parameters of a checkpoint, with or without cameras; options as of the class.

        Raises:
            DetectorError: names or shapes differ from the network's, or it was trained for another geometry.
        """
        cameras = any(name.startswith("view_transform.") for name in state)
        return cls(filled(lambda: BEVFusionNetwork(cameras), own_parameters(state), "BEVFusion"), **options)

    @property
    def uses_cameras(self) -> bool:
        """Whether the network has a camera branch."""
        return hasattr(self.network, "view_transform")

    def inputs(self, frame: Frame) -> Arrays | None:
        """The network's input arrays by name, or None when no point lies in its range.

        Raises:
            DatasetError: the network has a camera branch and the frame no image.
        """
        points = turned_points(select_channels(cloud_of(frame, self.cloud), CHANNELS), "lidar_top")
        points = in_area(points, VOXELS.area)
        voxels = voxelize(points, VOXELS)
        cameras = [camera for camera in frame.cameras if camera.name in frame.images]
        if self.uses_cameras and not cameras:
            raise DatasetError(
                f"frame {frame.id} has no image, and this BEVFusion looks at points and images; "
                "a checkpoint of the LiDAR-only form needs none"
            )
        if not len(voxels):
            return None
        inputs: Arrays = {"features": voxels.means(), "coordinates": voxels.coordinates}
        return {**inputs, **camera_inputs(frame, cameras, points)} if self.uses_cameras else inputs

    def decode(self, maps: Mapping[str, Tensor]) -> Detections3D:
        """Detections in the LiDAR frame from the values of the queries."""
        arrays = {name: value.cpu().numpy() for name, value in maps.items()}
        boxes, scores, labels = decode_queries(arrays, self.score_threshold)
        boxes = canonical_boxes(boxes, "lidar_top")
        return Detections3D(canonical_from_mmdet3d(boxes), scores, labels, CLASSES, boxes[:, 7:])


def camera_inputs(frame: Frame, cameras: Sequence[Camera], points: NDArray[np.float32]) -> Arrays:
    """Images, depths of points and cells of rays, see `BEVFusionNetwork`; ``points`` are in the network's frame."""
    prepared = [prepare_image(image_of(frame, camera)) for camera in cameras]
    resize = np.stack([placement for _, placement in prepared])
    lidar_from_raw = RAW_FROM_LIDAR.T
    from_raw = [(camera.pixels_from_lidar @ lidar_from_raw).astype(np.float32) for camera in cameras]
    raw_from_camera = np.stack([RAW_FROM_LIDAR @ np.linalg.inv(camera.camera_from_lidar) for camera in cameras])
    intrinsics = np.stack([camera.intrinsics for camera in cameras])
    # in single precision, as the network was trained
    rays = view_transform.ray_points(*(torch.from_numpy(a).float() for a in (intrinsics, raw_from_camera, resize)))
    return {
        "images": np.stack([image for image, _ in prepared]),
        "depths": np.stack([view_transform.depth_map(points, m, r) for m, r in zip(from_raw, resize, strict=True)]),
        "cells": view_transform.bev_cells(rays).numpy(),
    }


def prepare_image(image: Image) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(3, 256, 704) input of the network, and (3,) scale, first column and first row that it was cut with.

    The image is brought to `RESIZED_WIDTH`, keeping its proportions, and cut at the top and evenly at the sides; an
    image too flat for that gets black rows at the top.
    """
    height, width = image.shape[:2]
    scale = RESIZED_WIDTH / width
    size = (RESIZED_WIDTH, int(height * scale))
    left, top = (RESIZED_WIDTH - IMAGE_SHAPE[1]) // 2, size[1] - IMAGE_SHAPE[0]
    resized = PIL.Image.fromarray(image).resize(size).crop((left, top, left + IMAGE_SHAPE[1], top + IMAGE_SHAPE[0]))
    normalized = (np.asarray(resized, np.float32) - MEAN) / STD
    return np.ascontiguousarray(normalized.transpose(2, 0, 1)), np.array([scale, left, top], np.float32)


def own_parameters(state: Mapping[str, Any]) -> dict[str, Any]:
    """A checkpoint's parameters without its constants, and with kernels in our order of axes, height first.

    Raises:
        DetectorError: a constant says that the network was trained for another geometry.
    """
    expected = {f"view_transform.{name}": value for name, value in view_transform.constants().items()}
    parameters = {}
    for name, value in state.items():
        if name in expected:
            if value.shape != expected[name].shape or not torch.allclose(value.float(), expected[name].float()):
                raise DetectorError(
                    f"the checkpoint's {name} is not that of the published BEVFusion (images of 256 x 704, cells of "
                    "0.3 m up to 54 m): it was trained for another geometry"
                )
        elif not name.endswith("relative_position_index"):
            parameters[name] = _height_first(value) if value.ndim == 5 else value
    return parameters


def _height_first(weight: Tensor) -> Tensor:
    """A kernel over x, y, z as one over z, y, x, with its channels last or (spconv 2) outside."""
    return weight.permute((2, 1, 0, 3, 4) if weight.shape[0] <= 3 else (0, 3, 2, 1, 4)).contiguous()


def bevfusion(
    path: str, class_names: Sequence[str] | None = None, score_threshold: float = 0.0, device: str = "cpu"
) -> BEVFusion:
    """``bevfusion:CHECKPOINT``: BEVFusion, with or without cameras, from a file or a published one by its name.

    Raises:
        DetectorError: the file cannot be read, or holds another network.
    """
    options = {"class_names": class_names, "score_threshold": score_threshold, "device": device}
    return BEVFusion.from_state_dict(read_state_dict(local_path(path, "lidar")), **options)

"""Configurations of the published networks: facts of the OpenMMLab 1.4.0 configuration files of the same names."""

from __future__ import annotations

import math
from dataclasses import replace

from lcf3d.detectors.base import CloudRequest
from lcf3d.detectors.lidar.config import AnchorLevel, AnchorSpec, CenterSpec, LidarConfig, Suppression, VoxelSpec

_KITTI_CLASSES = ("Pedestrian", "Cyclist", "Car")
_KITTI_LEVEL = AnchorLevel(((0.8, 0.6, 1.73), (1.76, 0.6, 1.73), (3.9, 1.6, 1.56)), (-0.6, -0.6, -1.78))
_KITTI_CHANNELS = ("x", "y", "z", "intensity")
_KITTI_VOXELS = VoxelSpec((0.05, 0.05, 0.1), (0.0, -40.0, -3.0, 70.4, 40.0, 1.0), 5, 40000)
_KITTI_SUPPRESSION = Suppression(0.1, 0.01, 100, 50)
_KITTI_ANCHORS = AnchorSpec((_KITTI_LEVEL,), (0.0, -40.0, 70.4, 40.0), aligned=False, direction_offset=-math.pi / 2)
_KITTI_PROPOSALS = Suppression(0.0, 0.7, 1024, 100)
# both frameworks train on the part of the scan in the left colour camera's image
_KITTI_CLOUD = CloudRequest(view="left")
# the OpenMMLab nuScenes pipelines: of the anchor-based networks every point of ten sweeps; of CenterPoint nine sweeps
# without the vehicle's own points, and the scan itself in the place of sweeps that are not there
_NUSCENES_CLOUD = CloudRequest(sweeps=10)
_CENTERPOINT_CLOUD = CloudRequest(sweeps=9, remove_close=True, repeat_scan=True)
# the OpenMMLab nuScenes pipeline of the anchor-based networks drops the intensity and keeps the time lag
_NUSCENES_CHANNELS = ("x", "y", "z", "time")
_NUSCENES_SUPPRESSION = Suppression(0.05, 0.2, 1000, 500)


def _nuscenes_voxels(max_points: int) -> VoxelSpec:
    return VoxelSpec((0.25, 0.25, 8.0), (-50.0, -50.0, -5.0, 50.0, 50.0, 3.0), max_points, 40000)


def _scaled(sizes: tuple[tuple[float, float, float], ...], scale: float) -> AnchorLevel:
    scaled = tuple((length * scale, width * scale, height * scale) for length, width, height in sizes)
    return AnchorLevel(scaled, (-1.8,) * len(sizes))


POINTPILLARS_KITTI = LidarConfig(
    name="pointpillars-kitti",
    architecture="pointpillars",
    class_names=_KITTI_CLASSES,
    channels=_KITTI_CHANNELS,
    voxels=VoxelSpec((0.16, 0.16, 4.0), (0.0, -39.68, -3.0, 69.12, 39.68, 1.0), 32, 40000),
    suppression=_KITTI_SUPPRESSION,
    anchors=AnchorSpec((_KITTI_LEVEL,), (0.0, -39.68, 69.12, 39.68), aligned=True, direction_offset=-math.pi / 2),
    variant="secfpn",
    offsets_replace_position=True,
    cloud=_KITTI_CLOUD,
)

_FPN_SIZES = ((2.5981, 0.8660, 1.0), (1.7321, 0.5774, 1.0), (1.0, 1.0, 1.0), (0.4, 0.4, 1.0))
POINTPILLARS_NUSCENES = LidarConfig(
    name="pointpillars-nuscenes",
    architecture="pointpillars",
    class_names=(
        "car",
        "truck",
        "trailer",
        "bus",
        "construction_vehicle",
        "bicycle",
        "motorcycle",
        "pedestrian",
        "traffic_cone",
        "barrier",
    ),
    channels=_NUSCENES_CHANNELS,
    voxels=_nuscenes_voxels(64),
    suppression=_NUSCENES_SUPPRESSION,
    anchors=AnchorSpec(
        tuple(_scaled(_FPN_SIZES, scale) for scale in (1, 2, 4)),
        (-50.0, -50.0, 50.0, 50.0),
        aligned=True,
        direction_offset=-0.7854,
        code_size=9,
    ),
    variant="fpn",
    frame="lidar_top",
    cloud=_NUSCENES_CLOUD,
)

# class, (length, width, height), z of the bottom face: shape-aware groups of SSN (section 3.2 of its paper)
_SSN_GROUPS = (
    (
        ("bicycle", (1.68452161, 0.60058911, 1.27192197), -1.67339111),
        ("motorcycle", (2.09973778, 0.76279481, 1.44403034), -1.71396371),
    ),
    (("pedestrian", (0.72564370, 0.66344886, 1.75748069), -1.61785072),),
    (
        ("traffic_cone", (0.40359262, 0.39694519, 1.06232151), -1.80984986),
        ("barrier", (0.48578221, 2.49008838, 0.98297065), -1.76396500),
    ),
    (("car", (4.60718145, 1.95017717, 1.72270761), -1.80032795),),
    (
        ("truck", (6.73778078, 2.45609390, 2.73004906), -1.74440365),
        ("trailer", (12.01320693, 2.87427237, 3.81509561), -1.68526504),
        ("bus", (11.1885991, 2.94046906, 3.47030982), -1.80673031),
        ("construction_vehicle", (6.38352896, 2.73050468, 3.13312415), -1.64824291),
    ),
)
SSN_NUSCENES = LidarConfig(
    name="ssn-nuscenes",
    architecture="ssn",
    class_names=tuple(name for group in _SSN_GROUPS for name, _, _ in group),
    channels=_NUSCENES_CHANNELS,
    voxels=_nuscenes_voxels(20),
    suppression=_NUSCENES_SUPPRESSION,
    anchors=AnchorSpec(
        tuple(AnchorLevel(tuple(a[1] for a in group), tuple(a[2] for a in group)) for group in _SSN_GROUPS),
        (-50.0, -50.0, 50.0, 50.0),
        aligned=True,
        direction_offset=-0.7854,
        code_size=9,
        joint=True,
    ),
    variant="secfpn",
    frame="lidar_top",
    cloud=_NUSCENES_CLOUD,
)
SSN_REGNET_NUSCENES = replace(SSN_NUSCENES, name="ssn-regnet-nuscenes", variant="regnet")

_CENTER_TASKS = (
    ("car",),
    ("truck", "construction_vehicle"),
    ("bus", "trailer"),
    ("barrier",),
    ("motorcycle", "bicycle"),
    ("pedestrian", "traffic_cone"),
)
_CENTER_AREA = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)
CENTERPOINT_PILLAR_NUSCENES = LidarConfig(
    name="centerpoint-pillar02-nuscenes",
    architecture="centerpoint",
    class_names=tuple(name for task in _CENTER_TASKS for name in task),
    channels=("x", "y", "z", "intensity", "time"),
    voxels=VoxelSpec((0.2, 0.2, 8.0), _CENTER_AREA, 20, 40000),
    suppression=Suppression(0.1, 0.2, 1000, 498),
    centers=CenterSpec(_CENTER_TASKS, stride=4),
    variant="pillar",
    frame="lidar_top",
    cloud=_CENTERPOINT_CLOUD,
)
CENTERPOINT_VOXEL_NUSCENES = replace(
    CENTERPOINT_PILLAR_NUSCENES,
    name="centerpoint-voxel01-nuscenes",
    voxels=VoxelSpec((0.1, 0.1, 0.2), _CENTER_AREA, 10, 120000),
    centers=CenterSpec(_CENTER_TASKS, stride=8),
    variant="voxel",
)

SECOND_KITTI = LidarConfig(
    name="second-kitti",
    architecture="second",
    class_names=_KITTI_CLASSES,
    channels=_KITTI_CHANNELS,
    voxels=_KITTI_VOXELS,
    suppression=_KITTI_SUPPRESSION,
    anchors=_KITTI_ANCHORS,
    cloud=_KITTI_CLOUD,
)
PART_A2_KITTI = replace(
    SECOND_KITTI,
    name="part-a2-kitti",
    architecture="part-a2",
    suppression=Suppression(0.1, 0.01, 100, 100),
    proposals=_KITTI_PROPOSALS,
)
PV_RCNN_KITTI = replace(
    SECOND_KITTI,
    name="pv-rcnn-kitti",
    architecture="pv-rcnn",
    suppression=Suppression(0.1, 0.1, 100, 100),
    anchors=replace(_KITTI_ANCHORS, direction_offset=0.78539),
    proposals=_KITTI_PROPOSALS,
)


def car_only(config: LidarConfig) -> LidarConfig:
    """The published one-class form of a KITTI configuration."""
    assert config.anchors is not None
    level = AnchorLevel(_KITTI_LEVEL.sizes[2:], _KITTI_LEVEL.bottoms[2:])
    return replace(
        config,
        name=f"{config.name}-car",
        class_names=("Car",),
        anchors=replace(config.anchors, levels=(level,)),
    )


def openpcdet(config: LidarConfig) -> LidarConfig:
    """The form of OpenPCDet 0.6 of a KITTI configuration.

    Another class order, anchors on the border, raw positions; one class a box, and suppression over all classes; the
    raw points of PV-RCNN are cut along x and y only.
    """
    assert config.anchors is not None
    order = (2, 0, 1)
    level = AnchorLevel(tuple(_KITTI_LEVEL.sizes[i] for i in order), tuple(_KITTI_LEVEL.bottoms[i] for i in order))
    rule = config.suppression if config.proposals else Suppression(0.1, 0.01, 4096, 500, over_classes=True)
    return replace(
        config,
        name=f"{config.name}-openpcdet",
        class_names=tuple(_KITTI_CLASSES[i] for i in order),
        anchors=replace(config.anchors, levels=(level,), aligned=False, direction_offset=0.78539),
        suppression=rule,
        offsets_replace_position=False,
        tall=config.proposals is not None,
    )


# not among `PRESETS`, which are the networks with published checkpoints
COMPACT_KITTI = LidarConfig(
    name="compact-kitti",
    architecture="compact-pillars",
    class_names=("Car", "Pedestrian", "Cyclist"),
    channels=_KITTI_CHANNELS,
    voxels=VoxelSpec((0.32, 0.32, 4.0), (0.0, -39.68, -3.0, 69.12, 39.68, 1.0), 0, 0),
    suppression=Suppression(0.1, 0.2, 250, 250),
    centers=CenterSpec(
        (("Car", "Pedestrian", "Cyclist"),),
        stride=2,
        limits=(0.0, -39.68, -3.0, 69.12, 39.68, 1.0),
        max_per_task=100,
        max_candidates=250,
        velocity=False,
        axis=True,
    ),
    encoding="statistics",
    ground="level",
    upright=("Pedestrian", "Cyclist"),
)


def painted_config(painter: str, only_painted: bool = False) -> LidarConfig:
    """The compact network on points that carry class scores.

    Args:
        painter: what paints them.
        only_painted: whether points without any score are left out.
    """
    classes = COMPACT_KITTI.class_names
    kind = "frustum" if only_painted else "painted"
    return replace(
        COMPACT_KITTI, name=f"compact-kitti-{kind}", painted=classes, painter=painter, only_painted=only_painted
    )


PRESETS: dict[str, LidarConfig] = {
    config.name: config
    for config in (
        POINTPILLARS_KITTI,
        car_only(POINTPILLARS_KITTI),
        POINTPILLARS_NUSCENES,
        SECOND_KITTI,
        car_only(SECOND_KITTI),
        SSN_NUSCENES,
        SSN_REGNET_NUSCENES,
        CENTERPOINT_PILLAR_NUSCENES,
        CENTERPOINT_VOXEL_NUSCENES,
        PART_A2_KITTI,
        car_only(PART_A2_KITTI),
        PV_RCNN_KITTI,
        openpcdet(POINTPILLARS_KITTI),
        openpcdet(SECOND_KITTI),
        openpcdet(PV_RCNN_KITTI),
    )
}
"""Every configuration by name."""

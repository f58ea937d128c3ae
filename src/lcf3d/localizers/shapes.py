"""Sizes of the classes, the only thing that the geometric localizer knows beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from lcf3d.errors import ConfigError


@dataclass(frozen=True)
class ObjectShape:
    """What objects of a class look like to a LiDAR.

    Attributes:
        length: mean length in metres.
        width: mean width in metres.
        height: mean height in metres.
        length_deviation: standard deviation of the length in metres, and likewise the other two.
        width_deviation: see ``length_deviation``.
        height_deviation: see ``length_deviation``.
        solid: whether beams stop at the box's sides (vehicles), or hit things all through it (persons, bicycles).
        edge_deviation: how far, as a share of its width, the left and right edge of a 2D box lie from the projection
            of the 3D box. Boxes of persons are drawn around the body, their 3D boxes are wider.

    Raises:
        ConfigError: a size or deviation is not positive.
    """

    length: float
    width: float
    height: float
    length_deviation: float
    width_deviation: float
    height_deviation: float
    solid: bool = True
    edge_deviation: float = 0.05

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "solid" and not 0 < value < float("inf"):
                raise ConfigError(f"ObjectShape.{name} must be a positive number, got {value}")


# KITTI: mean sizes of the training set as published with Frustum PointNets (Qi et al. 2018), rounded to 1 cm.
# nuScenes: the anchor sizes used by detectors on it (CBGS, Zhu et al. 2019). The two data sets were annotated in
# different countries and by different rules, so "Car" and "car" differ. Deviations: rounded from KITTI's training
# labels; for classes that only nuScenes has, a tenth to a quarter of the size. Argoverse 2: as nuScenes where it has
# the same kind of object, else what such things commonly measure.
SHAPES: Mapping[str, ObjectShape] = MappingProxyType(
    {
        "Car": ObjectShape(3.88, 1.63, 1.53, 0.44, 0.11, 0.14),
        "Van": ObjectShape(5.06, 1.90, 2.21, 0.85, 0.18, 0.32),
        "Truck": ObjectShape(10.14, 2.59, 3.25, 2.2, 0.23, 0.36),
        "Tram": ObjectShape(16.17, 2.53, 3.53, 4.5, 0.13, 0.13),
        "Pedestrian": ObjectShape(0.84, 0.66, 1.76, 0.25, 0.12, 0.13, solid=False, edge_deviation=0.2),
        "Person_sitting": ObjectShape(0.80, 0.60, 1.27, 0.27, 0.1, 0.08, solid=False, edge_deviation=0.2),
        "Cyclist": ObjectShape(1.76, 0.60, 1.74, 0.15, 0.14, 0.1, solid=False, edge_deviation=0.12),
        "car": ObjectShape(4.63, 1.97, 1.74, 0.46, 0.17, 0.2),
        "truck": ObjectShape(6.93, 2.51, 2.84, 1.7, 0.35, 0.6),
        "bus": ObjectShape(10.5, 2.94, 3.47, 1.5, 0.3, 0.4),
        "trailer": ObjectShape(12.29, 2.90, 3.87, 2.0, 0.4, 0.6),
        "construction_vehicle": ObjectShape(6.37, 2.85, 3.19, 1.6, 0.7, 0.7),
        "pedestrian": ObjectShape(0.73, 0.67, 1.77, 0.2, 0.13, 0.17, solid=False, edge_deviation=0.2),
        "motorcycle": ObjectShape(2.11, 0.77, 1.47, 0.3, 0.15, 0.2, solid=False, edge_deviation=0.12),
        "bicycle": ObjectShape(1.70, 0.60, 1.28, 0.2, 0.15, 0.25, solid=False, edge_deviation=0.12),
        "traffic_cone": ObjectShape(0.41, 0.41, 1.07, 0.1, 0.1, 0.25, solid=False, edge_deviation=0.1),
        "barrier": ObjectShape(0.50, 2.53, 0.98, 0.15, 0.6, 0.15),
        "REGULAR_VEHICLE": ObjectShape(4.63, 1.97, 1.74, 0.46, 0.17, 0.2),
        "LARGE_VEHICLE": ObjectShape(7.5, 2.6, 2.9, 2.0, 0.4, 0.6),
        "BUS": ObjectShape(10.5, 2.94, 3.47, 1.5, 0.3, 0.4),
        "SCHOOL_BUS": ObjectShape(10.5, 2.7, 3.2, 1.5, 0.3, 0.3),
        "ARTICULATED_BUS": ObjectShape(18.0, 2.94, 3.4, 1.5, 0.3, 0.3),
        "BOX_TRUCK": ObjectShape(7.5, 2.6, 3.2, 1.7, 0.35, 0.4),
        "TRUCK": ObjectShape(6.93, 2.51, 2.84, 1.7, 0.35, 0.6),
        "TRUCK_CAB": ObjectShape(6.5, 2.6, 3.2, 1.2, 0.3, 0.5),
        "VEHICULAR_TRAILER": ObjectShape(9.0, 2.6, 3.0, 3.5, 0.4, 0.9),
        "MESSAGE_BOARD_TRAILER": ObjectShape(2.5, 1.8, 2.5, 0.8, 0.4, 0.7),
        "PEDESTRIAN": ObjectShape(0.73, 0.67, 1.77, 0.2, 0.13, 0.17, solid=False, edge_deviation=0.2),
        "WHEELCHAIR": ObjectShape(1.1, 0.75, 1.35, 0.2, 0.12, 0.15, solid=False, edge_deviation=0.2),
        "STROLLER": ObjectShape(0.95, 0.65, 1.05, 0.2, 0.12, 0.15, solid=False, edge_deviation=0.2),
        "DOG": ObjectShape(0.95, 0.4, 0.7, 0.25, 0.12, 0.18, solid=False, edge_deviation=0.2),
        "BICYCLE": ObjectShape(1.70, 0.60, 1.28, 0.2, 0.15, 0.25, solid=False, edge_deviation=0.12),
        "BICYCLIST": ObjectShape(1.1, 0.7, 1.7, 0.3, 0.13, 0.17, solid=False, edge_deviation=0.2),
        "MOTORCYCLE": ObjectShape(2.11, 0.77, 1.47, 0.3, 0.15, 0.2, solid=False, edge_deviation=0.12),
        "MOTORCYCLIST": ObjectShape(1.1, 0.75, 1.6, 0.3, 0.13, 0.17, solid=False, edge_deviation=0.2),
        "WHEELED_DEVICE": ObjectShape(1.2, 0.55, 1.2, 0.3, 0.13, 0.25, solid=False, edge_deviation=0.15),
        "WHEELED_RIDER": ObjectShape(0.8, 0.7, 1.75, 0.25, 0.13, 0.17, solid=False, edge_deviation=0.2),
        "BOLLARD": ObjectShape(0.25, 0.25, 1.0, 0.1, 0.1, 0.2, solid=False, edge_deviation=0.1),
        "CONSTRUCTION_CONE": ObjectShape(0.41, 0.41, 0.85, 0.1, 0.1, 0.2, solid=False, edge_deviation=0.1),
        "CONSTRUCTION_BARREL": ObjectShape(0.65, 0.65, 1.0, 0.12, 0.12, 0.15, solid=False, edge_deviation=0.1),
    }
)

"""Roles of classes: what a class name means for the fusion, whatever the dataset calls it.

Names are those of COCO, KITTI, nuScenes, Argoverse 2 and Waymo; they are compared without case, spaces, dots, dashes
and underscores.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

Role = Literal["vehicle", "pedestrian", "rider", "other"]
ROLES: tuple[Role, ...] = ("vehicle", "pedestrian", "rider", "other")

_NAMES: dict[Role, str] = {
    "vehicle": """
        car van truck bus tram train trailer vehicle bus.bendy bus.rigid bendy_bus rigid_bus construction_vehicle
        regular_vehicle large_vehicle box_truck truck_cab school_bus articulated_bus message_board_trailer
        vehicular_trailer traffic_light_trailer railed_vehicle vehicle.car vehicle.truck vehicle.trailer
        vehicle.construction vehicle.bus.bendy vehicle.bus.rigid vehicle.emergency.ambulance vehicle.emergency.police
        type_vehicle boat airplane aeroplane
    """,
    "pedestrian": """
        pedestrian person person_sitting people adult child human.pedestrian.adult human.pedestrian.child
        human.pedestrian.construction_worker human.pedestrian.police_officer human.pedestrian.wheelchair
        human.pedestrian.stroller human.pedestrian.personal_mobility official_signaler stroller wheelchair
        type_pedestrian dog animal cat horse sheep cow
    """,
    "rider": """
        cyclist rider bicycle motorcycle motorbike bicyclist motorcyclist wheeled_rider wheeled_device bike scooter
        vehicle.bicycle vehicle.motorcycle type_cyclist
    """,
    "other": """
        misc dontcare barrier traffic_cone cone sign stop_sign bollard construction_cone construction_barrel
        mobile_pedestrian_crossing_sign mobile_pedestrian_sign traffic_light fire_hydrant parking_meter bench
        movable_object.barrier movable_object.trafficcone movable_object.debris movable_object.pushable_pullable
        static_object.bicycle_rack type_sign other
    """,
}


def _plain(name: str) -> str:
    return "".join(character for character in name.lower() if character.isalnum())


_ROLE_OF: dict[str, Role] = {_plain(name): role for role, names in _NAMES.items() for name in names.split()}


def role_of(class_name: str) -> Role:
    """The role of a class; ``other`` for names that are not known."""
    return _ROLE_OF.get(_plain(class_name), "other")


def unknown_classes(class_names: Sequence[str]) -> list[str]:
    """The names whose role is not known, so that they are treated as ``other``."""
    return [name for name in class_names if _plain(name) not in _ROLE_OF]

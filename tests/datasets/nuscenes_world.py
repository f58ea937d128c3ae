"""A tiny nuScenes folder whose geometry is known by hand.

One scene, three samples half a second apart. The vehicle drives along global x at 10 m/s, level, from (100, 50, 0).
LIDAR_TOP sits 2 m above its origin, turned so that canonical LiDAR axes are the vehicle's. CAM_FRONT looks forward
from the same place and fires 40 ms before the LiDAR; 50 ms before the second sample there is a sweep.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

SPEED = 10.0
LIDAR_ROTATION = [np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]
CAMERA_ROTATION = [0.5, -0.5, 0.5, -0.5]
START_US = 1_500_000_000_000_000
SAMPLES = ("s0", "s1", "s2")

Tables = dict[str, list[dict[str, Any]]]


def annotation(token: str, sample: int, instance: str, position: list[float], **changes: Any) -> dict[str, Any]:
    """A record of sample_annotation: a car-sized box heading along global y."""
    return {
        "token": token,
        "sample_token": SAMPLES[sample],
        "instance_token": instance,
        "attribute_tokens": [],
        "translation": position,
        "size": [2.0, 4.0, 1.5],
        "rotation": [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)],
        "prev": "",
        "next": "",
        "num_lidar_pts": 3,
        "num_radar_pts": 1,
        **changes,
    }


def world_tables() -> Tables:
    """The tables by name, to be changed at will before `write_world`."""
    tables: Tables = {
        "sensor": [
            {"token": "lidar", "channel": "LIDAR_TOP"},
            {"token": "front", "channel": "CAM_FRONT"},
            {"token": "radar", "channel": "RADAR_FRONT"},
        ],
        "calibrated_sensor": [
            _calibration("c-lidar", "lidar", LIDAR_ROTATION, []),
            _calibration("c-front", "front", CAMERA_ROTATION, [[1000.0, 0, 800], [0, 1000, 450], [0, 0, 1]]),
            _calibration("c-radar", "radar", [1.0, 0, 0, 0], []),
        ],
        "scene": [{"token": "scene", "name": "scene-0103"}],
        "sample": [
            {"token": token, "timestamp": START_US + 500_000 * i, "scene_token": "scene"}
            for i, token in enumerate(SAMPLES)
        ],
        "sample_data": [],
        "ego_pose": [],
        "category": [
            {"token": name, "name": name}
            for name in (
                "vehicle.car",
                "human.pedestrian.adult",
                "vehicle.bicycle",
                "static_object.bicycle_rack",
                "animal",
            )
        ],
        "attribute": [{"token": "a-moving", "name": "vehicle.moving"}],
        "instance": [
            {"token": "i-car", "category_token": "vehicle.car"},
            {"token": "i-walker", "category_token": "human.pedestrian.adult"},
            {"token": "i-bicycle", "category_token": "vehicle.bicycle"},
            {"token": "i-rack", "category_token": "static_object.bicycle_rack"},
            {"token": "i-dog", "category_token": "animal"},
        ],
    }
    previous = ""
    for name, seconds, sample in (("L0", 0.0, 0), ("sweep", 0.45, 1), ("L1", 0.5, 1), ("L2", 1.0, 2)):
        _record(tables, name, "c-lidar", seconds, sample, name != "sweep", previous)
        previous = name
    for i in range(3):
        _record(tables, f"C{i}", "c-front", 0.5 * i - 0.04, i, True, "")
        _record(tables, f"R{i}", "c-radar", 0.5 * i, i, True, "")
    # the car moves 1.5 m along x and 2 m along y from sample to sample: 3 and 4 m/s
    tables["sample_annotation"] = [
        annotation("car0", 0, "i-car", [120.0, 50.0, 1.0], next="car1", attribute_tokens=["a-moving"]),
        annotation("car1", 1, "i-car", [121.5, 52.0, 1.0], prev="car0", next="car2"),
        annotation("car2", 2, "i-car", [123.0, 54.0, 1.0], prev="car1"),
        annotation("walker", 0, "i-walker", [110.0, 55.0, 1.0], size=[0.5, 0.5, 1.8]),
        annotation("unseen", 1, "i-walker", [110.0, 55.0, 1.0], num_lidar_pts=0, num_radar_pts=0),
        annotation("bicycle", 0, "i-bicycle", [105.0, 40.0, 1.0], size=[0.5, 2.0, 1.2]),
        annotation("rack", 0, "i-rack", [105.5, 40.0, 1.0], size=[2.0, 6.0, 1.5]),
        annotation("dog", 0, "i-dog", [101.0, 60.0, 1.0]),
    ]
    return tables


def write_world(root: Path, tables: Tables | None = None, points: bool = False) -> Path:
    """Write the tables to ``root/v1.0-mini``, and raw scans of one point each if ``points``; gives ``root``."""
    folder = root / "v1.0-mini"
    folder.mkdir(parents=True, exist_ok=True)
    for name, records in (tables or world_tables()).items():
        (folder / f"{name}.json").write_text(json.dumps(records))
    if points:
        for record in (tables or world_tables())["sample_data"]:
            if record["calibrated_sensor_token"] == "c-lidar":
                path = root / record["filename"]
                path.parent.mkdir(parents=True, exist_ok=True)
                # one point 7 m ahead and 2 m to the left (raw: x right, y forward), and one on the vehicle's own roof
                np.array([[-2, 7, 0.5, 100, 0], [0.5, 0.2, 0, 50, 3]], dtype="<f4").tofile(path)
    return root


def _calibration(token: str, sensor: str, rotation: list[float], intrinsic: list[Any]) -> dict[str, Any]:
    return {
        "token": token,
        "sensor_token": sensor,
        "translation": [0.0, 0.0, 2.0],
        "rotation": rotation,
        "camera_intrinsic": intrinsic,
    }


def _record(
    tables: Tables, token: str, calibration: str, seconds: float, sample: int, key: bool, previous: str
) -> None:
    camera = calibration == "c-front"
    tables["sample_data"].append(
        {
            "token": token,
            "sample_token": SAMPLES[sample],
            "ego_pose_token": f"p-{token}",
            "calibrated_sensor_token": calibration,
            "timestamp": START_US + round(seconds * 1e6),
            "is_key_frame": key,
            "height": 900 if camera else 0,
            "width": 1600 if camera else 0,
            "filename": f"samples/{token}.{'jpg' if camera else 'pcd.bin'}",
            "prev": previous,
        }
    )
    position = [100.0 + SPEED * seconds, 50.0, 0.0]
    tables["ego_pose"].append({"token": f"p-{token}", "rotation": [1.0, 0.0, 0.0, 0.0], "translation": position})

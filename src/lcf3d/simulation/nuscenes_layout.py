"""Simulated drives as files and tables in the nuScenes layout (devkit schema 1.0)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from lcf3d.files import atomic_path, read_json, write_json, write_text
from lcf3d.geometry.rotation import quaternions_from_matrices, quaternions_from_yaws
from lcf3d.simulation.actors import NUSCENES_CLASS
from lcf3d.simulation.frames import SimulatedFrame, attribute, capture, sensor_pose
from lcf3d.simulation.kitti_layout import split_groups, write_bytes, write_png
from lcf3d.simulation.presets import (
    NUSCENES_CAMERAS,
    ego_from_nuscenes_camera,
    ego_from_nuscenes_lidar,
    nuscenes_lidar_from_forward,
)
from lcf3d.structures import FloatArray

VERSION: Final = "v1.0-simulated"
START_US: Final = 1_600_000_000_000_000
"""Time of the first frame in microseconds; drives are 100 s apart."""
CATEGORIES: Final = {
    "car": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "trailer": "vehicle.trailer",
    "construction_vehicle": "vehicle.construction",
    "pedestrian": "human.pedestrian.adult",
    "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle",
    "traffic_cone": "movable_object.trafficcone",
    "barrier": "movable_object.barrier",
}
ATTRIBUTES: Final = (
    "vehicle.moving",
    "vehicle.stopped",
    "vehicle.parked",
    "cycle.with_rider",
    "cycle.without_rider",
    "pedestrian.moving",
    "pedestrian.standing",
    "pedestrian.sitting_lying_down",
)
VISIBILITY_LIMITS: Final = (0.4, 0.6, 0.8)
_ORIGIN: Final = np.array([600.0, 1600.0, 0.0])
_MAX_DISTANCE_M = 90.0


def token(*parts: object) -> str:
    """The 32-digit token of a thing, the same in every run."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def _part_path(root: Path, id: str) -> Path:
    return root / "parts" / f"{id}.json"


def is_complete(root: Path, id: str) -> bool:
    """Whether a sample has been written: its part of the tables comes last."""
    return _part_path(root, id).exists()


def write_frame(root: Path, id: str, simulated: SimulatedFrame) -> None:
    """Write the sensor files of a sample, with the sweeps before it, and, last, what the tables will say of it."""
    drive, number = (int(v) for v in id.split("_"))
    timestamp = START_US + drive * 100_000_000 + round(simulated.time * 1e6)
    files = {"LIDAR_TOP": f"samples/LIDAR_TOP/simulated-{drive:04d}__LIDAR_TOP__{timestamp}.pcd.bin"}
    write_bytes(root / files["LIDAR_TOP"], _raw_points(simulated))
    preset, scene = simulated.preset, simulated.scene
    own: dict[str, dict[str, Any]] = {}
    for k, camera in enumerate(preset.cameras):
        fired = timestamp + round(preset.delay(k) * 1e6)
        if preset.camera_delays_s:
            pose = sensor_pose(scene, preset, simulated.time + preset.delay(k))
            own[camera.name] = {"timestamp": fired, "pose": _ego_pose(pose)}
        name = f"samples/{camera.name}/simulated-{drive:04d}__{camera.name}__{fired}.jpg"
        _write_jpeg(root / name, simulated.renders[camera.name].image)
        files[camera.name] = name
    part = {
        "drive": drive,
        "number": number,
        "timestamp": timestamp,
        "street": simulated.scene.site.street.name,
        "files": files,
        "pose": _ego_pose(simulated.world_from_lidar),
        "own": own,
        "sweeps": _write_sweeps(root, drive, number, simulated),
        "sizes": {c.name: [c.width, c.height] for c in simulated.preset.cameras},
        "intrinsics": {c.name: c.intrinsics.tolist() for c in simulated.preset.cameras},
        "objects": _objects(simulated),
    }
    write_json(_part_path(root, id), part, indent=None)


def _ego_pose(world_from_lidar: FloatArray) -> dict[str, list[float]]:
    """Translation and rotation of the car, from the (4, 4) pose of its LiDAR."""
    pose = world_from_lidar @ np.linalg.inv(ego_from_nuscenes_lidar() @ nuscenes_lidar_from_forward())
    return {
        "translation": (pose[:3, 3] + _ORIGIN).tolist(),
        "rotation": quaternions_from_matrices(pose[None, :3, :3])[0].tolist(),
    }


def _write_sweeps(root: Path, drive: int, number: int, simulated: SimulatedFrame) -> list[dict[str, Any]]:
    """The scans between the key frame before and this one, oldest first; none before the first of a drive."""
    preset, result = simulated.preset, []
    for k in range(preset.sweeps if number else 0, 0, -1):
        time = simulated.time - k / preset.lidar.rate_hz
        sweep = capture(simulated.scene, preset, time, (drive, number, 100 + k), "", images=False)
        timestamp = START_US + drive * 100_000_000 + round(time * 1e6)
        name = f"sweeps/LIDAR_TOP/simulated-{drive:04d}__LIDAR_TOP__{timestamp}.pcd.bin"
        write_bytes(root / name, _raw_points(sweep))
        result.append({"timestamp": timestamp, "filename": name, "pose": _ego_pose(sweep.world_from_lidar)})
    return result


def _raw_points(simulated: SimulatedFrame) -> bytes:
    """x, y, z in the sensor's own frame (x right, y ahead), intensity 0 to 255 and ring, as float32."""
    scan = simulated.scan
    xyz = scan.points[:, :3] @ nuscenes_lidar_from_forward()[:3, :3].T.astype(np.float32)
    intensity = np.round(scan.points[:, 3:4] * 255)
    return np.concatenate([xyz, intensity, scan.ring[:, None]], axis=1).astype("<f4").tobytes()


def _write_jpeg(path: Path, image: Any) -> None:
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="JPEG", quality=93)


def _objects(simulated: SimulatedFrame) -> list[dict[str, Any]]:
    """Annotations of a sample: what lies within range and has a return or a visible pixel."""
    result = []
    world = simulated.scene.boxes(simulated.time)
    for k, actor in enumerate(simulated.actors):
        share = sum((1 - float(s.hidden[k])) * (1 - float(s.truncated[k])) for s in simulated.sightings.values())
        points = int(simulated.points_on[k])
        if np.hypot(*simulated.boxes[k, :2]) > _MAX_DISTANCE_M or (points == 0 and share < 0.05):
            continue
        length, width, height = actor.size
        result.append(
            {
                "id": actor.id,
                "class": NUSCENES_CLASS[actor.kind],
                "attribute": attribute(actor),
                "translation": (world[k, :3] + _ORIGIN).round(4).tolist(),
                "size": [width, length, height],
                "rotation": quaternions_from_yaws(world[k, 6:7])[0].tolist(),
                "points": points,
                "visibility": str(1 + int(np.digitize(min(share, 1.0), VISIBILITY_LIMITS))),
            }
        )
    return result


def write_tables(root: Path, ids: Iterable[str], seed: int) -> None:
    """Write the thirteen tables, the map placeholder and the scene lists ``train.txt`` and ``val.txt``."""
    parts = [read_json(_part_path(root, id)) for id in ids]
    drives = sorted({part["drive"] for part in parts})
    tables = _fixed_tables(seed, parts[0])
    tables["scene"], tables["sample"], tables["sample_data"], tables["ego_pose"] = [], [], [], []
    tables["instance"], tables["sample_annotation"] = [], []
    for drive in drives:
        members = sorted((part for part in parts if part["drive"] == drive), key=lambda part: part["number"])
        _drive_tables(tables, seed, drive, members)
    write_png(root / "maps" / "placeholder.png", np.zeros((4, 4, 3), dtype=np.uint8))
    names = [[scene["name"]] for scene in tables["scene"]]
    for name, chosen in zip(("train", "val"), split_groups(names), strict=True):
        write_text(root / f"{name}.txt", "".join(f"{n}\n" for n in chosen))
    for table, rows in tables.items():
        write_json(root / VERSION / f"{table}.json", rows, indent=0)


def _fixed_tables(seed: int, part: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Tables that do not depend on the drives."""
    sensors = [("LIDAR_TOP", "lidar", ego_from_nuscenes_lidar())]
    sensors += [
        (name, "camera", ego_from_nuscenes_camera(position, yaw)) for name, position, yaw, _ in NUSCENES_CAMERAS
    ]
    calibrated = [
        {
            "token": token(seed, "calibration", name),
            "sensor_token": token("sensor", name),
            "translation": pose[:3, 3].tolist(),
            "rotation": quaternions_from_matrices(pose[None, :3, :3])[0].tolist(),
            "camera_intrinsic": part["intrinsics"].get(name, []),
        }
        for name, _, pose in sensors
    ]
    levels = ("v0-40", "v40-60", "v60-80", "v80-100")
    log = token(seed, "log")
    return {
        "sensor": [{"token": token("sensor", name), "channel": name, "modality": kind} for name, kind, _ in sensors],
        "calibrated_sensor": calibrated,
        "category": [
            {"token": token("category", c), "name": c, "description": f"Simulated {k.replace('_', ' ')}."}
            for k, c in CATEGORIES.items()
        ],
        "attribute": [
            {"token": token("attribute", a), "name": a, "description": a.replace(".", " is ")} for a in ATTRIBUTES
        ],
        "visibility": [
            {"token": str(k + 1), "level": level, "description": f"visibility of whole object: {level[1:]} %"}
            for k, level in enumerate(levels)
        ],
        "log": [
            {
                "token": log,
                "logfile": "simulated",
                "vehicle": "simulated",
                "date_captured": "2020-09-13",
                "location": "simulated",
            }
        ],
        "map": [
            {
                "token": token(seed, "map"),
                "log_tokens": [log],
                "category": "semantic_prior",
                "filename": "maps/placeholder.png",
            }
        ],
    }


def _drive_tables(
    tables: dict[str, list[dict[str, Any]]], seed: int, drive: int, members: list[dict[str, Any]]
) -> None:
    """Append the rows of one drive."""

    def sample_token(k: int) -> str:
        return token(seed, "sample", drive, members[k]["number"]) if 0 <= k < len(members) else ""

    scene = token(seed, "scene", drive)
    tables["scene"].append(
        {
            "token": scene,
            "log_token": token(seed, "log"),
            "nbr_samples": len(members),
            "first_sample_token": sample_token(0),
            "last_sample_token": sample_token(len(members) - 1),
            "name": f"scene-{drive:04d}",
            "description": f"Simulated street: {members[0]['street']}",
        }
    )
    for k, part in enumerate(members):
        tables["sample"].append(
            {
                "token": sample_token(k),
                "timestamp": part["timestamp"],
                "prev": sample_token(k - 1),
                "next": sample_token(k + 1),
                "scene_token": scene,
            }
        )
    for channel in members[0]["files"]:
        _data_tables(tables, seed, drive, members, channel, [sample_token(k) for k in range(len(members))])
    _annotation_tables(tables, seed, drive, members, [sample_token(k) for k in range(len(members))])


def _data_tables(
    tables: dict[str, list[dict[str, Any]]],
    seed: int,
    drive: int,
    members: list[dict[str, Any]],
    channel: str,
    samples: list[str],
) -> None:
    """Append the files of one sensor and the poses of the car at their times, linked in order of time."""
    chain = []
    for sample, part in zip(samples, members, strict=True):
        key = token(seed, "data", channel, drive, part["number"])
        if channel == "LIDAR_TOP":
            for k, sweep in enumerate(part["sweeps"]):
                chain.append((token(seed, "sweep", drive, part["number"], k), sample, False, sweep))
        own = part["own"].get(channel, {"timestamp": part["timestamp"], "pose": part["pose"]})
        chain.append((key, sample, True, {**own, "filename": part["files"][channel]}))
    width, height = members[0]["sizes"].get(channel, (0, 0))
    names = ["", *(row[0] for row in chain), ""]
    for k, (name, sample, is_key, row) in enumerate(chain):
        tables["sample_data"].append(
            {
                "token": name,
                "sample_token": sample,
                "ego_pose_token": name,
                "calibrated_sensor_token": token(seed, "calibration", channel),
                "timestamp": row["timestamp"],
                "fileformat": "pcd" if channel == "LIDAR_TOP" else "jpg",
                "is_key_frame": is_key,
                "height": height,
                "width": width,
                "filename": row["filename"],
                "prev": names[k],
                "next": names[k + 2],
            }
        )
        tables["ego_pose"].append({"token": name, "timestamp": row["timestamp"], **row["pose"]})


def _annotation_tables(
    tables: dict[str, list[dict[str, Any]]], seed: int, drive: int, members: list[dict[str, Any]], samples: list[str]
) -> None:
    """Append instances and annotations of one drive, linked along each track."""
    tracks: dict[int, list[tuple[int, dict[str, Any]]]] = {}
    for k, part in enumerate(members):
        for item in part["objects"]:
            tracks.setdefault(item["id"], []).append((k, item))
    for id, seen in sorted(tracks.items()):
        tokens = [token(seed, "annotation", drive, members[k]["number"], id) for k, _ in seen]
        instance = token(seed, "instance", drive, id)
        tables["instance"].append(
            {
                "token": instance,
                "category_token": token("category", CATEGORIES[seen[0][1]["class"]]),
                "nbr_annotations": len(seen),
                "first_annotation_token": tokens[0],
                "last_annotation_token": tokens[-1],
            }
        )
        for n, (k, item) in enumerate(seen):
            tables["sample_annotation"].append(
                {
                    "token": tokens[n],
                    "sample_token": samples[k],
                    "instance_token": instance,
                    "visibility_token": item["visibility"],
                    "attribute_tokens": [token("attribute", item["attribute"])] if item["attribute"] else [],
                    "translation": item["translation"],
                    "size": item["size"],
                    "rotation": item["rotation"],
                    "prev": tokens[n - 1] if n else "",
                    "next": tokens[n + 1] if n + 1 < len(tokens) else "",
                    "num_lidar_pts": item["points"],
                    "num_radar_pts": 0,
                }
            )

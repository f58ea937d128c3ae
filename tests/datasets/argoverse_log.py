"""A tiny Argoverse 2 log: two cameras ahead and to the left, three sweeps, a straight drive along city x."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lcf3d.formats.feather import write_columns

LOG = "0a1b"
FIRST_NS = 1_000_000_000
STEP_NS = 100_000_000
SPEED = 10.0
"""Metres a second along city x."""


def rows(columns: list[str], values: list[tuple[Any, ...]]) -> dict[str, Any]:
    return {
        name: np.array(column, dtype=object if isinstance(column[0], str) else None)
        for name, column in zip(columns, zip(*values, strict=True), strict=True)
    }


POSE = ["qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"]
CUBOID = ["timestamp_ns", "category", "length_m", "width_m", "height_m", *POSE, "num_interior_pts"]
# camera axes (x right, y down, z forward) from the vehicle's, looking ahead, and looking left
AHEAD = (0.5, -0.5, 0.5, -0.5)
LEFT = (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0)


def cuboid(
    time: int,
    category: str,
    center: tuple[float, float, float],
    size: tuple[float, float, float] = (4.0, 2.0, 1.5),
    yaw: float = 0.0,
    points: int = 5,
) -> tuple[Any, ...]:
    return (
        time,
        category,
        *(float(v) for v in size),
        float(np.cos(yaw / 2)),
        0.0,
        0.0,
        float(np.sin(yaw / 2)),
        *(float(v) for v in center),
        points,
    )


def write_annotations(path: Path, cuboids: list[tuple[Any, ...]]) -> None:
    write_columns(path, rows(CUBOID, cuboids))


def write_submission_rows(path: Path, cuboids: list[tuple[Any, ...]], scores: list[float], log: str = LOG) -> None:
    columns = rows(CUBOID, cuboids)
    del columns["num_interior_pts"]
    write_columns(path, {**columns, "score": np.array(scores), "log_id": np.array([log] * len(scores), dtype=object)})


def sweep_time(i: int) -> int:
    return FIRST_NS + i * STEP_NS


def write_log(root: Path, *, images: bool = True, log: str = LOG, split: str = "val") -> Path:
    """The folder of a log under ``root/split``; sweeps 0 and 1 have scans, all three are annotated."""
    folder = root / split / log
    write_columns(
        folder / "calibration/egovehicle_SE3_sensor.feather",
        rows(
            ["sensor_name", *POSE],
            [
                ("ring_front_center", *AHEAD, 1.0, 0.0, 1.5),
                ("ring_side_left", *LEFT, 1.0, 0.5, 1.5),
                ("up_lidar", 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 2.0),
            ],
        ),
    )
    write_columns(
        folder / "calibration/intrinsics.feather",
        rows(
            ["sensor_name", "fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "height_px", "width_px"],
            [
                ("ring_front_center", 100.0, 100.0, 50.0, 40.0, -0.2, 0.0, 0.0, 80, 100),
                ("ring_side_left", 100.0, 100.0, 50.0, 40.0, -0.2, 0.0, 0.0, 80, 100),
            ],
        ),
    )
    times = [FIRST_NS - STEP_NS + i * STEP_NS // 4 for i in range(20)]
    write_columns(
        folder / "city_SE3_egovehicle.feather",
        rows(
            ["timestamp_ns", *POSE],
            [(t, 1.0, 0.0, 0.0, 0.0, SPEED * (t - FIRST_NS) * 1e-9, 0.0, 0.0) for t in times],
        ),
    )
    write_annotations(
        folder / "annotations.feather",
        [cuboid(sweep_time(i), "REGULAR_VEHICLE", (21.0 - i, 0.0, 1.5)) for i in range(3)]
        + [cuboid(FIRST_NS, "PEDESTRIAN", (1.0, 10.0, 1.5), (0.6, 0.6, 1.8)), cuboid(FIRST_NS, "ANIMAL", (5, 5, 0))],
    )
    for i in range(2):
        points = np.array([[19.0 - i, 0.2 * k, 1.5] for k in range(-3, 4)], dtype=np.float16)
        n = len(points)
        write_columns(
            folder / f"sensors/lidar/{sweep_time(i)}.feather",
            {
                "x": points[:, 0],
                "y": points[:, 1],
                "z": points[:, 2],
                "intensity": np.full(n, 7, np.uint8),
                "laser_number": np.zeros(n, np.uint8),
                "offset_ns": np.arange(n, dtype=np.int32) * 1000,
            },
        )
    if images:
        for name, delay in (("ring_front_center", 25_000_000), ("ring_side_left", 0)):
            for i in range(3):
                path = folder / f"sensors/cameras/{name}/{sweep_time(i) + delay}.jpg"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.new("RGB", (100, 80), (i, 60, 90)).save(path)
    return folder

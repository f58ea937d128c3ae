"""Builders of small KITTI frames for the evaluation tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcf3d.formats.kitti import KittiFrames, KittiObjects


def objects(rows: Sequence[dict[str, object]], results: bool) -> KittiObjects:
    """Objects from dicts; what a dict leaves out describes a clearly visible car 10 m ahead, 50 pixels high."""
    default = {
        "name": "Car",
        "truncated": 0.0,
        "occluded": 0,
        "alpha": 0.0,
        "box": (0, 0, 100, 50),
        "size": (1.5, 2.0, 4.0),
        "location": (0, 1.5, 10),
        "rotation": 0.0,
        "score": 1.0,
    }
    full = [{**default, **row} for row in rows]

    def column(key: str, shape: tuple[int, ...] = ()) -> np.ndarray:
        return np.array([row[key] for row in full], dtype=np.float64).reshape(len(full), *shape)

    return KittiObjects(
        np.array([row["name"] for row in full], dtype=np.str_),
        column("truncated"),
        column("occluded").astype(np.int64),
        column("alpha"),
        column("box", (4,)),
        column("size", (3,)),
        column("location", (3,)),
        column("rotation"),
        column("score") if results else None,
    )


def frames(rows_by_frame: Sequence[Sequence[dict[str, object]]], results: bool) -> KittiFrames:
    """Frames ``0``, ``1``, ... of such objects."""
    return KittiFrames.from_frames(
        [str(i) for i in range(len(rows_by_frame))], [objects(rows, results) for rows in rows_by_frame]
    )


def dontcare(box: tuple[float, float, float, float]) -> dict[str, object]:
    """A DontCare region of the image."""
    return {
        "name": "DontCare",
        "truncated": -1,
        "occluded": -1,
        "alpha": -10,
        "box": box,
        "size": (-1, -1, -1),
        "location": (-1000, -1000, -1000),
        "rotation": -10,
    }

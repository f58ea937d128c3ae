"""Detections as JSON of our own, one file a frame: what datasets without a form of their own read and write.

3D: ``{"class_names": [...], "boxes": [[x, y, z, length, width, height, yaw], ...], "scores": [...], "labels": [...]}``
in the LiDAR frame, metres and radians, geometric centre. 2D: ``{"CAMERA": {"class_names": ..., "boxes": [[x1, y1, x2,
y2], ...], "scores": ..., "labels": ...}, ...}`` in pixels. A label is an index into the class names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.errors import FormatError, Lcf3dError
from lcf3d.files import read_json, write_json
from lcf3d.structures import Detections2D, Detections3D


def write_detections_3d(path: str | Path, detections: Detections3D) -> None:
    """Write the 3D detections of a frame."""
    write_json(path, _plain(detections), indent=None)


def read_detections_3d(path: str | Path) -> Detections3D:
    """The 3D detections of a frame.

    Raises:
        FormatError: the file is absent or holds something else; names it.
    """
    found: Detections3D = _read(Detections3D, read_json(path), str(path))
    return found


def write_detections_2d(path: str | Path, detections: Mapping[str, Detections2D]) -> None:
    """Write the 2D detections of a frame by camera; masks are not written."""
    write_json(path, {camera: _plain(found) for camera, found in detections.items()}, indent=None)


def read_detections_2d(path: str | Path) -> dict[str, Detections2D]:
    """The 2D detections of a frame by camera.

    Raises:
        FormatError: the file is absent or holds something else; names it.
    """
    value = read_json(path)
    if not isinstance(value, dict):
        raise FormatError(f"{path} must hold detections by camera name, got {type(value).__name__}")
    return {str(camera): _read(Detections2D, found, f"{path}: camera {camera}") for camera, found in value.items()}


def _plain(detections: Detections2D | Detections3D) -> dict[str, Any]:
    return {
        "class_names": list(detections.class_names),
        "boxes": np.round(detections.boxes, 5).tolist(),
        "scores": np.round(detections.scores, 7).tolist(),
        "labels": detections.labels.tolist(),
    }


def _read(kind: Any, value: Any, place: str) -> Any:
    wanted = ("class_names", "boxes", "scores", "labels")
    if not isinstance(value, dict) or any(name not in value for name in wanted):
        raise FormatError(f"{place} must hold {', '.join(wanted)}")
    try:
        names = tuple(str(name) for name in value["class_names"])
        if not value["boxes"]:
            return kind.empty(names)
        found = kind(value["boxes"], value["scores"], np.array(value["labels"], dtype=np.int64), names)
    except (Lcf3dError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{place} holds no detections ({error})") from None
    if not (np.isfinite(found.boxes).all() and np.isfinite(found.scores).all()):
        raise FormatError(f"{place} holds NaN or infinite values")
    return found

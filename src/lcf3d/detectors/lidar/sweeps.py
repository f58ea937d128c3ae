"""The cloud that a network was trained on: several sweeps joined, or only what a camera sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import CloudRequest
from lcf3d.errors import DatasetError, ShapeError
from lcf3d.frame import Frame, Sweep
from lcf3d.geometry.camera import project_points
from lcf3d.structures import Camera

__all__ = ["Sweep", "accumulate_sweeps", "cloud_of", "in_view", "missing_of"]

CLOSE_M = 1.0
"""Points of a sweep nearer than this along both x and y are the vehicle's own (as in the published training)."""


def accumulate_sweeps(
    points: NDArray[np.floating], sweeps: Sequence[Sweep], remove_close: bool = True
) -> NDArray[np.float32]:
    """(M, 5) float32 ``x, y, z, intensity, time lag`` of the key frame and of earlier sweeps, in its LiDAR frame.

    Args:
        points: (N, 4 or more) of the key frame; further columns, such as a ring index, are left out.
        sweeps: as many as the network was trained with (nuScenes: 10 for PointPillars and SSN, 9 for CenterPoint).
        remove_close: leave out points of a sweep that are nearer than `CLOSE_M` to its sensor along both x and y.

    Raises:
        ShapeError: fewer than four columns, or a transform that is not 4 x 4.
    """
    parts = [_columns(points, 0.0)]
    for sweep in sweeps:
        transform = np.asarray(sweep.lidar_from_sweep, np.float64)
        if transform.shape != (4, 4):
            raise ShapeError(f"Sweep.lidar_from_sweep must have shape (4, 4), got {transform.shape}")
        part = _columns(sweep.points, sweep.time_lag_s)
        if remove_close:
            part = part[(np.abs(part[:, :2]) >= CLOSE_M).any(axis=1)]
        part[:, :3] = part[:, :3].astype(np.float64) @ transform[:3, :3].T + transform[:3, 3]
        parts.append(part)
    return np.concatenate(parts)


def _columns(points: NDArray[np.floating], time_lag_s: float) -> NDArray[np.float32]:
    if points.ndim != 2 or points.shape[1] < 4:
        raise ShapeError(f"points must have shape (N, 4 or more), got {points.shape}")
    result = np.full((len(points), 5), time_lag_s, np.float32)
    result[:, :4] = points[:, :4]
    return result


def in_view(points: NDArray[np.floating], camera: Camera) -> NDArray[np.floating]:
    """Those of the (N, 3 or more) LiDAR-frame points that project into a camera's image."""
    pixels, _ = project_points(points, camera)
    # pixels of points behind the camera are NaN, of which comparisons are false
    inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return points[inside]


def cloud_of(frame: Frame, request: CloudRequest) -> NDArray[np.floating]:
    """(N, 4 or 5) the cloud of a frame that a detector asks for, in the frame's LiDAR coordinates.

    Raises:
        DatasetError: the frame has no scan.
    """
    points: NDArray[np.floating] | None = frame.points
    if points is None:
        raise DatasetError(f"frame {frame.id} has no scan for the LiDAR detector; pass results:PATH instead")
    # a cloud of more columns is joined already, or its fifth column is none of time: the network will tell
    if request.sweeps and points.shape[1] == 4:
        sweeps = list(frame.sweeps(request.sweeps))
        if not sweeps and request.repeat_scan:
            sweeps = [Sweep(points, np.eye(4), 0.0)] * request.sweeps
        points = accumulate_sweeps(points, sweeps, request.remove_close)
    camera = _viewer(frame, request)
    return points if camera is None else in_view(points, camera)


def missing_of(frame: Frame, request: CloudRequest) -> tuple[str, ...]:
    """What a frame lacks of what a detector asks for, in words; the same words for every such frame."""
    notes = []
    joined = frame.points is not None and frame.points.shape[1] > 4
    if not joined and len(frame.sweeps(request.sweeps)) < request.sweeps:
        notes.append(f"fewer earlier sweeps than the {request.sweeps} that the LiDAR detector was trained with")
    if request.view and _viewer(frame, request) is None:
        notes.append(
            f"no camera {request.view!r}: the LiDAR detector, trained on what that camera sees, got the whole scan"
        )
    return tuple(notes)


def _viewer(frame: Frame, request: CloudRequest) -> Camera | None:
    """The camera whose field of view is asked for: the one of that name, or the only one that there is."""
    if not request.view:
        return None
    named = [camera for camera in frame.cameras if camera.name == request.view]
    found = named or (list(frame.cameras) if len(frame.cameras) == 1 else [])
    return found[0] if found else None

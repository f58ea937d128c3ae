"""Fused detections of many frames as columns of arrow tables, see `lcf3d.formats.fused_table`.

Arrays of all frames are joined and handed over whole; nothing is made for a single row.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from lcf3d.provenance import REAL, WHOLE, Decisions, FusedDetections
from lcf3d.reasons import OUTCOMES, REASONS
from lcf3d.structures import Detections2D, Detections3D, FloatArray, IntArray

Frames = Sequence[tuple[str, FusedDetections]]


def frame_table(frames: Frames, schema: pa.Schema) -> pa.Table:
    """One row a frame."""
    fused = [one for _, one in frames]
    views = [found for one in fused for found in one.camera_inputs]
    view_type = schema.field("camera_inputs").type
    columns = {
        "frame": [frame_id for frame_id, _ in frames],
        "cameras": [one.camera_names for one in fused],
        "notes": [one.notes for one in fused],
        "detections": _boxes([one.detections for one in fused], schema.field("detections").type),
        "lidar_inputs": _boxes([one.lidar_inputs for one in fused], schema.field("lidar_inputs").type),
        "camera_inputs": pa.ListArray.from_arrays(
            _offsets(len(one.camera_inputs) for one in fused), _boxes(views, view_type.value_type)
        ),
        "lidar": _decisions([one.lidar for one in fused], schema.field("lidar").type),
        "camera": _decisions([one.camera for one in fused], schema.field("camera").type),
        "tracks": [
            None
            if one.tracks is None
            else {name: getattr(one.tracks, name).tolist() for name in one.tracks.__dataclass_fields__}
            for one in fused
        ],
    }
    return _table(columns, schema)


def detection_table(frames: Frames, schema: pa.Schema) -> pa.Table:
    """One row an output."""
    found = [fused.detections for _, fused in frames]
    counts = [len(one) for one in found]
    boxes = _joined([one.boxes for one in found], (0, 7))
    reasons = _joined([_reasons(fused) for _, fused in frames])
    velocities = _joined([_velocities(one) for one in found], (0, 2))
    velocities[np.isnan(velocities).any(axis=1)] = np.nan
    columns: dict[str, Any] = {
        "frame": _words([frame_id for frame_id, _ in frames], np.repeat(np.arange(len(frames)), counts)),
        "output": _joined([np.arange(n) for n in counts]),
        "class_name": _class_names(found),
        "score": _joined([one.scores for one in found], dtype=np.float64),
        **{name: boxes[:, i] for i, name in enumerate(("x", "y", "z", "length", "width", "height", "yaw"))},
        "velocity_x": _measures(velocities[:, 0]),
        "velocity_y": _measures(velocities[:, 1]),
        "attribute": [
            name or None
            for one in found
            for name in ([None] * len(one) if one.attributes is None else one.attributes.tolist())
        ],
        "outcome": _words(OUTCOMES, _joined([fused.outcomes for _, fused in frames])),
        # boxes that only the memory of past frames predicts have none
        "reason": _words(REASONS, reasons),
        "explanation": [sentence for _, fused in frames for sentence in fused.explanations()],
        "track": [
            number
            for _, fused in frames
            for number in ([None] * len(fused) if fused.tracks is None else fused.tracks.ids.tolist())
        ],
    }
    return _table(columns, schema)


def _table(columns: dict[str, Any], schema: pa.Schema) -> pa.Table:
    arrays = []
    for field in schema:
        values = columns[field.name]
        same = isinstance(values, pa.Array) and values.type == field.type
        arrays.append(values if same else pa.array(values, field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _boxes(detections: Sequence[Detections2D | Detections3D], kind: pa.StructType) -> pa.StructArray:
    """Detections of each frame or camera as a struct of lists."""
    offsets = _offsets(len(found) for found in detections)
    columns: dict[str, Any] = {
        "class_names": [found.class_names for found in detections],
        "boxes": pa.ListArray.from_arrays(offsets, _vectors([found.boxes for found in detections])),
        "scores": pa.ListArray.from_arrays(offsets, _joined([found.scores for found in detections], dtype=np.float64)),
        "labels": pa.ListArray.from_arrays(offsets, _joined([found.labels for found in detections])),
        "velocities": [_velocity_rows(found) for found in detections],
        "attributes": [
            None if (names := getattr(found, "attributes", None)) is None else names.tolist() for found in detections
        ],
    }
    return _struct(columns, kind)


def _decisions(tables: Sequence[Decisions], kind: pa.StructType) -> pa.StructArray:
    """Tables of decisions, one a frame, as a struct of lists, null where unset."""
    offsets = _offsets(len(table) for table in tables)
    joined = {name: _joined([getattr(table, name) for table in tables]) for name in ("outcome", "reason", *WHOLE)}
    values = {
        "outcome": _words(OUTCOMES, joined["outcome"]),
        "reason": _words(REASONS, joined["reason"]),
        **{name: pa.array(joined[name], mask=joined[name] < 0) for name in WHOLE},
        **{name: _measures(_joined([getattr(t, name) for t in tables], dtype=np.float64)) for name in REAL},
    }
    return _struct({name: pa.ListArray.from_arrays(offsets, column) for name, column in values.items()}, kind)


def _struct(columns: dict[str, Any], kind: pa.StructType) -> pa.StructArray:
    fields = [kind.field(i) for i in range(kind.num_fields)]
    arrays = [
        columns[field.name] if isinstance(columns[field.name], pa.Array) else pa.array(columns[field.name], field.type)
        for field in fields
    ]
    return pa.StructArray.from_arrays(arrays, fields=fields)


def _vectors(parts: Sequence[FloatArray]) -> pa.ListArray:
    """Rows of matrices of one width as lists."""
    width = parts[0].shape[1] if parts else 0
    rows = _joined(parts, (0, width))
    return pa.ListArray.from_arrays(_offsets([width] * len(rows)), rows.ravel())


def _offsets(counts: Iterable[int]) -> pa.Array:
    return pa.array(np.cumsum([0, *counts]), pa.int32())


def _joined(parts: Sequence[Any], shape: tuple[int, ...] = (0,), dtype: Any = np.int64) -> Any:
    """Arrays of all frames one after the other, of that shape and type where there are none."""
    return np.concatenate(parts) if parts else np.zeros(shape, np.float64 if len(shape) > 1 else dtype)


def _words(names: Sequence[str], codes: IntArray) -> pa.Array:
    """The names that codes stand for, null for negative ones."""
    return pa.array(list(names), pa.string()).take(pa.array(codes, mask=codes < 0))


def _class_names(found: Sequence[Detections3D]) -> pa.Array:
    """Class of every detection; frames may have lists of their own."""
    names: list[str] = []
    first: dict[tuple[str, ...], int] = {}
    for one in found:
        if one.class_names not in first:
            first[one.class_names] = len(names)
            names += one.class_names
    return _words(names, _joined([one.labels + first[one.class_names] for one in found]))


def _measures(values: FloatArray) -> pa.Array:
    """Numbers, null where NaN."""
    return pa.array(values, mask=np.isnan(values))


def _reasons(fused: FusedDetections) -> IntArray:
    """(N,) reason of every output, -1 where no input led to it."""
    reasons = np.full(len(fused), -1)
    for table in (fused.camera, fused.lidar):
        led = table.output >= 0
        reasons[table.output[led]] = table.reason[led]
    return reasons


def _velocities(found: Detections3D) -> FloatArray:
    """(N, 2), NaN where unknown."""
    return np.full((len(found), 2), np.nan) if found.velocities is None else found.velocities


def _velocity_rows(found: Detections2D | Detections3D) -> list[Any] | None:
    """As the JSON files have them, but not rounded."""
    velocities = getattr(found, "velocities", None)
    return None if velocities is None else [None if np.isnan(v).any() else v.tolist() for v in velocities]

"""Fused detections of many frames as columns of arrow tables, see `lcf3d.formats.fused_table`.

Arrays of all frames are joined and handed over whole; nothing is made for a single row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import pyarrow as pa

from lcf3d.decisions import REAL, WHOLE, Decisions, TrackTable
from lcf3d.formats.arrow_arrays import lists, measures, numbers, structs, text_lists, texts, words
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import OUTCOMES, REASONS
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray

Frames = Sequence[tuple[str, FusedDetections]]


def frame_table(frames: Frames, schema: pa.Schema) -> pa.Table:
    """One row a frame."""
    fused = [one for _, one in frames]
    views = [found for one in fused for found in one.camera_inputs]
    view_type = schema.field("camera_inputs").type
    columns = {
        "frame": texts([frame_id for frame_id, _ in frames]),
        "cameras": text_lists([one.camera_names for one in fused]),
        "notes": text_lists([one.notes for one in fused]),
        "detections": _boxes([one.detections for one in fused], schema.field("detections").type),
        "lidar_inputs": _boxes([one.lidar_inputs for one in fused], schema.field("lidar_inputs").type),
        "camera_inputs": lists((len(one.camera_inputs) for one in fused), _boxes(views, view_type.value_type)),
        "lidar": _decisions([one.lidar for one in fused], schema.field("lidar").type),
        "camera": _decisions([one.camera for one in fused], schema.field("camera").type),
        "tracks": _tracks([one.tracks for one in fused], schema.field("tracks").type),
    }
    return _table(columns, schema)


def detection_table(frames: Frames, schema: pa.Schema) -> pa.Table:
    """One row an output."""
    fused = [one for _, one in frames]
    found = [one.detections for one in fused]
    counts = np.array([len(one) for one in found], dtype=np.int64)
    boxes = _joined([one.boxes for one in found], (0, 7))
    velocities = _joined([_velocities(one) for one in found], (0, 2))
    velocities[np.isnan(velocities).any(axis=1)] = np.nan
    # boxes that only the memory of past frames predicts have no reason
    reasons = _joined([one.of_outputs("reason", -1) for one in fused])
    tracks = _joined([np.full(len(one), -1) if one.tracks is None else one.tracks.ids for one in fused])
    starts = np.cumsum(counts) - counts
    columns: dict[str, Any] = {
        "frame": words([frame_id for frame_id, _ in frames], np.repeat(np.arange(len(frames)), counts)),
        "output": numbers((np.arange(counts.sum()) - np.repeat(starts, counts)).astype(np.int32)),
        "class_name": _class_names(found),
        "score": numbers(_joined([one.scores for one in found], dtype=np.float64)),
        **{name: numbers(boxes[:, i]) for i, name in enumerate(("x", "y", "z", "length", "width", "height", "yaw"))},
        "velocity_x": measures(velocities[:, 0]),
        "velocity_y": measures(velocities[:, 1]),
        "attribute": texts(
            [
                name or None
                for one in found
                for name in ([None] * len(one) if one.attributes is None else one.attributes.tolist())
            ]
        ),
        "outcome": words(OUTCOMES, _joined([one.outcomes for one in fused])),
        "reason": words(REASONS, reasons),
        "explanation": texts([sentence for one in fused for sentence in one.explanations()]),
        "track": numbers(tracks, tracks >= 0),
    }
    return _table(columns, schema)


def _table(columns: dict[str, pa.Array], schema: pa.Schema) -> pa.Table:
    return pa.Table.from_arrays([columns[field.name] for field in schema], schema=schema)


def _boxes(detections: Sequence[Detections2D | Detections3D], kind: pa.StructType) -> pa.StructArray:
    """Detections of each frame or camera as a struct of lists."""
    counts = [len(found) for found in detections]
    columns: dict[str, Any] = {
        "class_names": text_lists([found.class_names for found in detections]),
        "boxes": lists(counts, _vectors(_joined([found.boxes for found in detections], (0, 7)))),
        "scores": lists(counts, numbers(_joined([found.scores for found in detections], dtype=np.float64))),
        "labels": lists(counts, numbers(_joined([found.labels for found in detections]))),
    }
    if kind.get_field_index("velocities") >= 0:
        known = [getattr(found, "velocities", None) for found in detections]
        there = [rows for rows in known if rows is not None]
        counts = [0 if rows is None else len(rows) for rows in known]
        columns["velocities"] = lists(counts, _known_vectors(_joined(there, (0, 2))), _known(known))
        attributes = [getattr(found, "attributes", None) for found in detections]
        columns["attributes"] = text_lists([None if names is None else names.tolist() for names in attributes])
    return structs(columns, kind)


def _decisions(tables: Sequence[Decisions], kind: pa.StructType) -> pa.StructArray:
    """Tables of decisions, one a frame, as a struct of lists, null where unset."""
    counts = [len(table) for table in tables]
    joined = {name: _joined([getattr(table, name) for table in tables]) for name in ("outcome", "reason", *WHOLE)}
    values = {
        "outcome": words(OUTCOMES, joined["outcome"]),
        "reason": words(REASONS, joined["reason"]),
        **{name: numbers(joined[name], joined[name] >= 0) for name in WHOLE},
        **{name: measures(_joined([getattr(t, name) for t in tables], dtype=np.float64)) for name in REAL},
    }
    return structs({name: lists(counts, column) for name, column in values.items()}, kind)


def _tracks(tables: Sequence[TrackTable | None], kind: pa.StructType) -> pa.StructArray:
    """Tables of tracks, one a frame, as a struct of lists; null where there is none."""
    valid = _known(tables)
    counts = [0 if table is None else len(table) for table in tables]
    there = [table for table in tables if table is not None]
    columns = {}
    for column in fields(TrackTable):
        whole = column.name in ("ids", "hits")
        parts = [getattr(table, column.name) for table in there]
        values = _joined(parts, dtype=np.int64 if whole else np.float64)
        columns[column.name] = lists(counts, numbers(values), valid)
    return structs(columns, kind, valid)


def _known(values: Sequence[object | None]) -> Any:
    """(N,) which are not None."""
    return np.array([value is not None for value in values], dtype=bool)


def _vectors(rows: FloatArray) -> pa.ListArray:
    """Rows as lists."""
    return lists(np.full(len(rows), rows.shape[1]), numbers(rows.ravel()))


def _known_vectors(rows: FloatArray) -> pa.ListArray:
    """Rows as lists, null where a value is NaN."""
    valid: BoolArray = np.logical_not(np.isnan(rows).any(axis=1))
    return lists(np.where(valid, rows.shape[1], 0), numbers(rows[valid].ravel()), valid)


def _joined(parts: Sequence[Any], shape: tuple[int, ...] = (0,), dtype: Any = np.int64) -> Any:
    """Arrays of all frames one after the other, of that shape and type where there are none."""
    return np.concatenate(parts) if parts else np.zeros(shape, np.float64 if len(shape) > 1 else dtype)


def _class_names(found: Sequence[Detections3D]) -> pa.Array:
    """Class of every detection; frames may have lists of their own."""
    names: list[str] = []
    first: dict[tuple[str, ...], int] = {}
    for one in found:
        if one.class_names not in first:
            first[one.class_names] = len(names)
            names += one.class_names
    return words(names, _joined([one.labels + first[one.class_names] for one in found]))


def _velocities(found: Detections3D) -> FloatArray:
    """(N, 2), NaN where unknown."""
    return np.full((len(found), 2), np.nan) if found.velocities is None else found.velocities

"""Fused detections of many frames as two parquet tables: one row an output, and one row a frame with all its reasons.

The schema, version `SCHEMA`, is in docs/fleet.md. Numbers are exact, where the JSON files of a run folder round them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.errors import ConfigError, FormatError
from lcf3d.files import atomic_path, reading, shortened
from lcf3d.provenance import Decisions, FusedDetections, Outcome, Reason, TrackTable
from lcf3d.structures import Detections2D, Detections3D

SCHEMA = "1"
_KEY = b"lcf3d.schema"
_WHOLE = ("cluster", "lidar", "camera", "detection", "output", "pair")
_REAL = ("iou", "lidar_score", "camera_score", "score", "quality")


def arrow() -> Any:
    """pyarrow.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ConfigError("parquet needs pyarrow: pip install 'lcf3d[fleet]'") from None
    return pyarrow


def frame_schema() -> Any:
    """Columns of the table of frames."""
    pa = arrow()
    boxes = [
        ("class_names", pa.list_(pa.string())),
        ("boxes", pa.list_(pa.list_(pa.float64()))),
        ("scores", pa.list_(pa.float64())),
        ("labels", pa.list_(pa.int64())),
    ]
    solid = [*boxes, ("velocities", pa.list_(pa.list_(pa.float64()))), ("attributes", pa.list_(pa.string()))]
    decisions = [
        ("outcome", pa.list_(pa.string())),
        ("reason", pa.list_(pa.string())),
        *((name, pa.list_(pa.int64())) for name in _WHOLE),
        *((name, pa.list_(pa.float64())) for name in _REAL),
    ]
    tracks = [
        (column.name, pa.list_(pa.int64() if column.name in ("ids", "hits") else pa.float64()))
        for column in fields(TrackTable)
    ]
    return pa.schema(
        [
            ("frame", pa.string()),
            ("cameras", pa.list_(pa.string())),
            ("notes", pa.list_(pa.string())),
            ("detections", pa.struct(solid)),
            ("lidar_inputs", pa.struct(solid)),
            ("camera_inputs", pa.list_(pa.struct(boxes))),
            ("lidar", pa.struct(decisions)),
            ("camera", pa.struct(decisions)),
            ("tracks", pa.struct(tracks)),
        ],
        metadata={_KEY: SCHEMA.encode()},
    )


def detection_schema() -> Any:
    """Columns of the table of outputs."""
    pa = arrow()
    numbers = ("score", "x", "y", "z", "length", "width", "height", "yaw", "velocity_x", "velocity_y")
    return pa.schema(
        [
            ("frame", pa.string()),
            ("output", pa.int32()),
            ("class_name", pa.string()),
            *((name, pa.float64()) for name in numbers),
            ("attribute", pa.string()),
            ("outcome", pa.string()),
            ("reason", pa.string()),
            ("explanation", pa.string()),
            ("track", pa.int64()),
        ],
        metadata={_KEY: SCHEMA.encode()},
    )


def write_frames(path: Path, frames: Sequence[tuple[str, FusedDetections]]) -> None:
    """Write the table of frames, whole or not at all."""
    _write(path, [_frame_row(frame_id, fused) for frame_id, fused in frames], frame_schema())


def write_detections(path: Path, frames: Sequence[tuple[str, FusedDetections]]) -> None:
    """Write the table of outputs, whole or not at all."""
    rows = [row for frame_id, fused in frames for row in _detection_rows(frame_id, fused)]
    _write(path, rows, detection_schema())


def _write(path: Path, rows: list[dict[str, Any]], schema: Any) -> None:
    pa = arrow()
    table = pa.Table.from_pylist(rows, schema=schema)
    with atomic_path(path) as temporary:
        pa.parquet.write_table(table, temporary, compression="zstd")


def read_frame_ids(path: Path) -> list[str]:
    """The frames that a table of frames holds, without reading more of it.

    Raises:
        FormatError: not such a table, or of another version.
    """
    file = _open(path)
    with _table(path):
        ids: list[str] = file.read(columns=["frame"]).column("frame").to_pylist()
    return ids


def read_frames(path: Path) -> Iterator[tuple[str, FusedDetections]]:
    """What `write_frames` has written, frame by frame.

    Raises:
        FormatError: not such a table, or of another version.
    """
    file = _open(path)
    with _table(path):
        for batch in file.iter_batches(batch_size=64):
            # what is damaged would be read beyond its end
            batch.validate(full=True)
            for row in batch.to_pylist():
                yield row["frame"], _from_row(row)


@contextmanager
def _table(path: Path) -> Iterator[None]:
    """Errors in the table's content as one sentence."""
    try:
        with reading(path, "a table of fused frames"):
            yield
    except OSError as error:
        raise FormatError(f"{path} cannot be read as a table of fused frames ({shortened(error)})") from None


def _open(path: Path) -> Any:
    pa = arrow()
    try:
        with reading(path, "a parquet file"):
            file = pa.parquet.ParquetFile(path)
            version = (file.schema_arrow.metadata or {}).get(_KEY)
    except FileNotFoundError:
        raise FormatError(f"{path} does not exist") from None
    except OSError as error:
        raise FormatError(f"{path} is no parquet file ({shortened(error)})") from None
    if version is None:
        raise FormatError(f"{path} was not written by lcf3d: it has no schema version")
    if version != SCHEMA.encode():
        raise FormatError(
            f"{path} has schema {shortened(version.decode(errors='replace'))}, this lcf3d reads {SCHEMA}: upgrade it, "
            "or write the run again"
        )
    return file


def _frame_row(frame_id: str, fused: FusedDetections) -> dict[str, Any]:
    return {
        "frame": frame_id,
        "cameras": list(fused.camera_names),
        "notes": list(fused.notes),
        "detections": _boxes(fused.detections),
        "lidar_inputs": _boxes(fused.lidar_inputs),
        "camera_inputs": [_boxes(found) for found in fused.camera_inputs],
        "lidar": _columns(fused.lidar),
        "camera": _columns(fused.camera),
        "tracks": None
        if fused.tracks is None
        else {column.name: getattr(fused.tracks, column.name).tolist() for column in fields(TrackTable)},
    }


def _boxes(detections: Detections2D | Detections3D) -> dict[str, Any]:
    """As the JSON files have them, but not rounded."""
    value: dict[str, Any] = {
        "class_names": list(detections.class_names),
        "boxes": detections.boxes.tolist(),
        "scores": detections.scores.tolist(),
        "labels": detections.labels.tolist(),
    }
    if isinstance(detections, Detections3D) and detections.velocities is not None:
        value["velocities"] = [None if np.isnan(v).any() else v.tolist() for v in detections.velocities]
    if isinstance(detections, Detections3D) and detections.attributes is not None:
        value["attributes"] = detections.attributes.tolist()
    return value


def _columns(decisions: Decisions) -> dict[str, Any]:
    """A column a list, None where unset, as `Decisions.row` has it."""
    columns: dict[str, Any] = {
        "outcome": [Outcome(code).name.lower() for code in decisions.outcome.tolist()],
        "reason": [Reason(code).name.lower() for code in decisions.reason.tolist()],
    }
    for name in _WHOLE:
        columns[name] = [value if value >= 0 else None for value in getattr(decisions, name).tolist()]
    for name in _REAL:
        columns[name] = [None if value != value else value for value in getattr(decisions, name).tolist()]
    return columns


def _from_row(row: dict[str, Any]) -> FusedDetections:
    value = {name: row[name] for name in ("cameras", "notes", "camera_inputs")}
    for name in ("detections", "lidar_inputs"):
        value[name] = {key: column for key, column in row[name].items() if column is not None}
    for name in ("lidar", "camera"):
        names = [column.name for column in fields(Decisions)]
        columns = [row[name][column] for column in names]
        value[name] = [dict(zip(names, cells, strict=True)) for cells in zip(*columns, strict=True)]
    if row["tracks"] is not None:
        value["tracks"] = row["tracks"]
    return FusedDetections.from_json(value)


def _detection_rows(frame_id: str, fused: FusedDetections) -> Iterator[dict[str, Any]]:
    found = fused.detections
    reasons = np.full(len(found), -1)
    for table in (fused.camera, fused.lidar):
        led = table.output >= 0
        reasons[table.output[led]] = table.reason[led]
    names = ("x", "y", "z", "length", "width", "height", "yaw")
    outcomes = fused.outcomes
    for i in range(len(found)):
        velocity = (None, None)
        if found.velocities is not None and not np.isnan(found.velocities[i]).any():
            velocity = tuple(found.velocities[i].tolist())
        yield {
            "frame": frame_id,
            "output": i,
            "class_name": found.class_names[found.labels[i]],
            "score": float(found.scores[i]),
            **dict(zip(names, found.boxes[i].tolist(), strict=True)),
            "velocity_x": velocity[0],
            "velocity_y": velocity[1],
            "attribute": None if found.attributes is None else str(found.attributes[i]) or None,
            "outcome": Outcome(outcomes[i]).name.lower(),
            # boxes that only the memory of past frames predicts have none
            "reason": None if reasons[i] < 0 else Reason(reasons[i]).name.lower(),
            "explanation": fused.explain(i),
            "track": None if fused.tracks is None else int(fused.tracks.ids[i]),
        }

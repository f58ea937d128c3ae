"""Fused detections of many frames as two parquet tables: one row an output, and one row a frame with all its reasons.

The schema, version `SCHEMA`, is in docs/fleet.md. Numbers are exact, where the JSON files of a run folder round them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

from lcf3d.decisions import REAL, WHOLE, Decisions, TrackTable
from lcf3d.errors import ConfigError, FormatError
from lcf3d.files import atomic_path, reading, shortened
from lcf3d.provenance import FusedDetections
from lcf3d.remote.places import fetched

SCHEMA = "1"
_KEY = b"lcf3d.schema"


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
        *((name, pa.list_(pa.int64())) for name in WHOLE),
        *((name, pa.list_(pa.float64())) for name in REAL),
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
    from lcf3d.formats.fused_columns import frame_table

    _write(path, frame_table(frames, frame_schema()))


def write_detections(path: Path, frames: Sequence[tuple[str, FusedDetections]]) -> None:
    """Write the table of outputs, whole or not at all."""
    from lcf3d.formats.fused_columns import detection_table

    _write(path, detection_table(frames, detection_schema()))


def _write(path: Path, table: Any) -> None:
    with atomic_path(path) as temporary:
        arrow().parquet.write_table(table, temporary, compression="zstd")


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
            file = pa.parquet.ParquetFile(fetched(path))
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

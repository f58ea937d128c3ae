"""Tables made column by column against the same tables made row by row from what `to_json` gives."""

import os
import subprocess
import sys
import tempfile
from dataclasses import fields, replace

import numpy as np
import pytest

from lcf3d.decisions import Decisions, TrackTable
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import OUTCOMES, REASONS
from lcf3d.structures import Detections2D, Detections3D

pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow: pip install 'lcf3d[fleet]'")

from lcf3d.formats.fused_columns import detection_table, frame_table  # noqa: E402
from lcf3d.formats.fused_table import detection_schema, frame_schema  # noqa: E402


def made_up(seed: int, outputs: int, names: tuple[str, ...], cameras: int, more: bool) -> FusedDetections:
    """A frame in which every output comes from the LiDAR detection of its number, and others are dropped."""
    rng = np.random.default_rng(seed)
    n = outputs + 2

    def boxes(count: int) -> Detections3D:
        velocities = rng.normal(size=(count, 2)).round(3)
        velocities[::2] = np.nan
        return Detections3D(
            rng.uniform(1, 5, (count, 7)).round(4),
            rng.uniform(0, 1, count).round(6),
            rng.integers(0, len(names), count),
            names,
            velocities if more else None,
            np.array(["", "moving"] * count)[:count] if more else None,
        )

    def views() -> Detections2D:
        return Detections2D(rng.uniform(1, 5, (3, 4)).round(4), [0.5, 0.25, 0.125], [0, 0, 0], names)

    lidar, camera = Decisions.blank(n), Decisions.blank(3 * cameras)
    lidar.output[:outputs], lidar.outcome[:outputs], lidar.lidar[:] = np.arange(outputs), 2, np.arange(n)
    lidar.reason[:] = rng.integers(0, len(REASONS), n)
    lidar.iou[::2], lidar.lidar_score[:] = 0.5, rng.uniform(0, 1, n)
    camera.camera[:], camera.detection[:] = np.repeat(np.arange(cameras), 3), np.tile(np.arange(3), cameras)
    camera.camera_score[:] = 0.5
    tracks = None
    if more:
        columns = [rng.uniform(0, 3, outputs).round(2) for _ in fields(TrackTable)]
        tracks = TrackTable(columns[0].astype(int), columns[1], columns[2].astype(int), columns[3] * 0, *columns[4:])
    inputs = tuple(views() for _ in range(cameras))
    cameras_named = tuple(f"camera{c}" for c in range(cameras))
    return FusedDetections(boxes(outputs), lidar, camera, boxes(n), inputs, cameras_named, ("note",) * more, tracks)


FRAMES = [
    ("a", made_up(0, 3, ("Car", "Person"), 1, more=False)),
    ("b", made_up(1, 0, ("Car", "Person"), 0, more=False)),
    ("c", made_up(2, 4, ("Van",), 2, more=True)),
]


@pytest.mark.parametrize("frames", [FRAMES, FRAMES[:1], []], ids=["mixed", "one", "none"])
def test_frames_column_by_column_are_those_row_by_row(frames):
    rows = []
    for frame_id, fused in frames:
        value = fused.to_json()
        for name in ("lidar", "camera"):
            table = getattr(fused, name)
            value[name] = {column.name: [row[column.name] for row in table.rows()] for column in fields(table)}
        for found, plain in ((fused.detections, value["detections"]), (fused.lidar_inputs, value["lidar_inputs"])):
            # the JSON files round them
            plain["boxes"], plain["scores"] = found.boxes.tolist(), found.scores.tolist()
        value["tracks"] = None if fused.tracks is None else {k: v.tolist() for k, v in vars(fused.tracks).items()}
        rows.append({"frame": frame_id, **value})
    expected = pyarrow.Table.from_pylist(rows, schema=frame_schema())
    assert frame_table(frames, frame_schema()).equals(expected, check_metadata=True)


@pytest.mark.parametrize("frames", [FRAMES, []], ids=["mixed", "none"])
def test_outputs_column_by_column_are_those_row_by_row(frames):
    rows = []
    for frame_id, fused in frames:
        found = fused.detections
        for i in range(len(fused)):
            velocity = (None, None) if found.velocities is None else found.velocities[i].tolist()
            known = velocity[0] is not None and not np.isnan(velocity).any()
            rows.append(
                {
                    "frame": frame_id,
                    "output": i,
                    "class_name": found.class_names[found.labels[i]],
                    "score": found.scores[i],
                    **dict(zip(("x", "y", "z", "length", "width", "height", "yaw"), found.boxes[i], strict=True)),
                    "velocity_x": velocity[0] if known else None,
                    "velocity_y": velocity[1] if known else None,
                    "attribute": None if found.attributes is None else str(found.attributes[i]) or None,
                    "outcome": OUTCOMES[fused.outcomes[i]],
                    "reason": REASONS[fused.lidar.reason[i]],
                    "explanation": fused.explain(i),
                    "track": None if fused.tracks is None else fused.tracks.ids[i],
                }
            )
    expected = pyarrow.Table.from_pylist(rows, schema=detection_schema())
    assert detection_table(frames, detection_schema()).equals(expected, check_metadata=True)


def test_boxes_that_are_not_finite_stay_what_they_are():
    frame = made_up(3, 1, ("Car",), 1, more=False)
    boxes = frame.lidar_inputs.boxes.copy()
    boxes[-1, 2] = np.nan
    inputs = Detections3D(boxes, frame.lidar_inputs.scores, frame.lidar_inputs.labels, ("Car",))
    found = frame_table([("a", replace(frame, lidar_inputs=inputs))], frame_schema()).to_pylist()
    np.testing.assert_array_equal(found[0]["lidar_inputs"]["boxes"], boxes)


def test_columns_are_made_without_pandas():
    program = f"""
import sys
import lcf3d.formats.fused_table as tables
from tests.formats.test_fused_columns import FRAMES
from pathlib import Path
tables.write_frames(Path(sys.argv[1]) / "a.parquet", FRAMES)
tables.write_detections(Path(sys.argv[1]) / "b.parquet", FRAMES)
assert len(list(tables.read_frames(Path(sys.argv[1]) / "a.parquet"))) == {len(FRAMES)}
print("pandas" in sys.modules)
"""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", program, folder], env=env, stdout=subprocess.PIPE, text=True, check=True
        )
    assert done.stdout.split() == ["False"]

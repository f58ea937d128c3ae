"""The very command of docs/paper.md: every table on simulated frames of both layouts, with weights filled by rule."""

import json

import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app

pytest.importorskip("embreex")
pytest.importorskip("torch")

# a row of each table, and of each kind of step: alone, single, stereo, masks, both ways of a shifted domain
ROWS = {
    "table-1": ("PointPillars", "PointPillars + Faster R-CNN, stereo"),
    "table-2": ("MVXNet",),
    "table-3": ("PointPillars", "PointPillars + DetectoRS"),
    "table-4": ("matching + recovery + semantic fusion",),
    "table-5": ("RGB branch",),
    "table-6": ("Bbox + Mask",),
    "table-7": ("nuscenes -> kitti: BEVFusion", "kitti -> nuscenes: LCF3D"),
    "figure-1": ("LCF3D*",),
    "figure-2": ("kitti -> nuscenes: LCF3D",),
}


def paper(out, *names):
    arguments = [word for name in names for word in ("--row", name)]
    result = CliRunner().invoke(app, ["paper", "--rehearse", "--out", str(out), "--json", *arguments])
    assert result.exit_code == 0, result.output or result.exception
    found = json.loads(result.stdout[result.stdout.index("[\n" if len(names) > 2 else "{\n") :])
    return {table["table"]: {row["name"]: row for row in table["rows"]} for table in found}


def test_every_table_in_one_go_which_goes_on_where_it_was(tmp_path):
    tables = paper(tmp_path, *dict.fromkeys(name for names in ROWS.values() for name in names))
    assert set(tables) == set(ROWS)
    for name, rows in tables.items():
        for row in rows.values():
            if (name, row["name"]) == ("table-5", "MVXNet"):
                continue
            values = row["measured"]
            assert row["frames"] == 1, (name, row)
            there = [value is not None for column, value in values.items() if column != "FPS"]
            # in the front view of a single frame of nuScenes a class may have nobody
            assert any(there) if name == "figure-2" else all(there), (name, row)
            for column, value in row["paper"].items():
                if value is not None and values[column] is not None:
                    assert row["difference"][column] == pytest.approx(values[column] - value, abs=1e-6)
    # all cameras of nuScenes, and both of the pair, are looked through once for all rows
    kept = list((tmp_path / "detections").glob("**/*.npz"))
    assert sum("maskrcnn-nuscenes" in str(path) for path in kept) == 6
    assert sum("/right/" in str(path) for path in kept) == 1
    assert (tmp_path / "table-7.md").is_file()

    times = {path: path.stat().st_mtime_ns for path in kept}
    again = paper(tmp_path, "LCF3D*", "Bbox + Mask", "kitti -> nuscenes: LCF3D")
    assert again["figure-1"] == tables["figure-1"]
    assert again["table-7"]["kitti -> nuscenes: LCF3D"] == tables["table-7"]["kitti -> nuscenes: LCF3D"]
    assert {path: path.stat().st_mtime_ns for path in kept} == times

"""The very commands of docs/paper.md on simulated frames, with weights filled by rule."""

import json

import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app

pytest.importorskip("embreex")


def paper(*arguments):
    result = CliRunner().invoke(app, ["paper", *arguments, "--rehearse", "--json"])
    assert result.exit_code == 0, result.output
    return {row["name"]: row for row in json.loads(result.stdout[result.stdout.index("{") :])["rows"]}


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti") / "sim"
    result = CliRunner().invoke(app, ["simulate", str(root), "--frames", "2", "--preset", "train_mono"])
    assert result.exit_code == 0, result.output
    return root


def test_single_modal_rows_on_kitti(kitti, tmp_path):
    names = ("PointPillars", "PointPillars + Faster R-CNN, single")
    rows = paper("table-1", "--kitti", str(kitti), "--out", str(tmp_path), *[w for n in names for w in ("--row", n)])
    for name in names:
        assert rows[name]["frames"] == 1
        assert all(value is not None for value in rows[name]["measured"].values()), rows[name]["notes"]
    # both rows and the pure cascade look at the image once
    kept = list((tmp_path / "detections").glob("*fasterrcnn-r101-kitti*/left/*.npz"))
    assert len(kept) == 1
    written = kept[0].stat().st_mtime_ns
    cascade = paper("table-4", "--kitti", str(kitti), "--out", str(tmp_path), "--row", "recovery")["recovery"]
    assert cascade["measured"]["FPS"] > 0
    assert kept[0].stat().st_mtime_ns == written


def test_domain_shift_row(kitti, tmp_path):
    name = "kitti -> kitti: PointPillars"
    row = paper("table-7", "--kitti", str(kitti), "--out", str(tmp_path), "--row", name)[name]
    assert row["frames"] == 1
    assert all(value is not None for value in row["measured"].values()), row["notes"]

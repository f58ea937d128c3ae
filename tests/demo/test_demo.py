import json

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.demo.drive import demo_frames, run_demo
from lcf3d.demo.sensors import BEAMS, COLUMNS, ELEVATION, cameras, cast, photograph, scan
from lcf3d.demo.street import GROUND_Z, Drive
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes


@pytest.fixture(scope="module")
def street():
    return Drive(0).street(3)


def test_ray_at_a_cube_by_hand():
    cube = np.array([[10.0, 0, 0, 2, 2, 2, np.pi / 4]])
    rays = np.array([[[1.0, 0, 0], [0, 1, 0]], [[2, 0.2, 0], [-1, 0, 0]]])
    depth, hit, _ = cast(np.zeros(3), rays, cube, np.array([[0, 1, 0, 1]]))
    # the turned cube's edge points at the sensor, sqrt(2) before its centre
    assert depth[0, 0] == pytest.approx(10 - np.sqrt(2))
    assert hit.tolist() == [[0, -1], [-1 if np.isinf(depth[1, 0]) else 0, -1]]
    assert np.isinf(depth[0, 1])
    assert np.isinf(depth[1, 1])


def test_windows_leave_out_no_hit(street):
    """Casting every ray at every cuboid gives the same scan as casting within the windows."""
    _, owner = scan(street, np.random.default_rng(0))
    azimuth = np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False)
    cos_e, sin_e = np.cos(ELEVATION)[:, None], np.sin(ELEVATION)[:, None]
    grid = np.stack(
        [cos_e * np.cos(azimuth), cos_e * np.sin(azimuth), np.broadcast_to(sin_e, (BEAMS, COLUMNS))], axis=2
    )
    parts = street.parts[street.owner >= 0]
    everywhere = np.tile([0, BEAMS - 1, 0, COLUMNS - 1], (len(parts), 1))
    depth, hit, _ = cast(np.zeros(3), np.ascontiguousarray(grid), parts, everywhere)
    on_ground = np.where(grid[..., 2] < 0, GROUND_Z / np.minimum(grid[..., 2], -1e-9), np.inf) < depth
    owner_everywhere = np.where(on_ground | (hit < 0), -1, street.owner[street.owner >= 0][np.maximum(hit, 0)])
    in_range = owner_everywhere[depth < 75]
    expected = np.bincount(in_range[in_range >= 0], minlength=len(street.kinds))
    got = np.bincount(owner[owner >= 0], minlength=len(street.kinds))
    # six in a hundred returns are lost on purpose
    assert (got <= expected).all()
    assert got.sum() > 0.9 * expected.sum()


def test_every_return_lies_in_its_box(street):
    points, owner = scan(street, np.random.default_rng(0))
    grown = street.boxes.copy()
    grown[:, 3:6] += 0.25  # shapes lean out of their boxes by their mirrors and arms, ranges are noisy
    inside = points_in_boxes(points, grown)
    rows = np.flatnonzero(owner >= 0)
    assert inside[owner[rows], rows].mean() > 0.999
    ground = points[owner < 0]
    assert np.abs(ground[:, 2] - GROUND_Z).max() < 0.1


def test_pixels_of_a_thing_lie_in_its_projection(street):
    for view in cameras():
        _, seen = photograph(street, view, np.random.default_rng(0))
        boxes, visible = project_boxes(street.boxes, view)
        for thing in np.unique(seen[seen >= 0]):
            rows, columns = np.nonzero(seen == thing)
            assert visible[thing]
            assert columns.min() >= boxes[thing, 0] - 3
            assert columns.max() <= boxes[thing, 2] + 3
            assert rows.min() >= boxes[thing, 1] - 3


def test_the_same_seed_gives_the_same_bytes():
    one, two = (next(demo_frames(1, seed=7)) for _ in range(2))
    assert one.frame.points.tobytes() == two.frame.points.tobytes()
    assert one.frame.images["front_left"].tobytes() == two.frame.images["front_left"].tobytes()
    assert one.lidar.boxes.tobytes() == two.lidar.boxes.tobytes()
    other = next(demo_frames(1, seed=8))
    assert other.frame.points.tobytes() != one.frame.points.tobytes()


def test_fusion_beats_the_lidar_alone():
    result = run_demo(list(demo_frames(6)))
    alone, full = result.metrics["LiDAR alone"], result.metrics["matching + recovery"]
    assert full.mean_ap > alone.mean_ap + 0.1
    stages = np.concatenate([fused.stages for fused in result.fused])
    assert set(stages.tolist()) >= {0, 1}  # matched and recovered
    assert any(len(fused.dropped_lidar) for fused in result.fused)


def test_command(tmp_path):
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "d"), "--frames", "2", "--json"])
    assert result.exit_code == 0, result.output
    assert set(json.loads(result.stdout)["variants"]) == {"LiDAR alone", "matching", "matching + recovery"}
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["000000.png", "000001.png", "drive.gif"]

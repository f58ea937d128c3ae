import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.errors import ConfigError, MissingExtraError
from lcf3d.simulation import all_presets, embree, get_preset, simulate_frame
from lcf3d.simulation.actors import KINDS, KITTI_CLASS, NUSCENES_CLASS, Motion, make_actor
from lcf3d.simulation.frames import make_stage, simulate_drive
from lcf3d.simulation.lidar import beam_directions, scan
from lcf3d.simulation.patterns import road_mark
from lcf3d.simulation.rays import RayTracer
from lcf3d.simulation.roads import Path, Terrain
from lcf3d.simulation.scene import build_scene
from lcf3d.simulation.textures import texture_ids, texture_pyramids

from .conftest import tiny


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dataset", ["kitti", "nuscenes"])
def test_every_mesh_stays_in_its_box_and_nearly_fills_it(kind, dataset):
    rng = np.random.default_rng(4)
    path = Path((0.0, 0.0), 0.0, 0.0, 50.0)
    for speed in (0.0, 1.4):
        actor = make_actor(1, kind, Motion(path, 10.0, 0.0, speed), rng, dataset)
        length, width, height = actor.size
        for time in (0.0, 0.3, 0.7):
            low, high = actor.mesh_at(time).bounds()
            assert (low >= np.array([-length / 2, -width / 2, 0]) - 1e-4).all()
            assert (high <= np.array([length / 2, width / 2, height]) + 1e-4).all()
            assert high[2] - low[2] > 0.93 * height
            if kind not in ("pedestrian", "cyclist"):
                np.testing.assert_allclose(high - low, actor.size, rtol=1e-4)
    assert NUSCENES_CLASS[kind]
    assert kind in KITTI_CLASS


@pytest.mark.parametrize("kind", ["pedestrian", "cyclist"])
def test_varied_people_stay_in_their_boxes_and_differ(kind):
    rng = np.random.default_rng(8)
    path = Path((0.0, 0.0), 0.0, 0.0, 50.0)
    sizes, colours = set(), set()
    for k in range(25):
        actor = make_actor(1, kind, Motion(path, 10.0, 0.0, 1.4 * (k % 2)), rng, varied=True)
        length, width, height = actor.size
        for time in (0.0, 0.4):
            mesh = actor.mesh_at(time)
            low, high = mesh.bounds()
            assert (low >= np.array([-length / 2, -width / 2, 0]) - 1e-4).all()
            assert (high <= np.array([length / 2, width / 2, height]) + 1e-4).all()
            assert high[2] - low[2] > 0.93 * height
        sizes.add(len(mesh))
        colours.add(tuple(mesh.colour.mean(axis=0).round(3).tolist()))
    assert len(sizes) > 4
    assert len(colours) > 15


@settings(max_examples=30, deadline=None)
@given(heading=st.floats(-3, 3), bend=st.floats(-0.01, 0.01), s=st.floats(0, 90))
def test_paths_have_unit_speed_and_left_is_left(heading, bend, s):
    path = Path((3.0, -2.0), heading, -10.0, 100.0, bend)
    x, y, h = path.at(s)
    x2, y2, _ = path.at(s + 1.0)
    assert np.hypot(x2 - x, y2 - y) == pytest.approx(1.0, abs=1e-3)
    left = path.at(s, 2.0)
    np.testing.assert_allclose([left[0] - x, left[1] - y], [-2 * np.sin(h), 2 * np.cos(h)], atol=1e-9)


def test_path_pieces_leave_out_gaps():
    path = Path((0.0, 0.0), 0.0, 0.0, 100.0)
    assert path.pieces(0, 100, [(20, 30), (60, 70)]) == [(0, 20), (30, 60), (70, 100)]
    assert path.pieces(0, 100, [(-5, 10), (95, 120)]) == [(10, 95)]


def test_terrain_slope_stays_below_one_per_cent():
    terrain = Terrain((0.3, 2.0, 4.0), 0.12)
    x = np.linspace(-200, 200, 2001)
    for y in (-30.0, 0.0, 25.0):
        assert np.abs(np.gradient(terrain.height(x, y), x)).max() < 0.01
        assert np.abs(np.gradient(terrain.height(y, x), x)).max() < 0.01


def test_road_marks_are_where_the_numbers_say():
    far = [1e6, 0.0] * 3
    road = np.array([3.5, 2, 1, 0, 1e6, 0, *far], dtype=np.float32)  # solid centre line, edge lines
    assert road_mark(10.0, 0.0, road, 0.01) > 0.8
    assert road_mark(10.0, 3.5 - 0.22, road, 0.01) > 0.8
    assert road_mark(10.0, 1.5, road, 0.01) == 0
    dashed = np.array([3.5, 1, 0, 0, 1e6, 0, *far], dtype=np.float32)
    assert road_mark(1.5, 0.0, dashed, 0.01) > 0.8
    assert road_mark(6.0, 0.0, dashed, 0.01) == 0
    zebra = np.array([3.5, 0, 0, 0, 20.0, 0, *far], dtype=np.float32)
    across = [road_mark(20.0, t, zebra, 0.01) for t in np.linspace(-3, 3, 121)]
    assert 0.3 < np.mean(across) < 0.65


def test_textures_are_seamless_levels_of_mean_one():
    ids, pyramid = texture_ids(), texture_pyramids()
    assert pyramid.shape[0] == len(ids)
    for name, k in ids.items():
        if name != "plate":
            np.testing.assert_allclose(pyramid[k, -1], 1, atol=1e-3)  # the last level is a single texel
    assert np.isfinite(pyramid).all()


def test_rays_meet_a_wall_at_its_distance_and_are_blocked_only_within_reach():
    wall = np.array([[[5, -10, -10], [5, 10, -10], [5, 0, 20]]], dtype=np.float64)
    tracer = RayTracer(wall)
    ahead, back = np.array([[1.0, 0, 0]]), np.array([[-1.0, 0, 0]])
    hits = tracer.first_hits(np.zeros(3), np.concatenate([ahead, back]))
    assert hits.triangle.tolist() == [0, -1]
    assert hits.distance[0] == pytest.approx(5.0)
    assert tracer.is_blocked(np.zeros(3), ahead).tolist() == [True]
    assert tracer.is_blocked(np.zeros(3), ahead, 4.0).tolist() == [False]
    assert tracer.is_blocked(np.zeros(3), np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("count", [1, 300])
def test_embree_itself_and_embreex_give_the_same_bits(count, monkeypatch):
    rng = np.random.default_rng(count)
    soup = (rng.normal(0, 20, (count, 1, 3)) + rng.normal(0, 3, (count, 3, 3))).astype(np.float32)
    direction = rng.normal(size=(4000, 3)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origins = rng.normal(0, 5, (4000, 3)).astype(np.float32)
    assert embree.library() is not None
    ours = RayTracer(soup)
    monkeypatch.setattr(embree, "library", lambda: None)
    theirs = RayTracer(soup)
    assert type(ours._tree) is not type(theirs._tree)
    for origin in (origins, origins[0]):
        a, b = (tracer.first_hits(origin, direction) for tracer in (ours, theirs))
        assert count == 1 or 0.1 < (a.triangle >= 0).mean() < 1
        for name in ("triangle", "distance", "u", "v"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        for reach in (10.0, 1e4):
            blocked = ours.is_blocked(origin, direction, reach)
            np.testing.assert_array_equal(blocked, theirs.is_blocked(origin, direction, reach))
            # the same question answered by distances
            np.testing.assert_array_equal(blocked, (a.triangle >= 0) & (a.distance <= reach))


def test_a_scan_has_the_beams_of_its_table():
    preset = tiny("kitti64")
    frame = simulate_frame(preset, 1, 0, images=False)
    scene = frame.scene
    result = scan(preset.lidar, make_stage(scene, preset, 0.0), (0.0, 0.0), 0.0, np.random.default_rng(0))
    distance = np.linalg.norm(result.points[:, :3], axis=1)
    elevation = np.degrees(np.arcsin(result.points[:, 2] / distance))
    expected = np.array(preset.lidar.elevations_deg)[result.ring]
    np.testing.assert_allclose(elevation, expected, atol=0.01)
    assert (np.diff(result.ring) <= 0).all()  # from the top ring down
    assert distance.max() < preset.lidar.max_range_m
    assert result.points.dtype == np.float32
    assert ((result.points[:, 3] >= 0) & (result.points[:, 3] < 1)).all()
    directions, ring, time = beam_directions(preset.lidar)
    assert len(directions) == 64 * 300
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-5)
    assert time.min() > -0.0501
    assert time.max() < 0.0501
    assert np.bincount(ring).tolist() == [300] * 64


def test_a_moving_car_sees_still_things_where_they_are():
    preset = tiny("kitti64")
    scene = simulate_frame(preset, 1, 0, images=False).scene
    stage = make_stage(scene, preset, 0.0)
    still = scan(preset.lidar, stage, (0.0, 0.0), 0.0, np.random.default_rng(0))
    moving = scan(preset.lidar, stage, (20.0, 0.0), 0.0, np.random.default_rng(0))
    # the same flat road, although the sensor travels two metres during the turn
    for points in (still.points, moving.points):
        points = points[(np.abs(points[:, 1]) < 2) & (np.hypot(points[:, 0], points[:, 1]) < 8)]
        assert np.abs(np.median(points[:, 2]) + preset.lidar.height_m) < 0.06
    assert not np.array_equal(still.points[:100], moving.points[:100])


def test_rain_loses_far_returns_and_night_darkens_images():
    dry, wet = (simulate_frame(tiny(n), 7, 0, images=False, street="city") for n in ("kitti64", "rain"))
    far = [np.count_nonzero(np.linalg.norm(f.scan.points[:, :3], axis=1) > 30) for f in (dry, wet)]
    assert far[1] < 0.9 * far[0]
    droplets = [np.count_nonzero(np.linalg.norm(f.scan.points[:, :3], axis=1) < 3) for f in (dry, wet)]
    assert droplets[1] > droplets[0]
    lit = [simulate_frame(tiny(n), 7, 0, street="city").renders["left"].image.mean() for n in ("kitti64", "night")]
    assert lit[1] < 0.75 * lit[0]


def test_sparse_has_a_quarter_of_the_beams():
    assert len(get_preset("sparse16").lidar.elevations_deg) == 16
    assert set(all_presets()) == {
        "kitti64",
        "mono64",
        "nuscenes32",
        "nuscenes_sweeps",
        "sparse16",
        "rain",
        "night",
        "train_kitti",
        "train_mono",
        "train_nuscenes",
    }


def test_equal_seeds_give_equal_scenes_and_frames():
    a, b, c = (simulate_frame(tiny("kitti64"), seed, 0, threads=t) for seed, t in ((9, 2), (9, 1), (10, 2)))
    np.testing.assert_array_equal(a.scan.points, b.scan.points)
    np.testing.assert_array_equal(a.renders["right"].image, b.renders["right"].image)
    np.testing.assert_array_equal(a.kitti.boxes2d, b.kitti.boxes2d)
    assert a.scan.points.shape != c.scan.points.shape or not np.array_equal(a.scan.points, c.scan.points)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": "kitti128"}, "unknown preset 'kitti128'"),
        ({"street": "moon"}, "unknown street 'moon'"),
        ({"density": 0.0}, "density must lie above 0"),
        ({"seed": -1}, "must not be negative"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        simulate_frame(**arguments)


def test_a_street_that_cannot_hold_its_road_users_is_refused():
    with pytest.raises(ConfigError, match="found a free place"):
        build_scene(np.random.default_rng(0), street="country", density=100.0)


def test_an_empty_drive_and_a_bad_scale_are_refused():
    with pytest.raises(ConfigError, match="at least one frame"):
        next(simulate_drive(frames=0))
    with pytest.raises(ConfigError, match="image scale"):
        get_preset("kitti64").resized(2.0)


def test_missing_embree_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "embreex", None)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(MissingExtraError, match=r"lcf3d\[simulate\]"):
        RayTracer(np.zeros((1, 3, 3)))

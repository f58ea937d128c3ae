"""The worlds of the training presets: more people, uneven ground, things mistaken for people, measured intensities."""

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.simulation.clutter import MAKERS, thing
from lcf3d.simulation.frames import make_stage, sensor_pose, simulate_frame
from lcf3d.simulation.kitti_layout import write_splits
from lcf3d.simulation.materials import MATERIAL_ID
from lcf3d.simulation.photo import NEUTRAL, Photo, draw_photo
from lcf3d.simulation.response import respond
from lcf3d.simulation.roads import Terrain, make_terrain
from lcf3d.simulation.scene import build_scene
from lcf3d.simulation.worlds import PLAIN, RICH, Mounting, level_from_tilted

from .conftest import tiny

PEOPLE = ("pedestrian", "sitting")
RIDERS = ("cyclist", "motorcyclist")


@pytest.fixture(scope="module")
def rich():
    """Frames of the training preset in every kind of street."""
    return [
        simulate_frame(tiny("train_kitti"), 6, k, street=s) for k, s in enumerate(("residential", "city", "country"))
    ]


def test_a_tilted_frame_is_levelled_without_a_turn():
    up = np.array([-0.3, -0.4, 1.2]) / 1.3
    level = level_from_tilted(up)
    np.testing.assert_allclose(level @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
    assert (level @ [1, 0, 0])[1] == pytest.approx(0, abs=1e-12)  # ahead stays ahead


def test_a_mounting_gives_the_ground_the_slopes_it_names():
    height, level = Mounting((0.1, 0.0), (0.05, 0.0), (-0.02, 0.0)).draw(np.random.default_rng(0))
    assert height == pytest.approx(0.1)
    ground = np.array([[x, y, 0.05 * x - 0.02 * y] for x, y in ((1.0, 0.0), (0.0, 1.0), (-30.0, 12.0))])
    np.testing.assert_allclose((ground @ level.T)[:, 2], 0, atol=1e-12)
    drawn = np.array([Mounting().draw(np.random.default_rng(k))[1][2] for k in range(400)])
    slopes = -drawn[:, :2] / drawn[:, 2:]
    np.testing.assert_allclose(slopes.mean(axis=0), [0.0075, -0.006], atol=0.002)
    np.testing.assert_allclose(slopes.std(axis=0), [0.008, 0.015], rtol=0.15)


def test_the_sensors_ride_smoothly_and_stay_at_their_height_above_the_road():
    preset = tiny("train_kitti")
    scene = build_scene(np.random.default_rng(1), duration=1.0, world=preset.world)
    poses = [sensor_pose(scene, preset, t) for t in np.linspace(0, 1, 21)]
    for pose in poses:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert pose[2, 2] > 0.995
        road = scene._heights(pose[None, :2, 3])[0]
        assert abs(pose[2, 3] - road - preset.lidar.height_m) < 0.2
    turns = [np.abs(a[:3, 2] - b[:3, 2]).max() for a, b in itertools.pairwise(poses)]
    assert 0 < max(turns) < 0.02


def test_uneven_land_rolls_and_plain_land_stays_as_it_was():
    assert make_terrain(np.random.default_rng(0)).hollows == (0.0, 0.0, 0.0)
    x = np.linspace(-60, 60, 121)
    spans = [np.ptp(make_terrain(np.random.default_rng(k), 0.9).height(x, 0.0)) for k in range(30)]
    assert 0.5 < np.median(spans) < 4.0
    up = Terrain((0.0, 0.0, 0.0), 0.0, (1e-12, 0.0, 0.0), (0.1, 0.0)).normal(3.0, 4.0)
    np.testing.assert_allclose(up, np.array([-0.1, 0, 1]) / np.hypot(0.1, 1), atol=1e-9)


def test_training_streets_have_several_times_more_people_and_riders_near_the_sensors():
    counts = {}
    for name, world in (("plain", PLAIN), ("rich", RICH)):
        total = Counter()
        for seed in range(12):
            scene = build_scene(np.random.default_rng(seed), street="residential", world=world)
            for actor in scene.actors:
                x, y, _ = actor.motion.pose(0.0)
                total[actor.kind] += np.hypot(x, y) < 50
        counts[name] = total
    plain, rich = counts["plain"], counts["rich"]
    assert sum(rich[k] for k in PEOPLE) > 2.5 * sum(plain[k] for k in PEOPLE)
    assert sum(rich[k] for k in RIDERS) > 2.5 * sum(plain[k] for k in RIDERS)
    assert rich["sitting"] + rich["van"] + rich["truck"] > plain["sitting"] + plain["van"] + plain["truck"]


def test_boxes_hold_their_returns_on_uneven_ground(rich):
    held = total = 0
    for frame in rich:
        boxes = frame.boxes.copy()
        boxes[:, 3:6] += 0.2  # boxes stay upright, vehicles and the sensors tilt
        inside = points_in_boxes(frame.scan.points, boxes)
        for k, actor in enumerate(frame.actors):
            own = frame.scan.owner == actor.id
            held += inside[k, own].sum()
            total += own.sum()
    assert total > 300
    assert held / total > 0.985


def test_everybody_stands_on_the_ground(rich):
    for frame in rich:
        scene = frame.scene
        boxes = scene.boxes(0.0)
        bottoms = boxes[:, 2] - boxes[:, 5] / 2
        gap = bottoms - scene._heights(boxes[:, :2])
        wide = np.array([a.kind in ("car", "van", "truck", "bus", "tram", "trailer") for a in scene.actors])
        assert np.abs(gap[~wide]).max() < 0.13  # a kerb may run below a footprint
        assert np.median(np.abs(gap)) < 0.03
        assert np.abs(gap).max() < 0.25


def test_label_boxes_bound_the_whole_object(rich):
    checked = hidden = 0
    for frame in rich:
        objects, camera, seen = frame.kitti, frame.preset.cameras[0], frame.sightings["left"]
        projected, _ = project_boxes(frame.boxes, camera)
        for name, box, level in zip(objects.class_names, objects.boxes2d, objects.occluded, strict=True):
            if name in ("Car", "Van", "Truck", "Cyclist"):
                assert np.abs(projected - box).max(axis=1).min() < 1e-9
                checked, hidden = checked + 1, hidden + (level > 0)
            if name == "Pedestrian":  # as high as the projected box, as wide as the outline
                rows = np.abs(projected[:, [1, 3]] - box[[1, 3]]).max(axis=1) < 1e-9
                assert (rows & (projected[:, 0] <= box[0] + 1e-9) & (projected[:, 2] >= box[2] - 1e-9)).any()
        for k, actor in enumerate(frame.actors):
            if actor.kind == "pedestrian" and seen.pixels[k]:
                assert (seen.amodal[k, [0, 1]] <= seen.boxes2d[k, [0, 1]] + 1.5).all()
                assert (seen.amodal[k, [2, 3]] >= seen.boxes2d[k, [2, 3]] - 1.5).all()
    assert checked > 5
    assert hidden > 0


def test_clutter_stands_on_the_ground_and_is_finite():
    rng = np.random.default_rng(3)
    for _, make in MAKERS:
        for _ in range(4):
            mesh = make(rng)
            low, high = mesh.bounds()
            assert np.isfinite(mesh.corners).all()
            assert -0.6 < low[2] < 0.3  # leaves may hang lower than a stem
            assert 0.3 < high[2] < 9.0
    assert len({len(thing(rng)) for _ in range(40)}) > 10


def test_clutter_belongs_to_nobody_and_keeps_its_distance_from_the_road():
    bare = build_scene(np.random.default_rng(5), street="city", world=replace(RICH, clutter=0.0))
    full = build_scene(np.random.default_rng(5), street="city", world=replace(RICH, clutter=30.0))
    extra = len(full.static) - len(bare.static)
    assert extra > 1000
    added = full.static.corners[-extra:].reshape(-1, 3)
    assert (make_stage(full, tiny("train_kitti"), 0.0).owner[: len(full.static)] == 0).all()
    low = added[added[:, 2] < full.site.terrain.height(added[:, 0], added[:, 1]) + 1.5]
    s = np.arange(full.site.first, full.site.last, 0.5)
    x, y, _ = full.site.path.at(s)
    gap = np.sqrt(((low[::7, None, :2] - np.stack([x, y], axis=1)) ** 2).sum(axis=2)).min(axis=1)
    assert (gap > full.site.street.half_width - 2.2).mean() > 0.97


def test_intensities_follow_material_and_beam():
    n = 4000
    ideal = np.full(n, 0.5, dtype=np.float32)
    ring = np.arange(n) % 64
    paint = np.full(n, MATERIAL_ID["paint"])
    car = respond(ideal, paint, ring, 64, np.random.default_rng(0))
    assert 0.40 < (car == 0).mean() < 0.52
    cloth = respond(ideal, np.full(n, MATERIAL_ID["cloth"]), ring, 64, np.random.default_rng(0))
    assert (cloth > 0).all()
    by_beam = np.array([cloth[ring == k].mean() for k in range(64)])
    assert np.allclose(cloth, by_beam[ring], atol=1e-6)  # one gain a beam
    assert by_beam.std() > 0.05
    assert cloth.mean() > 1.3 * car[car > 0].mean()


def test_training_scans_differ_from_plain_ones_in_intensity_only_where_asked():
    preset = tiny("train_kitti")
    even = replace(preset, lidar=replace(preset.lidar, uneven_beams=False))
    a, b = (simulate_frame(p, 6, 0, images=False, street="city").scan.points for p in (preset, even))
    assert len(a) == len(b)
    assert (a[:, 3] == 0).mean() > (b[:, 3] == 0).mean() + 0.02


@pytest.mark.parametrize(("frames", "val"), [(1, 1), (2, 1), (4, 1), (5, 1), (9, 1), (10, 2)])
def test_small_sets_have_a_validation_frame(tmp_path, frames, val):
    ids = [f"{k:06d}" for k in range(frames)]
    write_splits(tmp_path, ids, 1)
    train, held = ((tmp_path / "ImageSets" / f"{s}.txt").read_text().split() for s in ("train", "val"))
    assert len(held) == val
    assert sorted({*train, *held}) == ids
    assert len(train) == max(1, frames - val)


def test_a_crowded_narrow_street_is_filled_as_far_as_it_goes():
    scene = build_scene(np.random.default_rng(0), street="country", density=4.5, world=RICH)
    assert len(scene.actors) > 5


def test_a_neutral_photo_changes_nothing_and_others_do_what_they_say():
    rng = np.random.default_rng(0)
    light = rng.random((20, 30, 3)).astype(np.float32)
    np.testing.assert_allclose(NEUTRAL.apply(light), light, atol=1e-6)
    grey = Photo(saturation=0.0).apply(light)
    np.testing.assert_allclose(grey, np.repeat(light.mean(axis=2, keepdims=True), 3, axis=2), rtol=1e-5)
    np.testing.assert_allclose(Photo(balance=(2.0, 1.0, 0.5)).apply(light), light * [2, 1, 0.5], atol=1e-6)
    middle = np.full((4, 4, 3), 0.18, dtype=np.float32)
    np.testing.assert_allclose(Photo(contrast=1.5).apply(middle), middle, rtol=1e-5)
    assert Photo(contrast=1.5).apply(middle / 2).max() < 0.09
    np.testing.assert_allclose(
        Photo(burn=2.0).apply(np.float32([[[0.3, 0.3, 0.3], [1.35] * 3]])), [[[0.3] * 3, [4.05] * 3]]
    )


def test_blur_keeps_the_light_and_fringes_part_red_from_blue():
    spot = np.zeros((15, 15, 3), dtype=np.float32)
    spot[7, 7] = 1.0
    blurred = Photo(blur_px=0.8).apply(spot)
    np.testing.assert_allclose(blurred.sum(axis=(0, 1)), 1, rtol=1e-4)
    assert blurred[7, 7, 0] < 0.5
    apart = Photo(blur_px=0.8, fringe_px=0.5).apply(spot)
    column = np.arange(15)
    centre = [(apart[..., k].sum(axis=0) * column).sum() for k in range(3)]
    np.testing.assert_allclose(np.array(centre) - 7, [0.5, 0.0, -0.5], atol=0.03)


def test_drawn_photos_vary_and_blur_follows_the_scale():
    drawn = [draw_photo(np.random.default_rng(k)) for k in range(60)]
    assert np.std([np.log(p.exposure) for p in drawn]) > 0.2
    assert min(p.shade for p in drawn) < 0.6 < 1.0 < max(p.shade for p in drawn)
    assert draw_photo(np.random.default_rng(3), 0.5).blur_px == pytest.approx(drawn[3].blur_px / 2)

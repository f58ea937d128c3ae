"""Changes of a scan keep points and boxes together, and depend on the generator alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.iou import bev_iou
from lcf3d.training.lidar_augmentation import (
    MOST_POINTS_OF_OBJECT,
    AugmentationSettings,
    augment,
    choose_window,
    collect_objects,
    crop,
    cut_out,
    mirrored,
    scaled,
    tilted,
    turned,
)
from lcf3d.training.lidar_scans import IGNORED
from tests.training.lidar_scenes import AREA, CONFIG, EMPTY, SCENES, scene

AROUND = (-20.0, -20.0, -3.0, 20.0, 20.0, 1.0)


def bright_in(scan):
    """Returns of objects inside each box."""
    return points_in_boxes(scan.points[scan.points[:, 3] > 0.5], scan.boxes).sum(axis=1)


@pytest.mark.parametrize(
    "change", [lambda s: turned(s, 2.0), mirrored, lambda s: scaled(s, 1.05), lambda s: tilted(s, 0, 0, 0.2)]
)
def test_points_stay_in_their_boxes(change):
    assert (bright_in(change(scene(0))) == 40).all()


def test_tilted_ground_carries_the_boxes():
    scan = tilted(scene(0), 0.01, -0.02, 0.1)
    moved = scan.boxes - scene(0).boxes
    np.testing.assert_allclose(moved[:, 2], 0.01 * scan.boxes[:, 1] - 0.02 * scan.boxes[:, 0] + 0.1)
    assert (moved[:, [0, 1, 3, 4, 5, 6]] == 0).all()
    assert (bright_in(scan) >= 36).all()
    heights = [
        augment(scene(0), AROUND, 0.0, None, AugmentationSettings(tilt=tilt, scale=0), np.random.default_rng(1)).boxes
        for tilt in (0.0, 0.01)
    ]
    assert np.ptp(heights[0][:, 2] - heights[0][:, 5] / 2) < 1e-9
    assert np.ptp(heights[1][:, 2] - heights[1][:, 5] / 2) > 0.01


def test_intensities_to_255_change_like_those_to_one():
    counted = scene(0)
    counted.points[:, 3] *= 255
    one, many = (
        augment(scan, AROUND, 1.0, None, AugmentationSettings(), np.random.default_rng(3)).points
        for scan in (scene(0), counted)
    )
    assert 100 < many[:, 3].max() <= 255
    np.testing.assert_allclose(many[:, 3], 255 * one[:, 3], rtol=1e-4, atol=1e-3)


def test_of_many_points_of_an_object_some_of_every_side_are_kept():
    box = np.array([5.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.0])
    along = np.linspace(3.01, 6.99, 4 * MOST_POINTS_OF_OBJECT)
    points = np.column_stack([along, np.full((len(along), 1), 2.0), np.zeros((len(along), 2))]).astype(np.float32)
    kept = cut_out(points, box)
    assert len(kept) == MOST_POINTS_OF_OBJECT
    assert np.diff(kept[:, 0]).max() < 0.01
    assert kept[0, 0] == points[0, 0]
    assert kept[-1, 0] == points[-1, 0]
    np.testing.assert_array_equal(cut_out(points[:100], box), points[:100])


def test_turning_back_gives_the_scan():
    back = turned(turned(scene(1), 1.2), -1.2)
    np.testing.assert_allclose(back.points, scene(1).points, atol=1e-5)
    np.testing.assert_allclose(back.boxes, scene(1).boxes, atol=1e-12)


def test_cropping_ignores_what_reaches_in_from_outside():
    scan = scene(0)
    boxes = scan.boxes.copy()
    boxes[:, :2] = [[5, 0], [-0.2, 0], [24, 3], [-15, 0]]
    cut = crop(replace(scan, boxes=boxes), AREA)
    assert cut.labels.tolist() == [scan.labels[0], IGNORED]
    assert (cut.points[:, 0] > 0).all()


def test_the_same_generator_gives_the_same_scan():
    objects = collect_objects(SCENES, 3, 10)
    scans = [
        augment(scene(2), AREA, np.pi, objects, AugmentationSettings(), np.random.default_rng(5)) for _ in range(2)
    ]
    np.testing.assert_array_equal(scans[0].points, scans[1].points)
    np.testing.assert_array_equal(scans[0].boxes, scans[1].boxes)
    assert scans[0].points[:, 3].min() >= 0
    assert scans[0].points[:, 3].max() <= 1


def test_pasted_objects_have_room_and_their_points():
    objects = collect_objects(SCENES, 3, 10)
    quiet = AugmentationSettings(drop=0, scale=0, intensity_gain=0, intensity_offset=0, intensity_noise=0)
    added = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        before = crop(scene(seed % 6, 0), AROUND)
        scan = augment(before, AROUND, np.pi, objects, quiet, rng)
        added += len(scan.boxes)
        assert (bright_in(scan) == 40).all()
        overlap = bev_iou(scan.boxes, scan.boxes)
        assert overlap[~np.eye(len(overlap), dtype=bool)].max(initial=0) < 1e-9
        # what was inside a pasted box is gone, its own returns are all there
        assert (points_in_boxes(scan.points, scan.boxes).sum(axis=1) == scan.counts).all()
    assert added > 20


def test_objects_are_limited_by_class():
    objects = collect_objects(SCENES, 3, 2)
    assert [len(m) for m in objects.members] == [2, 2, 2]
    assert [len(m) for m in collect_objects(EMPTY, 3, 2).members] == [0, 0, 0]


def test_windows_lie_in_the_volume_on_the_grid_and_show_objects():
    shown = 0
    for seed in range(40):
        scan = crop(scene(seed % 6), AREA)
        window = choose_window(scan, CONFIG.voxels, 2, (32, 32), np.random.default_rng(seed))
        assert window.grid[:2] == (32, 32)
        start = (np.array(window.area[:2]) - AREA[:2]) / 0.64
        np.testing.assert_allclose(start, np.round(start), atol=1e-6)
        assert (np.array(window.area[:2]) >= AREA[:2]).all()
        assert (np.array(window.area[3:5]) <= np.array(AREA[3:5]) + 1e-6).all()
        shown += bool((crop(scan, window.area).labels >= 0).any())
    assert shown > 20
    empty = crop(scene(0, 0), AREA)
    assert choose_window(empty, CONFIG.voxels, 2, (64, 64), np.random.default_rng(0)).area == pytest.approx(AREA)

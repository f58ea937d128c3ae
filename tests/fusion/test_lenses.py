"""The fusion with cameras that have lenses: the same objects, matched, recovered and paired as with pinholes."""

from dataclasses import replace

import numpy as np
import pytest

from lcf3d import Distortion, Frame
from lcf3d.fusion.frustum import axis_yaws, extract_frustums, points_in_image_boxes
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.fusion.stereo_pairing import believable_pairs, curve_costs, epipolar_costs, pair_views
from lcf3d.geometry.camera import project_boxes, project_points
from lcf3d.geometry.epipolar import fundamental_matrix
from lcf3d.geometry.iou import bev_iou
from lcf3d.reasons import Outcome
from lcf3d.structures import InstanceMask
from tests.fusion.scenes import camera, car, lidar, seen
from tests.fusion.stereo_scenes import boxes2d, moved
from tests.localizers.scenes import scan, standing

FISHEYE = Distortion("fisheye", (0.03, -0.006, 0.001, 0.0))
BROWN = Distortion("brown_conrady", (-0.12, 0.02, 0.001, -0.001, 0.0))
LENSES = pytest.mark.parametrize("lens", [FISHEYE, BROWN], ids=["fisheye", "brown_conrady"])


def fisheye(name="left", yaw=0.0, lens=FISHEYE):
    """Of 190 degrees in an image of 1400 pixels, or what a Brown-Conrady lens shows in it."""
    return replace(camera(name, yaw, 1400, 1000, 420.0), distortion=lens)


@LENSES
def test_frustums_take_the_points_whose_bent_pixels_lie_in_the_box(lens):
    view = fisheye(lens=lens)
    points = np.random.default_rng(0).uniform([-5, -20, -3], [30, 20, 3], (20_000, 3)).astype(np.float32)
    points = np.column_stack([points, np.ones(len(points))]).astype(np.float32)
    points[:5] = np.nan
    boxes = np.array([[300.0, 400, 500, 600], [0, 0, 200, 1000]])
    index, at, offsets = points_in_image_boxes(points, view, boxes)
    pixels = project_points(points, view)[0]
    for k, (x1, y1, x2, y2) in enumerate(boxes):
        inside = (pixels[:, 0] >= x1) & (pixels[:, 0] <= x2) & (pixels[:, 1] >= y1) & (pixels[:, 1] <= y2)
        np.testing.assert_array_equal(index[offsets[k] : offsets[k + 1]], np.flatnonzero(inside))
    np.testing.assert_allclose(at, pixels[index])


def test_axis_of_a_frustum_at_the_side_of_a_fisheye():
    # straight to the left: a quarter turn is 90 degrees of the lens
    view = fisheye(lens=Distortion("fisheye", (0, 0, 0, 0)))
    u = 700 - 420 * np.pi / 2
    np.testing.assert_allclose(axis_yaws(np.array([[u - 10, 480, u + 10, 520]]), view), [np.pi / 2])


def test_masks_are_read_at_the_bent_pixels():
    view = fisheye()
    box = standing(9.0, 2.0, 4.0, 1.8, 1.5, 0.3)
    points = scan([box])
    found = seen(view, [box], [0.9])
    x1, y1, x2, y2 = found.boxes[0].astype(int)
    left_half = InstanceMask(x1, y1, np.arange(x2 - x1)[None].repeat(y2 - y1, axis=0) < (x2 - x1) // 2)
    found = replace(found, masks=(left_half,))
    proposals = extract_frustums(points, [view], [found], [np.array([0])], enlargement=0.0, mask_mode="mask")
    _, pixels, _ = points_in_image_boxes(points, view, found.boxes)
    assert len(proposals.points) == left_half.contains(pixels).sum() > 20


@LENSES
@pytest.mark.parametrize("bearing", [0.0, 35.0, 60.0, -80.0])
def test_missed_cars_are_recovered_anywhere_in_the_image(lens, bearing):
    if lens is BROWN and abs(bearing) > 50:
        pytest.skip("outside of that lens's image")
    turn = np.deg2rad(bearing)
    view = fisheye(yaw=turn - turn)
    box = standing(14 * np.cos(turn), 14 * np.sin(turn), 4.0, 1.7, 1.5, 0.5)
    view = replace(view, distortion=lens)
    points = scan_all_around([box])
    result = LateCascadeFusion()(Frame("f", points, [view]), lidar([], []), {"left": seen(view, [box], [0.95])})
    assert result.outcomes.tolist() == [Outcome.RECOVERED]
    assert bev_iou(result.detections.boxes, box[None])[0, 0] > 0.5


def scan_all_around(boxes):
    """`scan` of the front, and the same turned to the sides."""
    clouds = []
    for yaw in np.deg2rad([0, 80, -80]):
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = [np.array([cos * b[0] + sin * b[1], cos * b[1] - sin * b[0], *b[2:6], b[6] - yaw]) for b in boxes]
        cloud = scan(turned)
        x, y = cloud[:, 0].copy(), cloud[:, 1].copy()
        cloud[:, 0], cloud[:, 1] = cos * x - sin * y, sin * x + cos * y
        clouds.append(cloud)
    return np.concatenate(clouds)


@LENSES
def test_lidar_boxes_match_the_detections_of_a_lens(lens):
    view = fisheye(lens=lens)
    boxes = [car(10), car(8, 5), car(9, -6)]
    result = LateCascadeFusion()(
        Frame("f", None, [view]), lidar(boxes, [0.6] * 3), {"left": seen(view, boxes, [0.9] * 3)}
    )
    assert result.outcomes.tolist() == [Outcome.MATCHED] * 3


def rig(lens):
    left = fisheye("left", lens=lens)
    return left, moved(left, right=0.5, name="right")


@LENSES
def test_images_of_one_point_meet_their_epipolar_curves(lens):
    left, right = rig(lens)
    points = np.random.default_rng(1).uniform([3, -10, -2], [30, 10, 2], (40, 3))
    pixels = [project_points(points, view)[0] for view in (left, right)]
    kept = ~np.isnan(pixels[0]).any(axis=1) & ~np.isnan(pixels[1]).any(axis=1)
    ends = [np.column_stack([p[kept], p[kept]]) for p in pixels]
    costs = curve_costs(left, right, *ends)
    np.testing.assert_allclose(np.diag(costs), 0, atol=1e-6)
    assert np.median(costs) > 20
    lifted = ends[1] + [0, 3, 0, 3]
    # three pixels down are at most six of two corners, and less where the curve is steep
    assert (np.diag(curve_costs(left, right, ends[0], lifted)) < 6.1).all()


def test_curves_of_pinhole_cameras_are_their_lines():
    left, right = rig(None)
    rng = np.random.default_rng(2)
    own = rng.uniform(100, 600, (6, 4))
    other = own + rng.uniform(-20, 20, (6, 4))
    lines = epipolar_costs(own, other, fundamental_matrix(left, right))
    # nearly equal for pixels near to the line; the nearest directions are not quite the nearest pixels
    np.testing.assert_allclose(np.diag(curve_costs(left, right, own, other)), np.diag(lines), rtol=0.15)


@LENSES
def test_stereo_pairs_through_lenses(lens):
    left, right = rig(lens)
    cars = np.array([car(10.0, 1), car(12, -6), car(7, 5), car(25, 2)])
    found = [boxes2d(project_boxes(cars, view)[0]) for view in (left, right)]
    order = np.array([2, 0, 3, 1])
    pairs = pair_views(left, right, found[0], found[1][order], gate_px=10, check_depth=True)
    assert {(int(a), int(order[b])) for a, b in pairs} == {(k, k) for k in range(4)}
    # the far car's left box with the near one's right box is no object of believable size
    swapped = believable_pairs(left, right, found[0].boxes[[3]], found[1].boxes[[2]], 10)
    assert not swapped[0, 0]


@LENSES
def test_stereo_fusion_recovers_through_lenses(lens):
    views = rig(lens)
    box = standing(10.0, 3.0, 4.0, 1.7, 1.5, 0.5)
    found = {view.name: seen(view, [box], [0.95]) for view in views}
    result = StereoLateCascadeFusion(StereoConfig())(Frame("f", scan([box]), views), lidar([], []), found)
    assert result.outcomes.tolist() == [Outcome.RECOVERED]
    assert result.camera.pair.max() >= 0
    assert bev_iou(result.detections.boxes, box[None])[0, 0] > 0.5

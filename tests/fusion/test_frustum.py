import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.fusion.frustum import axis_yaws, enlarge_boxes, extract_frustums, gaussian_mask
from lcf3d.geometry.camera import project_points
from lcf3d.structures import KITTI_CLASSES, Detections2D, InstanceMask
from tests.fusion.scenes import camera, car, surface_points


def detections(boxes, masks=None):
    n = len(boxes)
    return Detections2D(np.array(boxes, float), np.full(n, 0.8), np.arange(n) % 3, KITTI_CLASSES, masks)


def grid(n=2000, seed=0):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-20, -15, -2], [40, 15, 3], (n, 3))
    return np.column_stack([xyz, rng.uniform(0, 1, n)]).astype(np.float32)


def test_enlargement_keeps_the_centre():
    np.testing.assert_allclose(enlarge_boxes(np.array([[10.0, 20, 30, 60]]), 0.05), [[9.5, 19, 30.5, 61]])


def test_gaussian_by_hand():
    # sigma is the whole width and height: at a corner of the box exp(-1/8 - 1/8)
    box = np.array([0.0, 0, 10, 20])
    values = gaussian_mask(np.array([[5.0, 10], [10, 20], [15, 10]]), box)
    np.testing.assert_allclose(values, [1, np.exp(-0.25), np.exp(-0.5)], rtol=1e-6)


def test_points_are_those_whose_projection_falls_into_the_enlarged_box():
    points, view = grid(), camera()
    boxes = [[300.0, 100, 500, 300], [450, 150, 700, 390]]
    proposals = extract_frustums(points, [view], [detections(boxes)], [np.arange(2)], enlargement=0.1)
    pixels, depths = project_points(points, view)
    for k, box in enumerate(enlarge_boxes(np.array(boxes), 0.1)):
        inside = (depths > 0.1) & (pixels >= box[:2]).all(axis=1) & (pixels <= box[2:]).all(axis=1)
        got = proposals.points[proposals.part(k)]
        assert len(got) == inside.sum() > 10
        np.testing.assert_array_equal(got[:, 2:], points[inside][:, 2:])  # height and intensity are untouched
        np.testing.assert_allclose(
            np.hypot(got[:, 0], got[:, 1]), np.hypot(points[inside, 0], points[inside, 1]), rtol=1e-5
        )


def test_the_axis_points_along_x():
    view = camera()
    target = np.array([[15.0, 6, 0.5, 0]], np.float32)
    pixel = project_points(target, view)[0][0]
    box = [[pixel[0] - 20, pixel[1] - 20, pixel[0] + 20, pixel[1] + 20]]
    proposals = extract_frustums(np.repeat(target, 12, axis=0), [view], [detections(box)], [np.array([0])])
    np.testing.assert_allclose(proposals.points[0, :2], [np.hypot(15, 6), 0], atol=1e-5)
    np.testing.assert_allclose(axis_yaws(np.array(box), view), [np.arctan2(6, 15)])


@given(st.floats(-3, 3), st.integers(0, 100))
def test_boxes_turn_into_the_frustum_and_back(yaw, seed):
    rng = np.random.default_rng(seed)
    proposals = extract_frustums(
        grid(), [camera(yaw=yaw)], [detections([[300.0, 100, 500, 300]])], [np.array([0])], min_points=1
    )
    if not len(proposals):
        return
    box = rng.uniform(-3, 3, (1, 7))
    back = proposals.lidar_from_frustum(proposals.frustum_from_lidar(box))
    np.testing.assert_allclose(back, box, atol=1e-9)


def test_min_points_keeps_frustums_with_exactly_that_many():
    view = camera()
    points = np.tile(np.array([[15.0, 0, 0, 0]], np.float32), (10, 1))
    box = detections([[400.0, 100, 600, 300]])
    assert len(extract_frustums(points, [view], [box], [np.array([0])], min_points=10)) == 1
    assert len(extract_frustums(points[:9], [view], [box], [np.array([0])], min_points=10)) == 0


def mask_of_left_half(box):
    x1, y1, x2, y2 = box
    bitmap = np.ones((y2 - y1, (x2 - x1) // 2), dtype=bool)
    return InstanceMask(x1, y1, bitmap)


@pytest.mark.parametrize("mode", ["box", "mask", "box+mask"])
def test_mask_modes(mode):
    view, points, box = camera(), grid(), (300, 100, 500, 300)
    pixels, depths = project_points(points, view)
    in_box = (depths > 0.1) & (pixels >= box[:2]).all(axis=1) & (pixels <= box[2:]).all(axis=1)
    on_mask = in_box & (pixels[:, 0] < 400)
    proposals = extract_frustums(
        points,
        [view],
        [detections([box], (mask_of_left_half(box),))],
        [np.array([0])],
        enlargement=0,
        mask_mode=mode,
    )
    assert len(proposals.points) == (on_mask if mode == "mask" else in_box).sum()
    if mode == "box+mask":
        assert proposals.mask.sum() == on_mask.sum()
    else:
        assert proposals.mask is None


def test_a_mask_with_too_few_points_falls_back_to_the_box():
    view, points, box = camera(), grid(), (300, 100, 500, 300)
    tiny = InstanceMask(310, 110, np.ones((1, 1), dtype=bool))
    with_mask = extract_frustums(points, [view], [detections([box], (tiny,))], [np.array([0])], mask_mode="mask")
    without = extract_frustums(points, [view], [detections([box])], [np.array([0])])
    assert len(with_mask.points) == len(without.points)


def test_points_that_are_not_finite_are_in_no_frustum():
    points = surface_points([car(12)])
    points[::2, :3] = [np.nan, np.inf, 0]
    proposals = extract_frustums(points, [camera()], [detections([[0.0, 0, 1000, 400]])], [np.array([0])])
    assert len(proposals.points) == len(points) // 2
    assert np.isfinite(proposals.points).all()


def test_two_cameras_and_no_scan():
    views = [camera("a", 0.5), camera("b", -0.5)]
    found = [detections([[300.0, 100, 500, 300]]), detections([[10.0, 10, 20, 20], [300, 100, 500, 300]])]
    proposals = extract_frustums(grid(), views, found, [np.array([0]), np.array([1])])
    assert proposals.camera_index.tolist() == [0, 1]
    assert proposals.detection_index.tolist() == [0, 1]
    assert proposals.labels.tolist() == [0, 1]
    empty = extract_frustums(np.zeros((0, 4), np.float32), views, found, [np.array([0]), np.array([1])])
    assert len(empty) == 0
    assert len(empty.points) == 0

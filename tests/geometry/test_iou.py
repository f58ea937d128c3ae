import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.geometry.boxes import bev_corners, wrap_angle
from lcf3d.geometry.iou import bev_iou, image_area, image_cover, image_iou, iou_3d

length = st.floats(0.1, 15)
box = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-2, 2), length, length, length, st.floats(-7, 7)).map(
    lambda values: np.array([values])
)


def paired(a, b):
    """IoU of a[i] and b[i], through the public matrix in blocks."""
    return np.concatenate([np.diag(bev_iou(a[i : i + 100], b[i : i + 100])) for i in range(0, len(a), 100)])


def shapely_iou(a, b):
    polygons_a, polygons_b = shapely.polygons(bev_corners(a)), shapely.polygons(bev_corners(b))
    # on a grid: in floating point GEOS gives some touching boxes the whole of one of them as intersection
    shared = shapely.area(shapely.intersection(polygons_a, polygons_b, grid_size=1e-9))
    return shared / (shapely.area(polygons_a) + shapely.area(polygons_b) - shared)


def random_pairs(n, rng):
    sides = np.exp(rng.normal(0.5, 0.8, (n, 2, 3)))
    centres = rng.normal(0, 2, (n, 2, 3))
    yaws = rng.uniform(-4, 4, (n, 2, 1))
    pairs = np.concatenate([centres, sides, yaws], axis=2)
    return np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])


def degenerate_pairs(n, rng):
    """Identical, nested, touching, parallel, square-turned and far pairs."""
    a, _ = random_pairs(n, rng)
    b = a.copy()
    kind = np.arange(n) % 6
    b[kind == 1, 3:6] *= rng.uniform(0.1, 1, (n, 1))[kind == 1]  # nested, same centre and yaw
    along = np.stack([np.cos(a[:, 6]), np.sin(a[:, 6])], axis=1)
    b[kind == 2, :2] += (along * a[:, 3:4])[kind == 2]  # touching along the length
    b[kind == 3, 6] += np.pi / 2  # at a right angle, same centre
    b[kind == 4, :2] += (along * a[:, 3:4] * rng.uniform(0, 1, (n, 1)))[kind == 4]  # parallel, sliding
    b[kind == 5, :2] += 100
    return a, b


def test_bev_iou_equals_shapely_on_100000_pairs():
    rng = np.random.default_rng(0)
    plain, special = random_pairs(60_000, rng), degenerate_pairs(40_000, rng)
    a, b = np.concatenate([plain[0], special[0]]), np.concatenate([plain[1], special[1]])
    expected = shapely_iou(a, b)
    assert (expected > 0).mean() > 0.2
    assert np.abs(paired(a, b) - expected).max() < 1e-6


def test_identical_boxes_have_iou_one():
    a, _ = random_pairs(300, np.random.default_rng(1))
    np.testing.assert_allclose(np.diag(bev_iou(a, a)), 1, atol=1e-14)
    np.testing.assert_allclose(np.diag(iou_3d(a, a)), 1, atol=1e-14)


def test_touching_boxes_have_iou_zero():
    a = np.array([[0.0, 0, 0, 4, 2, 1.5, 0]])
    for shift in ([4, 0, 0], [0, 2, 0], [0, 0, 1.5]):
        b = a.copy()
        b[0, :3] += shift
        assert iou_3d(a, b)[0, 0] == 0


def test_hand_computed_overlaps():
    a = np.array([[0.0, 0, 0, 4, 2, 2, 0]])
    half = np.array([[2.0, 0, 0, 4, 2, 2, 0]])
    assert bev_iou(a, half)[0, 0] == pytest.approx(4 / 12)
    raised = np.array([[2.0, 0, 1, 4, 2, 2, 0]])
    assert iou_3d(a, raised)[0, 0] == pytest.approx(4 / 28)
    crossed = np.array([[0.0, 0, 0, 4, 2, 2, np.pi / 2]])
    assert bev_iou(a, crossed)[0, 0] == pytest.approx(4 / 12)
    # a unit square turned by 45 degrees inside a 2 x 2 one shares all of itself
    assert bev_iou(np.array([[0.0, 0, 0, 2, 2, 1, 0]]), np.array([[0.0, 0, 0, 1, 1, 1, np.pi / 4]]))[
        0, 0
    ] == pytest.approx(1 / 4)


@given(box, box)
@settings(max_examples=300)
def test_overlap_is_symmetric_and_bounded(a, b):
    forth, back = bev_iou(a, b)[0, 0], bev_iou(b, a)[0, 0]
    assert forth == pytest.approx(back, abs=1e-9)
    assert 0 <= forth <= 1
    assert iou_3d(a, b)[0, 0] <= forth + 1e-9 or a[0, 5] != b[0, 5]


@given(box, box, st.floats(-7, 7), st.floats(-100, 100), st.floats(-100, 100))
@settings(max_examples=300)
def test_overlap_is_invariant_under_rigid_motion(a, b, yaw, x, y):
    def move(boxes):
        moved = boxes.copy()
        moved[:, 0] = np.cos(yaw) * boxes[:, 0] - np.sin(yaw) * boxes[:, 1] + x
        moved[:, 1] = np.sin(yaw) * boxes[:, 0] + np.cos(yaw) * boxes[:, 1] + y
        moved[:, 6] = wrap_angle(boxes[:, 6] + yaw)
        return moved

    assert iou_3d(move(a), move(b))[0, 0] == pytest.approx(iou_3d(a, b)[0, 0], abs=1e-7)


@given(box)
def test_half_turn_changes_nothing(a):
    b = a.copy()
    b[0, 6] += np.pi
    assert bev_iou(a, b)[0, 0] == pytest.approx(1, abs=1e-9)


def test_boxes_without_area_have_no_overlap():
    flat = np.array([[0.0, 0, 0, 0, 2, 1, 0]])
    assert bev_iou(flat, flat)[0, 0] == 0


def test_image_iou_by_hand():
    a = np.array([[0.0, 0, 10, 10], [20, 20, 30, 30], [5, 5, 5, 5]])
    b = np.array([[5.0, 0, 15, 10], [0, 0, 10, 10]])
    np.testing.assert_allclose(image_iou(a, b), [[1 / 3, 1], [0, 0], [0, 0]])
    assert image_area(np.array([[3.0, 3, 1, 9]]))[0] == 0


def test_the_share_of_a_box_in_another_by_hand():
    a = np.array([[0.0, 0, 10, 10], [2, 2, 4, 4], [5, 5, 5, 5]])
    b = np.array([[5.0, 0, 15, 10], [-100, -100, 100, 100]])
    np.testing.assert_allclose(image_cover(a, b), [[0.5, 1], [0, 1], [0, 0]])
    assert image_cover(a, np.zeros((0, 4))).shape == (3, 0)


def test_empty_inputs_give_empty_matrices():
    none = np.zeros((0, 7))
    assert bev_iou(none, np.ones((3, 7))).shape == (0, 3)
    assert image_iou(np.zeros((0, 4)), np.zeros((0, 4))).shape == (0, 0)

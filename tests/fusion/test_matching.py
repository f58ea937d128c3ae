import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from lcf3d.fusion.clustering import Clusters, cluster_boxes
from lcf3d.fusion.matching import assign, cluster_iou, confirmed_elsewhere, match_view, merge_views
from lcf3d.geometry.camera import project_boxes
from tests.fusion.scenes import camera, car


def singles(n):
    return Clusters(np.arange(n), np.arange(n))


def test_cluster_iou_is_the_best_member_that_is_visible():
    projected = np.array([[0.0, 0, 10, 10], [0, 0, 10, 20], [50, 0, 60, 10]])
    visible = np.array([True, True, False])
    clusters = Clusters(np.array([0, 0, 1]), np.array([0, 2]))
    boxes2d = np.array([[0.0, 0, 10, 20], [50, 0, 60, 10]])
    np.testing.assert_allclose(cluster_iou(projected, visible, clusters, boxes2d), [[1, 0], [0, 0]])


@pytest.mark.parametrize("seed", range(10))
def test_assignment_is_the_best_of_all(seed):
    iou = np.random.default_rng(seed).uniform(0, 1, (4, 5))
    gated = np.where(iou > 0.3, iou, 0)
    best = max(sum(gated[i, p[i]] for i in range(4)) for p in itertools.permutations(range(5), 4))
    match = assign(iou, 0.3, "gated")
    assert sum(iou[i, m] for i, m in enumerate(match) if m >= 0) == pytest.approx(best)
    assert len(set(match[match >= 0])) == (match >= 0).sum()


@given(st.integers(0, 10_000))
def test_assignment_of_few_good_pairs_is_that_of_the_full_solver(seed):
    # most of these matrices have a row or column with one good pair only, which no solver is asked about
    rng = np.random.default_rng(seed)
    iou = rng.uniform(0, 1, rng.integers(1, 6, 2)) * (rng.uniform(0, 1, 1) < 0.6)
    iou[rng.uniform(0, 1, iou.shape) < 0.7] = 0
    rows, columns = linear_sum_assignment(np.where(iou > 0.3, iou, 0), maximize=True)
    expected = np.full(len(iou), -1)
    good = iou[rows, columns] > 0.3
    expected[rows[good]] = columns[good]
    assert assign(iou, 0.3, "gated").tolist() == expected.tolist()


def test_a_hopeless_pair_displaces_a_good_one_in_paper_mode_only():
    # cluster 0: 0.50 with box 0 and 0.39 with box 1; cluster 1: 0.45 with box 0, nothing with box 1.
    # The full matrix prefers 0.39 + 0.45 = 0.84 over 0.50, and 0.39 then falls to the threshold of 0.4.
    iou = np.array([[0.50, 0.39], [0.45, 0.0]])
    assert assign(iou, 0.4, "paper").tolist() == [-1, 0]
    assert assign(iou, 0.4, "gated").tolist() == [0, -1]


def test_the_threshold_is_exclusive():
    assert assign(np.array([[0.4]]), 0.4).tolist() == [-1]
    assert assign(np.array([[0.4]]), 0.4, "paper").tolist() == [-1]
    assert assign(np.array([[0.41]]), 0.4).tolist() == [0]


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0)])
def test_nothing_to_assign(shape):
    assert assign(np.zeros(shape), 0.4).tolist() == [-1] * shape[0]


def test_view_of_three_cars():
    view = camera()
    boxes = np.array([car(10), car(20, 5), car(-10)])
    boxes2d = project_boxes(boxes[[1]], view)[0]
    found = match_view(boxes, singles(3), view, boxes2d, iou_threshold=0.4)
    assert found.visible.tolist() == [True, True, False]
    assert found.match.tolist() == [-1, 0, -1]
    assert found.iou[1, 0] == pytest.approx(1)


def test_cluster_matches_through_a_member_that_is_not_its_best():
    view = camera()
    boxes = np.array([car(10.9), car(10)])  # linked: they share more than 0.3
    clusters = cluster_boxes(boxes, np.array([0.9, 0.3]), np.zeros(2, int))
    assert len(clusters) == 1
    found = match_view(boxes, clusters, view, project_boxes(boxes[[1]], view)[0], iou_threshold=0.95)
    assert found.match.tolist() == [0]


def two_cameras():
    """Cameras 60 degrees apart, so that an object between them is in both."""
    return camera("a", np.radians(30)), camera("b", np.radians(-30))


def test_object_in_two_cameras_has_the_better_one_as_primary():
    a, b = two_cameras()
    boxes = np.array([car(12)])
    in_a, in_b = project_boxes(boxes, a)[0], project_boxes(boxes, b)[0]
    in_b[0, 2] += 0.2 * (in_b[0, 2] - in_b[0, 0])
    views = [match_view(boxes, singles(1), view, found, iou_threshold=0.4) for view, found in ((b, in_b), (a, in_a))]
    matches = merge_views(views, 1)
    assert matches.camera.tolist() == [1]
    assert matches.iou[0] == pytest.approx(1)
    assert matches.visible.tolist() == [True]


def test_leftover_box_of_an_object_confirmed_elsewhere():
    a, b = two_cameras()
    boxes = np.array([car(12)])
    exact_b = project_boxes(boxes, b)[0]
    # in b the detector drew a box half as wide: IoU 0.5 is no match at 0.6, but it shows the same object
    half_b = exact_b.copy()
    half_b[0, 2] = (exact_b[0, 0] + exact_b[0, 2]) / 2
    far_b = exact_b + np.array([200, 0, 200, 0])
    found_b = np.concatenate([half_b, far_b])
    views = [
        match_view(boxes, singles(1), a, project_boxes(boxes, a)[0], iou_threshold=0.6),
        match_view(boxes, singles(1), b, found_b, iou_threshold=0.6),
    ]
    matches = merge_views(views, 1)
    assert views[1].match.tolist() == [-1]
    assert confirmed_elsewhere(views, matches, singles(1), found_b, 1, 0.3).tolist() == [True, False]
    # within one camera a leftover box is another object, however much it overlaps
    assert confirmed_elsewhere(views, matches, singles(1), project_boxes(boxes, a)[0], 0, 0.3).tolist() == [False]

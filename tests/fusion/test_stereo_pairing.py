import itertools
from dataclasses import replace

import numpy as np
import pytest

from lcf3d import Lcf3dError
from lcf3d.fusion.stereo_pairing import (
    believable_pairs,
    check_not_exchanged,
    check_stereo_pair,
    epipolar_costs,
    pair_views,
)
from lcf3d.geometry.epipolar import fundamental_matrix
from tests.fusion.scenes import camera, car, pedestrian, seen
from tests.fusion.stereo_scenes import boxes2d, moved, rig

# 1.5 m tall at 10 m: 75 px, and 25 px of disparity
LEFT = [600.0, 160, 700, 235]
RIGHT = [575.0, 160, 675, 235]


def shifted(box, right=0.0, down=0.0):
    return [box[0] + right, box[1] + down, box[2] + right, box[3] + down]


def pairs_of(left, right, views=None, gate=10.0, depth=True, method="gated"):
    views = views or rig()
    return pair_views(*views, left, right, gate_px=gate, check_depth=depth, method=method).tolist()


def test_cost_is_the_sum_of_both_corner_distances():
    # lines of a rectified pair are rows: 3 px at the top left corner, 6 at the bottom right
    costs = epipolar_costs(np.array([[100.0, 100, 200, 200]]), np.array([[80.0, 103, 180, 206]]), fundamental(rig()))
    np.testing.assert_allclose(costs, [[9]], atol=1e-9)


def test_cost_of_cameras_one_above_the_other():
    # the lines are columns: 4 px and 7 px
    views = [camera(), moved(camera("right"), down=0.4)]
    costs = epipolar_costs(np.array([[100.0, 100, 200, 200]]), np.array([[104.0, 80, 207, 170]]), fundamental(views))
    np.testing.assert_allclose(costs, [[11]], atol=1e-9)


def test_cost_at_the_epipole_is_infinite():
    views = [camera(), moved(camera("right"))]
    transform = np.array(views[1].camera_from_lidar)
    transform[2, 3] -= 1.0
    views[1] = replace(views[1], camera_from_lidar=transform)
    costs = epipolar_costs(np.array([[500.0, 200, 600, 300]]), np.array([[500.0, 200, 600, 300]]), fundamental(views))
    assert np.isinf(costs).all()


def fundamental(views):
    return fundamental_matrix(*views)


@pytest.mark.parametrize("seed", range(8))
def test_gated_assignment_is_the_best_of_all(seed):
    rng = np.random.default_rng(seed)
    top = rng.uniform([0, 100], [800, 130], (5, 2))
    left = boxes2d(np.concatenate([top[:4], top[:4] + 60], axis=1))
    right = boxes2d(np.concatenate([top, top + 60], axis=1) + rng.normal(0, 4, (5, 4)))
    distance = epipolar_costs(left.boxes, right.boxes, fundamental(rig())) / 2
    saved = np.where(distance <= 10, 10 - distance, 0)
    best = max(sum(saved[i, p[i]] for i in range(4)) for p in itertools.permutations(range(5), 4))
    found = pairs_of(left, right, depth=False)
    assert sum(saved[i, j] for i, j in found) == pytest.approx(best)
    assert all(distance[i, j] <= 10 for i, j in found)


def test_a_hopeless_pair_parts_a_good_one_in_paper_mode_only():
    # mean distances 0-0: 2, 0-1: 11, 1-0: 9, 1-1: 22. The least sum of two pairs is 11 + 9 < 2 + 22, and 11 is no pair
    left = boxes2d([[600.0, 100, 700, 200], [600, 111, 700, 211]])
    right = boxes2d([[575.0, 102, 675, 202], [575, 89, 675, 189]])
    distance = epipolar_costs(left.boxes, right.boxes, fundamental(rig())) / 2
    np.testing.assert_allclose(distance, [[2, 11], [9, 22]])
    assert pairs_of(left, right, depth=False, method="paper") == [[1, 0]]
    assert pairs_of(left, right, depth=False) == [[0, 0]]


@pytest.mark.parametrize("method", ["gated", "paper"])
def test_classes_and_gate(method):
    assert pairs_of(boxes2d([LEFT]), boxes2d([RIGHT]), method=method) == [[0, 0]]
    assert pairs_of(boxes2d([LEFT]), boxes2d([RIGHT], labels=[1]), method=method) == []
    # "over a gate": 10 px are still a pair
    assert pairs_of(boxes2d([LEFT]), boxes2d([shifted(RIGHT, down=10)]), method=method) == [[0, 0]]
    assert pairs_of(boxes2d([LEFT]), boxes2d([shifted(RIGHT, down=10.01)]), method=method) == []
    # one corner may be 18 px off where the other is 2
    assert pairs_of(boxes2d([LEFT]), boxes2d([[575, 162, 675, 253]]), method=method) == [[0, 0]]


def test_nothing_to_pair():
    assert pairs_of(boxes2d([]), boxes2d([RIGHT])) == []
    assert pairs_of(boxes2d([LEFT]), boxes2d([])) == []


def test_believable_height_by_hand():
    views, left = rig(), np.array([LEFT])
    # disparity d is a depth of 250 / d and a height of 75 / 500 * 250 / d = 37.5 / d metres: 0.5 to 4.5 m are 75 to
    # 8.33 px, and the tolerance of 2 px is added at both ends
    disparities = np.array([-20, 0, 6.2, 6.5, 25, 76.8, 77.2])
    right = np.stack([shifted(LEFT, right=-d) for d in disparities])
    expected = [False, False, False, True, True, True, False]
    assert believable_pairs(*views, left, right, 2.0).tolist() == [expected]


def test_edges_on_the_border_are_where_the_image_ends():
    views = rig()
    # the object leaves both images on the left: left edges at 0, right edges 25 px apart as they should be
    left, right = np.array([[0.0, 160, 60, 235]]), np.array([[0.0, 160, 35, 235]])
    assert believable_pairs(*views, left, right, 1.0).tolist() == [[True]]
    # 25 px of the left edges and 150 px of the right ones would be 87.5 px on average: too near
    inside = np.array([[30.0, 160, 185, 235]]), np.array([[5.0, 160, 35, 235]])
    assert believable_pairs(*views, *inside, 1.0).tolist() == [[False]]
    # nothing to go by: an object as wide as the image
    whole = np.array([[0.0, 160, 1000, 235]])
    assert believable_pairs(*views, whole, whole, 1.0).tolist() == [[True]]


def test_objects_beside_each_other_are_told_apart_by_depth_only():
    views = rig()
    objects = [car(20, 4), car(20, -4)]
    left, right = seen(views[0], objects, [0.9, 0.8]), seen(views[1], objects, [0.9, 0.8])
    # half a pixel of noise makes the wrong pairs the better ones on the epipolar lines
    noisy = replace(right, boxes=right.boxes + np.array([[0, 0.5, 0, 0.5], [0, 0, 0, 0]]))
    swapped = replace(left, boxes=left.boxes + np.array([[0, 0, 0, 0], [0, 0.5, 0, 0.5]]))
    assert pairs_of(swapped, noisy, depth=False) == [[0, 1], [1, 0]]
    assert pairs_of(swapped, noisy, depth=True) == [[0, 0], [1, 1]]


def test_pairs_of_cameras_that_are_turned_against_each_other():
    views = [camera("left", yaw=0.1), moved(camera("right", yaw=-0.15), right=0.6, down=0.1)]
    objects = [car(12, 1), car(20, -3), pedestrian(15, 3)]
    left = seen(views[0], objects, [0.9] * 3, [0, 0, 1])
    right = seen(views[1], objects[::-1], [0.9] * 3, [1, 0, 0])
    assert pairs_of(left, right, views) == [[0, 2], [1, 1], [2, 0]]


def test_a_proper_pair_passes():
    check_stereo_pair(*rig())
    # cameras above each other have no left and right
    check_stereo_pair(moved(camera("right"), down=0.4), camera())


def test_exchanged_cameras_are_refused():
    with pytest.raises(
        Lcf3dError, match=r"left one, but by its calibration 'left' stands 0\.50 m to the left of 'right'"
    ):
        check_stereo_pair(*rig()[::-1])


def test_images_of_different_size_are_refused():
    left, right = rig()
    with pytest.raises(Lcf3dError, match="1000 x 400 and 900 x 400"):
        check_stereo_pair(left, replace(right, width=900))


def test_cameras_at_one_place_are_refused():
    with pytest.raises(Lcf3dError, match="must stand apart"):
        check_stereo_pair(camera(), camera("right"))


def test_exchanged_detections_are_refused():
    views = rig()
    objects = [car(12, 2), car(18, -3), car(25, 4)]
    left, right = (seen(v, objects, [0.9] * 3) for v in views)
    check_not_exchanged(*views, left, right, 10.0)
    with pytest.raises(Lcf3dError, match="no object in common, but 3 with the views exchanged"):
        check_not_exchanged(*views, right, left, 10.0)
    # two objects may be chance, and so far away that disparity says nothing they fit both ways
    check_not_exchanged(*views, right[:2], left[:2], 10.0)
    far = replace(
        right, boxes=np.concatenate([right.boxes, [[500.0, 190, 512, 196]]]), scores=[0.9] * 4, labels=[0] * 4
    )
    also = replace(left, boxes=np.concatenate([left.boxes, [[501.0, 190, 513, 196]]]), scores=[0.9] * 4, labels=[0] * 4)
    check_not_exchanged(*views, far, also, 10.0)


def test_the_same_detections_for_both_views_are_refused():
    views = rig()
    left = seen(views[0], [car(12, 2), car(18, -3), car(25, 4)], [0.9] * 3)
    with pytest.raises(Lcf3dError, match="both views have the same 3 boxes"):
        check_not_exchanged(*views, left, left, 10.0)

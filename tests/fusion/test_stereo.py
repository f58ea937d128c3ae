from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d import Lcf3dError
from lcf3d.fusion.frustum import extract_frustums
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.geometry.camera import project_points
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import KITTI_CLASSES, Detections2D, InstanceMask
from tests.fusion.scenes import (
    CAR,
    CYCLIST,
    PEDESTRIAN,
    PLAIN,
    TrueLocalizer,
    camera,
    car,
    frame,
    lidar,
    pedestrian,
    seen,
    surface_points,
)
from tests.fusion.stereo_scenes import boxes2d, moved, rig, widened

NEAR, WALKER = car(12, 2), pedestrian(15, -4)


def fuse(found3d, found2d, points=None, objects=(), views=None, localizer=None, **settings):
    settings = {"unmatched": "drop", "ensemble": "probabilistic", "unpaired": "discard", **settings}
    fusion = StereoLateCascadeFusion(
        StereoConfig(**PLAIN).updated(**settings), localizer or TrueLocalizer(list(objects) or [NEAR])
    )
    return fusion(frame(views or rig(), points), found3d, found2d)


def none2d():
    return Detections2D.empty(KITTI_CLASSES)


def both(objects, scores=(0.9, 0.8), labels=None, views=None):
    """What both views see of some objects, with a score for each view."""
    views = views or rig()
    return {v.name: seen(v, objects, [s] * len(objects), labels) for v, s in zip(views, scores, strict=True)}


# LiDAR, left, right -> outcome of the output (None for no output), reason of the LiDAR box, of the left and right one
SUMMARY_TABLE = [
    (False, False, False, None, None, None, None),
    (False, False, True, None, None, None, "unpaired"),
    (False, True, False, None, None, "unpaired", None),
    (False, True, True, Outcome.RECOVERED, None, "localized", "localized"),
    (True, False, False, None, "unconfirmed", None, None),
    (True, False, True, Outcome.MATCHED, "confirmed", None, "confirmed"),
    (True, True, False, Outcome.MATCHED, "confirmed", "confirmed", None),
    (True, True, True, Outcome.MATCHED, "confirmed", "confirmed", "second_view"),
]


@pytest.mark.parametrize(
    ("in_lidar", "in_left", "in_right", "outcome", "of_lidar", "of_left", "of_right"), SUMMARY_TABLE
)
def test_matching_summary_table(in_lidar, in_left, in_right, outcome, of_lidar, of_left, of_right):
    found = {
        name: d if there else none2d()
        for (name, d), there in zip(both([NEAR]).items(), (in_left, in_right), strict=True)
    }
    fused = fuse(lidar([NEAR], [0.8]) if in_lidar else lidar([], []), found, surface_points([NEAR]))
    assert fused.outcomes.tolist() == ([] if outcome is None else [outcome])
    assert [fused.lidar.row(i)["reason"] for i in range(len(fused.lidar))] == [r for r in [of_lidar] if r]
    assert [fused.camera.row(i)["reason"] for i in range(len(fused.camera))] == [r for r in [of_left, of_right] if r]


def test_scores_of_three_terms():
    # a = 0.8 * 0.7 * 0.6 / 0.5^2 = 1.344, b = 0.2 * 0.3 * 0.4 / 0.5^2 = 0.096
    fused = fuse(lidar([NEAR], [0.8]), both([NEAR], (0.7, 0.6)))
    assert fused.detections.scores[0] == pytest.approx(1.344 / 1.44)
    # the paper's product: 0.8 * 0.7 * 0.6 / (1 / 3)^2
    fused = fuse(lidar([NEAR], [0.8]), both([NEAR], (0.7, 0.6)), ensemble="product")
    assert fused.detections.scores[0] == pytest.approx(3.024)


@pytest.mark.parametrize(
    ("lidar_label", "left", "right", "label", "score"),
    [
        # the more confident view decides the label; only terms of that label count
        (CAR, (0.7, CAR), (0.9, CYCLIST), CYCLIST, 0.9),
        (CYCLIST, (0.7, CAR), (0.9, CYCLIST), CYCLIST, 0.8 * 0.9 / (0.8 * 0.9 + 0.2 * 0.1)),
        (CAR, (0.9, CAR), (0.7, CYCLIST), CAR, 0.8 * 0.9 / (0.8 * 0.9 + 0.2 * 0.1)),
        # the views agree against the LiDAR: s_l s_r / p, normalised
        (CYCLIST, (0.7, CAR), (0.6, CAR), CAR, 0.7 * 0.6 / (0.7 * 0.6 + 0.3 * 0.4)),
        (PEDESTRIAN, (0.7, CAR), (0.6, CYCLIST), CAR, 0.7),
    ],
)
def test_only_terms_that_agree_with_the_more_confident_view_count(lidar_label, left, right, label, score):
    views = rig()
    found = {v.name: seen(v, [NEAR], [s], [c]) for v, (s, c) in zip(views, (left, right), strict=True)}
    fused = fuse(lidar([NEAR], [0.8], [lidar_label]), found, relabel_score=0.0)
    assert fused.detections.labels.tolist() == [label]
    assert fused.detections.scores[0] == pytest.approx(score)


def test_matched_in_both_views_says_so():
    fused = fuse(lidar([NEAR], [0.8]), both([NEAR], (0.6, 0.7)))
    assert fused.camera.row(0)["reason"] == "second_view"
    assert fused.camera.row(1)["reason"] == "confirmed"
    assert [fused.camera.row(i)["pair"] for i in range(2)] == [1, 0]
    assert fused.lidar.row(0)["pair"] == 0
    assert "right detection 0 (score 0.70) and left detection 0 (score 0.60)" in fused.explain(0)


def test_recovered_score_is_multiplied_by_both_overlaps():
    # boxes twice and 1.25 times as wide as the projection: IoU 0.5 and 0.8
    found = both([NEAR], (0.6, 0.9))
    found = {"left": widened(found["left"], 2), "right": widened(found["right"], 1.25)}
    fused = fuse(lidar([], []), found, surface_points([NEAR]))
    assert fused.detections.scores[0] == pytest.approx(0.9 * 0.5 * 0.8)
    assert fused.outcomes.tolist() == [Outcome.RECOVERED]
    assert [fused.camera.row(i)["iou"] for i in range(2)] == pytest.approx([0.5, 0.8])
    assert [fused.camera.row(i)["pair"] for i in range(2)] == [1, 0]
    assert [fused.camera.row(i)["output"] for i in range(2)] == [0, 0]
    assert "left detection 0 (score 0.60) and right detection 0 (score 0.90)" in fused.explain(0)


def test_the_smaller_overlap_must_reach_the_threshold():
    found = both([NEAR])
    found["right"] = widened(found["right"], 2)
    exact = fuse(lidar([], []), found, surface_points([NEAR])).camera.iou[1]
    assert len(fuse(lidar([], []), found, surface_points([NEAR]), confirm_iou=exact)) == 1
    fused = fuse(lidar([], []), found, surface_points([NEAR]), confirm_iou=np.nextafter(exact, 1))
    assert len(fused) == 0
    assert [fused.camera.row(i)["reason"] for i in range(2)] == ["disagrees", "disagrees"]


def test_proposal_is_the_points_in_both_boxes_with_the_larger_gaussian():
    views = rig()
    rng = np.random.default_rng(0)
    points = rng.uniform([3, -15, -2, 0], [60, 15, 3, 1], (4000, 4)).astype(np.float32)
    boxes = [np.array([400.0, 150, 560, 290]), np.array([380.0, 140, 520, 300])]
    found = [boxes2d([b]) for b in boxes]
    proposals = extract_frustums(
        points, views, found, [np.array([0]), np.zeros(0, int)], enlargement=0.1, pairs=np.array([[0, 0, 1, 0]])
    )
    inside, weight = np.ones(len(points), dtype=bool), np.zeros(len(points))
    for view, box in zip(views, boxes, strict=True):
        pixels, depths = project_points(points, view)
        centre, sides = (box[:2] + box[2:]) / 2, box[2:] - box[:2]
        inside &= (depths > 0.1) & (np.abs(pixels - centre) <= 0.55 * sides).all(axis=1)
        weight = np.fmax(weight, np.exp(-0.5 * (((pixels - centre) / sides) ** 2).sum(axis=1)))
    assert 20 < inside.sum() == len(proposals.points)
    np.testing.assert_array_equal(proposals.points[:, 2:], points[inside][:, 2:])
    np.testing.assert_allclose(proposals.gaussian, weight[inside], rtol=1e-5)
    assert proposals.second.camera.tolist() == [1]
    np.testing.assert_array_equal(proposals.second.boxes2d, boxes[1][None])


def test_masks_of_both_views():
    views = rig()
    points = np.tile(np.array([[10.0, 0, 0, 0], [10, 1, 0, 0], [10, -1, 0, 0]], np.float32), (20, 1))
    # the three directions are at columns 500, 450, 550 in the left image and 475, 425, 525 in the right one
    box = [[400.0, 150, 600, 250]]
    masks = [InstanceMask(400, 150, np.ones((100, 120), bool)), InstanceMask(440, 150, np.ones((100, 160), bool))]
    found = [Detections2D(box, [0.9], [0], KITTI_CLASSES, (m,)) for m in masks]
    selected = [np.array([0]), np.zeros(0, int)]
    pairs = np.array([[0, 0, 1, 0]])
    marked = extract_frustums(points, views, found, selected, mask_mode="box+mask", pairs=pairs)
    assert (len(marked.points), marked.mask.sum()) == (60, 20)
    assert len(extract_frustums(points, views, found, selected, mask_mode="mask", pairs=pairs).points) == 20


def test_single_view_recovers_what_only_one_view_has():
    found = {"left": both([NEAR])["left"], "right": none2d()}
    fused = fuse(lidar([], []), found, surface_points([NEAR]), unpaired="single_view")
    assert fused.outcomes.tolist() == [Outcome.RECOVERED]
    assert fused.detections.scores[0] == pytest.approx(0.9)
    assert fused.camera.row(0)["pair"] is None


def test_pairs_and_single_views_together():
    views, objects = rig(), [NEAR, WALKER]
    labels = [CAR, PEDESTRIAN]
    found = {"left": seen(views[0], objects, [0.9, 0.8], labels), "right": seen(views[1], [NEAR], [0.7], [CAR])}
    fused = fuse(lidar([], []), found, surface_points(objects), objects, unpaired="single_view")
    assert fused.detections.scores == pytest.approx([0.9, 0.8])
    assert [fused.camera.row(i)["pair"] for i in range(3)] == [2, None, 0]
    alone = fuse(lidar([], []), found, surface_points(objects), objects)
    assert [alone.camera.row(i)["reason"] for i in range(3)] == ["localized", "unpaired", "localized"]


def test_object_confirmed_in_the_other_view_is_no_candidate():
    # matched in the left view; the right box is too wide to match (IoU 0.4) but shows the same car
    found = both([NEAR])
    found["right"] = widened(found["right"], 2.5)
    fused = fuse(lidar([NEAR], [0.7]), found, surface_points([NEAR]), unpaired="single_view")
    assert fused.camera.row(1)["reason"] == "seen_elsewhere"
    assert len(fused) == 1


def test_one_view_of_a_pair_must_be_decisive():
    points = surface_points([NEAR])
    settings = {"decisive_score": 0.5, "camera_score_threshold": 0.1}
    fused = fuse(lidar([], []), both([NEAR], (0.3, 0.8)), points, **settings)
    assert fused.detections.scores == pytest.approx([0.8])
    weak = fuse(lidar([], []), both([NEAR], (0.3, 0.4)), points, **settings)
    assert [weak.camera.row(i)["reason"] for i in range(2)] == ["low_score"] * 2
    alone = fuse(
        lidar([], []), {**both([NEAR], (0.4, 0.8)), "right": none2d()}, points, **settings, unpaired="single_view"
    )
    assert [alone.camera.row(i)["reason"] for i in range(1)] == ["low_score"]


def test_fate_of_both_detections_of_a_pair_is_one():
    found = both([NEAR, WALKER], labels=[CAR, PEDESTRIAN])
    few = fuse(lidar([], []), found, surface_points([NEAR]), [NEAR])
    assert [few.camera.row(i)["reason"] for i in range(4)] == ["localized", "few_points"] * 2
    mute = fuse(
        lidar([], []), found, surface_points([NEAR, WALKER]), localizer=lambda p: (np.full((2, 7), np.nan), np.zeros(2))
    )
    assert [mute.camera.row(i)["reason"] for i in range(4)] == ["not_localized"] * 4


def test_recovered_double_of_a_confirmed_box():
    views = rig()
    wide = car(12, 2.4)
    found = {v.name: seen(v, [NEAR, wide], [0.9, 0.8]) for v in views}
    fused = fuse(lidar([NEAR], [0.7]), found, surface_points([NEAR]), [NEAR], confirm_iou=0.1, match_iou=0.6)
    assert sorted(fused.camera.row(i)["reason"] for i in range(4)) == [
        "confirmed",
        "duplicate",
        "duplicate",
        "second_view",
    ]
    assert len(fused) == 1


def test_without_a_scan():
    fused = fuse(lidar([], []), both([NEAR]))
    assert [fused.camera.row(i)["reason"] for i in range(2)] == ["no_scan"] * 2
    off = fuse(lidar([], []), both([NEAR]), surface_points([NEAR]), recovery=False)
    assert [off.camera.row(i)["reason"] for i in range(2)] == ["no_recovery"] * 2


def test_one_view_missing_is_a_single_camera():
    fused = fuse(lidar([], []), {"left": both([NEAR])["left"]}, surface_points([NEAR]))
    assert fused.outcomes.tolist() == [Outcome.RECOVERED]
    assert any("left was used as a single camera" in note for note in fused.notes)
    assert any("right has no detections" in note for note in fused.notes)


def test_two_pairs_and_a_single_camera():
    front, rear = rig("fl", "fr"), rig("rl", "rr", yaw=np.pi)
    side = camera("side", yaw=np.pi / 2)
    views = [*front, side, *rear]
    objects = [car(12, 2), car(-12, -2), car(1, 12, yaw=0.3)]
    found = {
        **both(objects[:1], views=front),
        **both(objects[1:2], (0.5, 0.6), views=rear),
        "side": seen(side, objects[2:], [0.7]),
    }
    fused = fuse(
        lidar([objects[1]], [0.7]),
        found,
        surface_points(objects),
        objects,
        views,
        pairs=[["fl", "fr"], ["rl", "rr"]],
        camera_score_threshold=0.4,
    )
    # front pair and side camera are recovered; behind, 0.7 * 0.5 * 0.6 against 0.3 * 0.5 * 0.4
    assert fused.detections.scores == pytest.approx([0.9, 0.7 * 0.6 / (0.7 * 0.6 + 0.3 * 0.4), 0.7])
    assert fused.outcomes.tolist() == [Outcome.RECOVERED, Outcome.MATCHED, Outcome.RECOVERED]


def test_more_confident_view_becomes_primary_within_its_own_pair_only():
    # a third camera, in no pair, overlaps best: it stays the primary match, and the pair's views follow it
    views = [*rig(), moved(camera("middle"), right=0.25)]
    found = both([NEAR], (0.9, 0.8), views=views[:2])
    found = {name: widened(d, 1.2) for name, d in found.items()}
    found["middle"] = seen(views[2], [NEAR], [0.6])
    fused = fuse(lidar([NEAR], [0.8]), found, views=views)
    assert fused.camera.row(2)["reason"] == "confirmed"
    assert fused.detections.scores[0] == pytest.approx(0.8 * 0.6 / (0.8 * 0.6 + 0.2 * 0.4))


@pytest.mark.parametrize(
    ("views", "message"),
    [
        (rig()[::-1], None),
        ([replace(rig()[0], name="right"), replace(rig()[1], name="left")], "exchange the two"),
        ([camera("left"), camera("right")], "must stand apart"),
        ([rig()[0], replace(rig()[1], height=300)], "1000 x 400 and 1000 x 300"),
        ([camera("left")], r"no calibration of 'right', only of \['left'\]"),
    ],
)
def test_bad_pairs_are_one_sentence(views, message):
    found = {"left": none2d(), "right": none2d()}
    if message is None:
        assert len(fuse(lidar([], []), found, views=views)) == 0  # the order in the frame does not matter
        return
    with pytest.raises(Lcf3dError, match=message):
        fuse(lidar([], []), found, views=views)


def test_exchanged_detections_are_refused():
    found = both([car(12, 2), car(8, -3), car(15, 4)])
    with pytest.raises(Lcf3dError, match="with the views exchanged"):
        fuse(lidar([], []), {"left": found["right"], "right": found["left"]}, epipolar_gate_px=3)


@pytest.mark.parametrize("ensemble", ["evidence", "none"])
def test_other_ensembles_are_those_of_the_more_confident_view(ensemble):
    found = both([NEAR], (0.9, 0.6))
    stereo = fuse(lidar([NEAR], [0.8]), found, ensemble=ensemble)
    single = fuse(lidar([NEAR], [0.8]), {"left": found["left"]}, ensemble=ensemble)
    assert stereo.detections.scores == pytest.approx(single.detections.scores)
    assert stereo.lidar.row(0)["pair"] == 1


def test_recovered_boxes_are_trusted_as_much_as_with_one_view():
    found = both([NEAR], (0.9, 0.9))
    stereo = fuse(lidar([], []), found, surface_points([NEAR]), ensemble="evidence")
    single = fuse(lidar([], []), {"left": found["left"]}, surface_points([NEAR]), ensemble="evidence")
    assert 0 < stereo.detections.scores[0] < 0.9
    assert stereo.detections.scores == pytest.approx(single.detections.scores)


def test_a_camera_that_the_frame_lacks_is_not_calibrated():
    with pytest.raises(Lcf3dError, match="needs both cameras calibrated"):
        fuse(lidar([], []), {"left": none2d()}, views=[camera("left")])
    # a pair of which there is nothing at all is no business of this frame
    assert len(fuse(lidar([], []), {"front": none2d()}, views=[camera("front")])) == 0


@pytest.mark.parametrize("name", ["paper", "kitti", "nuscenes"])
def test_settings_survive_a_file(name, tmp_path):
    config = StereoConfig.preset(name)
    config.dump(tmp_path / "c.yaml")
    assert StereoConfig.load(str(tmp_path / "c.yaml")) == config
    assert StereoConfig.load(name) == config
    assert config.match_iou == 0.5
    paper = (False, "discard")
    assert (config.check_depth, config.unpaired) == (paper if name == "paper" else (True, "single_view"))


def test_senseless_settings():
    with pytest.raises(Lcf3dError, match="name each camera once"):
        StereoConfig.of({"pairs": [["a", "b"], ["b", "c"]]})
    with pytest.raises(Lcf3dError, match="epipolar_gate_px"):
        StereoConfig.of({"epipolar_gate_px": 0})
    with pytest.raises(Lcf3dError, match="no preset"):
        StereoConfig.preset("waymo")


def random_scene(seed):
    rng = np.random.default_rng(seed)
    objects = [car(x, y, yaw) for x, y, yaw in rng.uniform([8, -8, -3], [45, 8, 3], (7, 3))]
    noisy = np.array(objects)[rng.integers(0, 4, 12)] + rng.normal(0, 0.2, (12, 7))
    found3d = lidar(noisy, rng.choice([0.2, 0.5, 0.7, 0.9], 12), rng.integers(0, 3, 12))
    found = {}
    for view in rig():
        chosen = [o for o in objects if rng.random() < 0.8] or objects[:1]
        n = len(chosen)
        exact = seen(view, chosen, rng.uniform(0.4, 1, n), rng.choice([0, 0, 0, 2], n))
        found[view.name] = replace(exact, boxes=exact.boxes + rng.normal(0, 1.5, (n, 4)))
    return objects, found3d, found


@given(st.integers(0, 300), st.sampled_from(["discard", "single_view"]), st.sampled_from(["gated", "paper"]))
@settings(max_examples=40, deadline=None)
def test_every_input_and_output_is_accounted_for(seed, unpaired, assignment):
    objects, found3d, found = random_scene(seed)
    fused = fuse(found3d, found, surface_points(objects), objects, unpaired=unpaired, assignment=assignment)
    led = np.concatenate([fused.lidar.output, fused.camera.output])
    assert set(led[led >= 0]) == set(range(len(fused)))
    table = fused.camera
    assert ((table.outcome == Outcome.DROPPED) == (table.output < 0)).all()
    paired = np.flatnonzero(table.pair >= 0)
    other = table.pair[paired]
    np.testing.assert_array_equal(table.pair[other], paired)
    np.testing.assert_array_equal(table.output[other], table.output[paired])
    assert (table.camera[other] != table.camera[paired]).all()
    assert not np.isin(table.reason[paired], [Reason.UNPAIRED, Reason.OTHER_VIEW]).any()
    recovered = paired[table.outcome[paired] == Outcome.RECOVERED]
    expected = np.fmax(table.camera_score[recovered], table.camera_score[table.pair[recovered]])
    overlaps = table.iou[recovered] * table.iou[table.pair[recovered]]
    np.testing.assert_allclose(fused.detections.scores[table.output[recovered]], expected * overlaps)
    for i in range(len(fused)):
        assert fused.explain(i)
    back = FusedDetections.from_json(fused.to_json())
    assert back.to_json() == fused.to_json()


@given(st.integers(0, 300))
@settings(max_examples=20, deadline=None)
def test_result_does_not_depend_on_the_order_of_detections(seed):
    objects, found3d, found = random_scene(seed)
    points = surface_points(objects)
    rng = np.random.default_rng(seed)
    shuffled = {name: d[rng.permutation(len(d))] for name, d in found.items()}
    plain, other = fuse(found3d, found, points, objects), fuse(found3d, shuffled, points, objects)
    np.testing.assert_array_equal(plain.detections.boxes, other.detections.boxes)
    np.testing.assert_allclose(plain.detections.scores, other.detections.scores)

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d import FusionConfig, LateCascadeFusion, Lcf3dError
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D
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

NEAR, FAR, WALKER = car(12, 2), car(25, -5), pedestrian(15, -4)


def fuse(found3d, found2d, points=None, objects=(), views=None, **settings):
    views = views or [camera()]
    fusion = LateCascadeFusion(FusionConfig(**PLAIN).updated(**settings), TrueLocalizer(objects or [NEAR]))
    return fusion(frame(views, points), found3d, found2d)


def none2d():
    return Detections2D.empty(KITTI_CLASSES)


def test_matched_recovered_and_dropped():
    points = surface_points([NEAR, WALKER])
    found2d = seen(camera(), [NEAR, WALKER], [0.9, 0.8], [CAR, PEDESTRIAN])
    fused = fuse(lidar([NEAR, FAR], [0.7, 0.6]), {"left": found2d}, points, [NEAR, WALKER])
    names = [KITTI_CLASSES[i] for i in fused.detections.labels]
    assert sorted(zip(names, fused.outcomes.tolist(), strict=True)) == [
        ("Car", Outcome.MATCHED),
        ("Pedestrian", Outcome.RECOVERED),
    ]
    walker = names.index("Pedestrian")
    np.testing.assert_allclose(fused.detections.boxes[walker], WALKER, atol=1e-6)
    assert fused.detections.scores[walker] == pytest.approx(0.8)  # s2d * IoU, and the IoU is 1
    assert fused.lidar.row(1)["outcome"] == "dropped"
    assert fused.lidar.row(1)["reason"] == "unconfirmed"
    assert "image IoU 1.00" in fused.explain(1 - walker)
    assert fused.explain_lidar(1).startswith("Car 0.60, dropped: it is in view of a camera and no camera detection")
    assert fused.explain_camera(1).startswith("Pedestrian 0.80, recovered: the frustum localizer found the object")


def test_scores_of_a_match_are_the_ensemble():
    fused = fuse(lidar([NEAR], [0.8]), {"left": seen(camera(), [NEAR], [0.7])})
    assert fused.detections.scores[0] == pytest.approx(1.12 / 1.24)
    row = fused.lidar.row(0)
    assert (row["lidar_score"], row["camera_score"], row["detection"]) == (0.8, 0.7, 0)


def test_the_camera_decides_the_label():
    fused = fuse(lidar([NEAR], [0.8], [CYCLIST]), {"left": seen(camera(), [NEAR], [0.85], [CAR])})
    assert fused.detections.labels.tolist() == [CAR]
    assert fused.detections.scores.tolist() == [0.85]


@pytest.mark.parametrize(("relabel_score", "label", "score"), [(0.69, CAR, 0.7), (0.7, CYCLIST, 0.8)])
def test_a_camera_that_is_not_sure_changes_no_label(relabel_score, label, score):
    found2d = seen(camera(), [NEAR], [0.7], [CAR])
    fused = fuse(lidar([NEAR], [0.8], [CYCLIST]), {"left": found2d}, relabel_score=relabel_score)
    assert fused.detections.labels.tolist() == [label]
    assert fused.detections.scores.tolist() == [score]
    assert fused.outcomes.tolist() == [Outcome.MATCHED]


@pytest.mark.parametrize(("policy", "score"), [("drop", None), ("keep", 0.6), ("downweight", 0.6 * 0.2 / 0.44)])
def test_policies_for_unmatched_clusters(policy, score):
    fused = fuse(lidar([FAR], [0.6]), {"left": none2d()}, unmatched=policy)
    assert fused.detections.scores.tolist() == pytest.approx([] if score is None else [score])


@pytest.mark.parametrize(("policy", "count"), [("keep", 1), ("drop", 0)])
def test_policies_for_clusters_out_of_view(policy, count):
    fused = fuse(lidar([car(-20)], [0.6]), {"left": none2d()}, out_of_view=policy)
    assert len(fused) == count
    assert fused.lidar.row(0)["reason"] == "out_of_view"


def test_without_any_camera_the_lidar_stands_alone():
    fused = fuse(lidar([NEAR, car(-20)], [0.7, 0.6]), {}, out_of_view="drop")
    assert fused.detections.scores.tolist() == [0.7, 0.6]
    assert "camera left has no detections" in fused.notes[0]


def test_a_camera_that_was_not_used_judges_nothing():
    views = [camera("front"), camera("back", np.pi)]
    fused = fuse(lidar([car(-20)], [0.6]), {"front": none2d()}, views=views)
    assert fused.lidar.row(0)["reason"] == "out_of_view"
    assert fused.camera_names == ("front",)


def test_cluster_members_are_merged_and_say_so():
    boxes = [NEAR, [*NEAR[:6], 0.05], car(12.2, 2.1)]
    fused = fuse(lidar(boxes, [0.5, 0.9, 0.4]), {"left": seen(camera(), [NEAR], [0.9])})
    assert len(fused) == 1
    np.testing.assert_allclose(fused.detections.boxes[0], boxes[1])
    assert [fused.lidar.row(i)["reason"] for i in range(3)] == ["in_cluster", "confirmed", "in_cluster"]
    assert fused.dropped_lidar.tolist() == []


def test_representative_of_the_cameras_class():
    found = lidar([NEAR, car(12.1, 2)], [0.9, 0.5], [CYCLIST, CAR])
    views = {"left": seen(camera(), [NEAR], [0.9], [CAR])}
    assert fuse(found, views).lidar.row(0)["outcome"] == "matched"
    by_class = fuse(found, views, representative="camera_class")
    assert by_class.lidar.row(1)["outcome"] == "matched"
    assert by_class.detections.labels.tolist() == [CAR]
    # a class that no member has leaves the highest score
    other = {"left": seen(camera(), [NEAR], [0.9], [PEDESTRIAN])}
    assert fuse(found, other, representative="camera_class").lidar.row(0)["outcome"] == "matched"


def test_recovery_reasons():
    objects = [NEAR, WALKER]
    found2d = seen(camera(), [WALKER, car(30, -15)], [0.8, 0.8], [PEDESTRIAN, CAR])
    no_scan = fuse(lidar([], []), {"left": found2d})
    assert [no_scan.camera.row(i)["reason"] for i in range(2)] == ["no_scan", "no_scan"]
    assert "could not be recovered" in no_scan.notes[-1]
    off = fuse(lidar([], []), {"left": found2d}, surface_points(objects), objects, recovery=False)
    assert off.camera.row(0)["reason"] == "no_recovery"
    on = fuse(lidar([], []), {"left": found2d}, surface_points(objects), objects)
    assert [on.camera.row(i)["reason"] for i in range(2)] == ["localized", "few_points"]


def test_recovered_box_must_project_onto_its_detection():
    # the localizer answers with a car ten metres further: its projection is too small
    points = surface_points([NEAR])
    wrong = LateCascadeFusion(
        FusionConfig(**PLAIN), lambda p: (p.frustum_from_lidar(np.array([car(40, 6.7)])), np.ones(1))
    )
    fused = wrong(frame([camera()], points), lidar([], []), {"left": seen(camera(), [NEAR], [0.9])})
    assert len(fused) == 0
    assert fused.camera.row(0)["reason"] == "disagrees"
    assert 0 < fused.camera.row(0)["iou"] < 0.3


@pytest.mark.parametrize(("quality", "reason"), [(0.29, "poor_fit"), (0.3, "localized")])
def test_quality_of_the_fit_is_asked_for(quality, reason):
    doubtful = LateCascadeFusion(
        FusionConfig(**PLAIN), lambda p: (p.frustum_from_lidar(np.array([NEAR])), np.full(len(p), quality))
    )
    fused = doubtful(frame([camera()], surface_points([NEAR])), lidar([], []), {"left": seen(camera(), [NEAR], [0.9])})
    assert fused.camera.row(0)["reason"] == reason
    assert fused.camera.row(0)["quality"] == quality


def test_localizer_without_an_answer():
    mute = LateCascadeFusion(FusionConfig(**PLAIN), lambda p: (np.full((len(p), 7), np.nan), np.zeros(len(p))))
    fused = mute(frame([camera()], surface_points([NEAR])), lidar([], []), {"left": seen(camera(), [NEAR], [0.9])})
    assert fused.camera.row(0)["reason"] == "not_localized"


def test_localizer_of_the_wrong_shape_is_named():
    wrong = LateCascadeFusion(FusionConfig(**PLAIN), lambda p: (np.zeros((len(p), 6)), np.zeros(len(p))))
    with pytest.raises(Lcf3dError, match=r"boxes of shape \(1, 7\) and as many qualities, got \(1, 6\)"):
        wrong(frame([camera()], surface_points([NEAR])), lidar([], []), {"left": seen(camera(), [NEAR], [0.9])})


def test_recovered_double_of_a_confirmed_box():
    # two 2D boxes of one car: the first matches, the second finds the same object in its frustum
    found2d = seen(camera(), [NEAR], [0.9])
    wide = found2d.boxes[0] + [-20, -5, 20, 5]
    twice = Detections2D(np.stack([found2d.boxes[0], wide]), [0.9, 0.8], [CAR, CAR], KITTI_CLASSES)
    fused = fuse(lidar([NEAR], [0.7]), {"left": twice}, surface_points([NEAR]), [NEAR])
    assert fused.camera.row(1)["reason"] == "duplicate"
    assert len(fused) == 1


@pytest.mark.parametrize(
    ("score", "reasons"), [(0.4, ("replaced", "localized")), (0.98, ("downweighted", "duplicate"))]
)
def test_of_a_recovered_box_and_an_unconfirmed_one_on_one_spot_the_higher_score_stays(score, reasons):
    shifted = car(13.0, 2.3)  # too far off to match at 0.9, but on the same spot
    fused = fuse(
        lidar([shifted], [score]),
        {"left": seen(camera(), [NEAR], [0.9])},
        surface_points([NEAR]),
        [NEAR],
        match_iou=0.9,
        unmatched="downweight",
    )
    assert (fused.lidar.row(0)["reason"], fused.camera.row(0)["reason"]) == reasons
    assert fused.outcomes.tolist() == [Outcome.RECOVERED if score < 0.5 else Outcome.KEPT]


def test_a_recovered_box_that_gives_way_takes_no_other_place():
    # it overlaps two unconfirmed boxes, of which one is surer than it
    sure, unsure = car(13.0, 2.3), car(11.0, 1.7)
    fused = fuse(
        lidar([sure, unsure], [0.98, 0.2]),
        {"left": seen(camera(), [NEAR], [0.9])},
        surface_points([NEAR]),
        [NEAR],
        match_iou=0.95,
        cluster_iou=0.9,
        unmatched="downweight",
    )
    assert [fused.lidar.row(i)["reason"] for i in range(2)] == ["downweighted", "downweighted"]
    assert fused.camera.row(0)["reason"] == "duplicate"


def two_cameras():
    return [camera("a", np.radians(30)), camera("b", np.radians(-30))]


def test_object_in_two_cameras_comes_out_once():
    views = two_cameras()
    middle = car(12)
    found = {view.name: seen(view, [middle], [0.9]) for view in views}
    matched = fuse(lidar([middle], [0.7]), found, views=views)
    assert len(matched) == 1
    assert sorted(matched.camera.row(i)["reason"] for i in range(2)) == ["confirmed", "other_view"]
    assert [matched.camera.row(i)["output"] for i in range(2)] == [0, 0]
    recovered = fuse(lidar([], []), found, surface_points([middle]), [middle], views=views)
    assert len(recovered) == 1
    assert sorted(recovered.camera.row(i)["reason"] for i in range(2)) == ["duplicate", "localized"]


def test_truncated_view_of_a_confirmed_object_is_not_recovered():
    views = two_cameras()
    middle = car(12)
    exact = seen(views[1], [middle], [0.9])
    half = exact.boxes.copy()
    half[0, 2] = half[0, [0, 2]].mean()
    found = {"a": seen(views[0], [middle], [0.9]), "b": Detections2D(half, [0.9], [CAR], KITTI_CLASSES)}
    fused = fuse(lidar([middle], [0.7]), found, surface_points([middle]), [middle], views=views, match_iou=0.6)
    assert fused.camera.row(1)["reason"] == "seen_elsewhere"
    assert len(fused) == 1


def test_what_takes_no_part_is_written_down():
    boxes = [NEAR, FAR, car(30), [*car(40)[:3], 0, 1, 1, 0], [np.nan, *car(5)[1:]]]
    found = Detections3D(boxes, [0.9, 0.05, 0.9, 0.9, 0.9], [0, 0, 1, 0, 0], ("Car", "Tram"))
    fused = fuse(found, {"left": none2d()}, unmatched="keep")
    reasons = [fused.lidar.row(i)["reason"] for i in range(5)]
    assert reasons == ["unconfirmed", "low_score", "other_class", "invalid", "invalid"]
    assert len(fused) == 1


def test_cap_keeps_the_best():
    boxes = [car(10 + 6 * i) for i in range(5)]
    fused = fuse(lidar(boxes, [0.5, 0.9, 0.4, 0.8, 0.3]), {"left": none2d()}, unmatched="keep", max_boxes=2)
    assert fused.detections.scores.tolist() == [0.9, 0.8]
    assert [fused.lidar.row(i)["reason"] for i in (0, 2, 4)] == ["too_many"] * 3


@pytest.mark.parametrize(
    ("found3d", "found2d", "message"),
    [
        (lidar([NEAR], [7.0]), {}, r"LiDAR scores must lie in \[0, 1\].*calibrat"),
        (lidar([NEAR], [np.nan]), {}, r"LiDAR scores must lie in \[0, 1\]"),
        (lidar([], []), {"left": seen(camera(), [NEAR], [1.5])}, r"camera left: scores must lie in \[0, 1\]"),
        (lidar([], []), {"rear": none2d()}, r"detections of cameras \['rear'\]"),
        (Detections3D([NEAR], [0.5], [0], ("tram",)), {}, "share no name"),
    ],
)
def test_bad_input_is_one_sentence(found3d, found2d, message):
    with pytest.raises(Lcf3dError, match=message):
        fuse(found3d, found2d)


def test_nothing_at_all():
    fused = fuse(lidar([], []), {"left": none2d()}, np.zeros((0, 4), np.float32))
    assert len(fused) == 0
    assert fused.notes == ()


def test_points_that_are_not_finite_are_noted():
    points = surface_points([NEAR])
    points[3, 0] = np.nan
    fused = fuse(lidar([], []), {"left": seen(camera(), [NEAR], [0.9])}, points)
    assert fused.notes == ("1 points of the scan are not finite and were not used",)
    assert len(fused) == 1


def test_velocity_and_attribute_travel_with_the_box():
    found = Detections3D([NEAR], [0.8], [CAR], KITTI_CLASSES, [[1.0, 2.0]], ["vehicle.moving"])
    objects = [NEAR, WALKER]
    views = {"left": seen(camera(), objects, [0.9, 0.8], [CAR, PEDESTRIAN])}
    fused = fuse(found, views, surface_points(objects), objects)
    assert fused.detections.velocities[0].tolist() == [1, 2]
    assert np.isnan(fused.detections.velocities[1]).all()
    assert fused.detections.attributes.tolist() == ["vehicle.moving", ""]


def random_scene(seed):
    rng = np.random.default_rng(seed)
    objects = [car(x, y, yaw) for x, y, yaw in rng.uniform([8, -12, -3], [45, 12, 3], (6, 3))]
    noisy = np.array(objects)[rng.integers(0, 6, 15)] + rng.normal(0, 0.3, (15, 7))
    found3d = lidar(noisy, rng.choice([0.2, 0.5, 0.7, 0.9], 15), rng.integers(0, 3, 15))
    corner = rng.uniform([0, 100], [800, 200], (8, 2))
    found2d = Detections2D(
        np.concatenate([corner, corner + rng.uniform(20, 200, (8, 2))], axis=1),
        rng.uniform(0.3, 1, 8),
        rng.integers(0, 3, 8),
        KITTI_CLASSES,
    )
    return objects, found3d, found2d


@given(st.integers(0, 300), st.sampled_from(["drop", "keep", "downweight"]), st.sampled_from(["gated", "paper"]))
@settings(max_examples=40, deadline=None)
def test_every_input_and_output_is_accounted_for(seed, unmatched, assignment):
    objects, found3d, found2d = random_scene(seed)
    fused = fuse(
        found3d, {"left": found2d}, surface_points(objects), objects, unmatched=unmatched, assignment=assignment
    )
    assert len(fused.lidar) == len(found3d)
    assert len(fused.camera) == len(found2d)
    led = np.concatenate([fused.lidar.output, fused.camera.output])
    assert set(led[led >= 0]) == set(range(len(fused)))
    for table in (fused.lidar, fused.camera):
        assert ((table.outcome == Outcome.DROPPED) == (table.output < 0)).all()
    matched = fused.lidar.outcome == Outcome.MATCHED
    outputs = fused.lidar.output[matched]
    np.testing.assert_array_equal(fused.detections.boxes[outputs], found3d.boxes[matched])
    np.testing.assert_array_equal(fused.detections.scores[outputs], fused.lidar.score[matched])
    assert (np.diff(fused.detections.scores) <= 0).all()
    assert (fused.camera.reason == Reason.CONFIRMED).sum() == matched.sum()
    assert fused.explanations() == [fused.explain(i) for i in range(len(fused))]


@given(st.integers(0, 300))
@settings(max_examples=20, deadline=None)
def test_result_does_not_depend_on_the_order_of_lidar_boxes(seed):
    objects, found3d, found2d = random_scene(seed)
    shuffle = np.random.default_rng(seed).permutation(len(found3d))
    points = surface_points(objects)
    plain = fuse(found3d, {"left": found2d}, points, objects)
    shuffled = fuse(found3d[shuffle], {"left": found2d}, points, objects)
    np.testing.assert_array_equal(plain.detections.boxes, shuffled.detections.boxes)
    np.testing.assert_array_equal(plain.detections.scores, shuffled.detections.scores)


def test_provenance_survives_json():
    objects, found3d, found2d = random_scene(3)
    fused = fuse(found3d, {"left": found2d}, surface_points(objects), objects)
    back = FusedDetections.from_json(fused.to_json())
    assert back.to_json() == fused.to_json()
    assert back.explain(0) == fused.explain(0)


def test_default_localizer_needs_no_weights():
    fused = LateCascadeFusion()(
        frame([camera()], surface_points([NEAR])), lidar([], []), {"left": seen(camera(), [NEAR], [0.9])}
    )
    assert len(fused.camera) == 1

"""Fusion by evidence through the pipeline: competitors, weak detections, classes that a camera does not know."""

import numpy as np
import pytest

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.fusion.calibration import Calibration, ScoreMap
from lcf3d.fusion.cluster_evidence import competing_scores
from lcf3d.fusion.evidence import Evidence, to_probability
from lcf3d.structures import KITTI_CLASSES, Detections2D
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
BICYCLE = [15.1, -4, -0.7, 0.8, 0.6, 1.8, 0.0]


def fuse(found3d, found2d, calibration=None, points=None, **settings):
    config = FusionConfig.preset("kitti").updated(**settings)
    fusion = LateCascadeFusion(config, TrueLocalizer([NEAR, WALKER]), calibration)
    return fusion(frame([camera()], points), found3d, {"left": found2d})


def none2d():
    return Detections2D.empty(KITTI_CLASSES)


def test_scores_follow_the_formula():
    weights = Evidence(base=-1, trust=0.5, support=(1, 2, 3, 4), miss=0.5, off_ground=0, competing=0)
    evidence = {"Car": weights.model_dump()}
    fused = fuse(lidar([NEAR], [0.8]), seen(camera(), [NEAR], [0.5]), evidence=evidence)
    assert fused.detections.scores[0] == pytest.approx(to_probability(-1 + 0.5 * np.log(4) + 0.5 * 4))
    alone = fuse(lidar([FAR], [0.8]), none2d(), evidence=evidence)
    exposure = np.log(fused_height(FAR) / 25) / np.log(6)
    assert alone.detections.scores[0] == pytest.approx(to_probability(-1 + 0.5 * np.log(4) - 0.5 * exposure))


def fused_height(box):
    found = seen(camera(), [box], [1.0]).boxes[0]
    return found[3] - found[1]


def test_calibration_gives_maps_and_weights():
    calibration = Calibration(
        lidar={"Car": ScoreMap(slope=1.0)},
        camera={"Car": ScoreMap(slope=1.0)},
        evidence={"Car": Evidence.lidar_alone()},
    )
    fused = fuse(lidar([NEAR], [3.0]), seen(camera(), [NEAR], [4.0]), calibration)
    assert fused.detections.scores[0] == pytest.approx(to_probability(3.0))
    assert fused.lidar_inputs.scores.tolist() == [3.0]
    assert fused.camera_inputs[0].scores.tolist() == [4.0]
    assert fused.camera.camera_score[0] == pytest.approx(to_probability(4.0))


def test_unbounded_scores_need_a_calibration():
    from lcf3d import Lcf3dError

    with pytest.raises(Lcf3dError, match="lcf3d calibrate"):
        fuse(lidar([NEAR], [3.0]), none2d())


def test_boxes_of_a_class_the_camera_does_not_know_are_class_not_detected():
    calibration = Calibration(camera_classes=("Car", "Pedestrian"))
    rider = seen(camera(), [WALKER], [0.9], [PEDESTRIAN])
    fused = fuse(lidar([WALKER], [0.6], [CYCLIST]), rider, calibration, unmatched="drop")
    assert fused.detections.labels.tolist() == [CYCLIST]
    assert fused.detections.scores.tolist() == [0.6]
    assert fused.lidar.row(0)["reason"] == "class_not_detected"
    known = fuse(lidar([WALKER], [0.6], [CYCLIST]), rider, unmatched="drop")
    assert known.detections.labels.tolist() == [PEDESTRIAN]


def test_equal_classes_are_paired_first():
    both = lidar([WALKER, BICYCLE], [0.5, 0.8], [PEDESTRIAN, CYCLIST])
    found = seen(camera(), [BICYCLE], [0.9], [PEDESTRIAN])
    fused = fuse(both, found)
    assert fused.lidar.detection.tolist() == [0, -1]
    # without the rounds the better overlap wins and turns the cyclist into a second pedestrian
    assert fuse(both, found, assignment="gated").lidar.detection.tolist() == [-1, 0]


def test_weak_detections_support_but_neither_relabel_nor_recover():
    weak = seen(camera(), [NEAR, WALKER], [0.3, 0.3], [CAR, PEDESTRIAN])
    points = surface_points([NEAR, WALKER])
    fused = fuse(lidar([NEAR, WALKER], [0.6, 0.6], [CAR, CYCLIST]), weak, points=points)
    assert fused.lidar.row(0)["reason"] == "confirmed"
    assert fused.lidar.row(1)["reason"] == "downweighted"
    assert fused.camera.row(1)["reason"] == "low_score"
    assert len(fused) == 2
    strong = seen(camera(), [NEAR, WALKER], [0.8, 0.8], [CAR, PEDESTRIAN])
    assert fuse(lidar([NEAR], [0.6]), strong, points=points).outcomes.tolist().count(1) == 1


def test_recovered_boxes_rank_below_confirmed_ones():
    both = seen(camera(), [NEAR, WALKER], [0.9, 0.9], [CAR, PEDESTRIAN])
    fused = fuse(lidar([NEAR], [0.6]), both, points=surface_points([NEAR, WALKER]))
    recovered = fused.detections.scores[fused.outcomes == 1]
    assert recovered == pytest.approx([0.9 * 0.7], abs=1e-6)


def test_ensemble_none_keeps_the_lidar_branch():
    fused = fuse(lidar([NEAR], [0.6], [CYCLIST]), seen(camera(), [NEAR], [0.9]), ensemble="none")
    assert fused.detections.labels.tolist() == [CYCLIST]
    assert fused.detections.scores.tolist() == [0.6]


def test_rivals_are_better_boxes_of_another_class_in_the_clique():
    config = FusionConfig(class_aware=True)
    boxes = np.array([WALKER, BICYCLE, FAR], dtype=float)
    labels = np.array([PEDESTRIAN, CYCLIST, CAR])
    assert competing_scores(boxes, np.array([0.5, 0.8, 0.9]), labels, config).tolist() == [0.8, 0, 0]
    assert competing_scores(boxes, np.array([0.5, 0.8, 0.9]), labels, FusionConfig(**PLAIN)).tolist() == [0, 0, 0]
    assert competing_scores(boxes, np.array([0.5, 0.8, 0.9]), labels * 0, config).tolist() == [0, 0, 0]


def test_weigh_gives_what_the_scores_are_made_of():
    config = FusionConfig.preset("kitti")
    fusion = LateCascadeFusion(config, TrueLocalizer([NEAR]), Calibration(camera_classes=("Car",)))
    found = lidar([car(-20), FAR, NEAR, WALKER], [0.9, 0.7, 0.6, 0.5], [CAR, CAR, CAR, PEDESTRIAN])
    two_d = {"left": seen(camera(), [NEAR], [0.8])}
    weighed = fusion.evidence(frame([camera()]), found, two_d)
    assert sorted(weighed.box.tolist()) == [0, 1, 2, 3]
    assert weighed.agreed[np.argsort(weighed.box)].tolist() == [False, True, True, False]
    fused = fusion(frame([camera()]), found, two_d)
    near = int(np.flatnonzero(weighed.box == 2)[0])
    expected = to_probability(weighed.table[near] @ Evidence().weights)
    assert fused.lidar.score[2] == pytest.approx(float(expected))

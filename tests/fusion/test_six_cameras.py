"""Six overlapping cameras: every object once, at the borders too; cameras that are not there judge nothing."""

from pathlib import Path

import numpy as np
import pytest

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_area
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D
from tests.fusion.scenes import CAR, PLAIN, TrueLocalizer, camera, car, lidar, surface_points

DEMO = "ca9a282c9e77460f8360f564131a8af5"
# 2D detections below this area in px are nothing a detector would report
SMALLEST = 200.0


def ring() -> list[Camera]:
    """Six cameras, 60 degrees apart, each 70 degrees wide: 10 degrees of overlap at every border."""
    focal = 500 / np.tan(np.radians(35))
    return [camera(f"cam{k}", np.radians(60 * k), focal=focal) for k in range(6)]


def around(azimuth_deg: float, distance: float = 12.0, turn_deg: float = 40.0) -> list[float]:
    """A car in that direction, turned so that no side is parallel to the line of sight."""
    a = np.radians(azimuth_deg)
    yaw = np.angle(np.exp(1j * (a + np.radians(turn_deg))))
    return car(distance * np.cos(a), distance * np.sin(a), yaw)


def detected(views, boxes, noise_px=0.0, seed=0):
    """2D detections of all that the cameras see of some boxes, cut at the image's edge, by camera name."""
    rng = np.random.default_rng(seed)
    found = {}
    for view in views:
        rectangles, visible = project_boxes(np.array(boxes, dtype=float).reshape(-1, 7), view)
        rectangles = rectangles[visible & (image_area(rectangles) > SMALLEST)]
        rectangles = rectangles + rng.normal(0, noise_px, rectangles.shape)
        rectangles = np.clip(rectangles, 0, [view.width, view.height] * 2)
        rectangles = rectangles[image_area(rectangles) > SMALLEST]
        n = len(rectangles)
        found[view.name] = Detections2D(rectangles, np.full(n, 0.8), np.full(n, CAR), KITTI_CLASSES)
    return found


def fuse(views, found3d, found2d, objects, points=None, **settings):
    fusion = LateCascadeFusion(FusionConfig(**PLAIN).updated(**settings), TrueLocalizer(objects))
    return fusion(Frame("ring", points, views), found3d, found2d)


def check_once(views, azimuths, noise_px):
    """At every azimuth one car comes out once: found by both branches, and found by the cameras only."""
    shared = 0
    for azimuth in azimuths:
        box = around(azimuth)
        found = detected(views, [box], noise_px, seed=int(10 * azimuth))
        seeing = sum(len(f) > 0 for f in found.values())
        assert seeing >= 1
        shared += seeing > 1
        points = surface_points([box])
        matched = fuse(views, lidar([box], [0.7]), found, [box], points)
        assert matched.outcomes.tolist() == [Outcome.MATCHED], azimuth
        # the other camera's view of it is accounted for, and led to nothing of its own
        others = [matched.camera.row(i)["reason"] for i in range(len(matched.camera))]
        assert others.count("confirmed") == 1
        assert set(others) <= {"confirmed", "other_view", "seen_elsewhere", "duplicate", "disagrees"}, azimuth
        recovered = fuse(views, lidar([], []), found, [box], points)
        assert recovered.outcomes.tolist() == [Outcome.RECOVERED], azimuth
        np.testing.assert_allclose(recovered.detections.boxes[0, :2], box[:2], atol=1e-6)
    return shared


@pytest.mark.parametrize("noise_px", [0.0, 4.0])
def test_a_car_anywhere_around_comes_out_once(noise_px):
    shared = check_once(ring(), np.arange(0.0, 360.0, 5.0), noise_px)
    assert shared > 20  # a car 12 m away spans 18 degrees, so that more than a third are cut by a border


def test_an_object_cut_by_both_images_is_confirmed_by_both_halves():
    views = ring()
    box = around(30.0, 8.0)
    found = detected(views, [box])
    assert found["cam0"].boxes[0, 0] == 0  # its left part is cut off in one camera,
    assert found["cam1"].boxes[0, 2] == 1000  # its right part in the other
    fused = fuse(views, lidar([box], [0.7]), found, [box], surface_points([box]))
    assert len(fused) == 1
    reasons = {fused.camera_names[fused.camera.camera[i]]: fused.camera.row(i)["reason"] for i in range(2)}
    assert sorted(reasons.values()) == ["confirmed", "other_view"]
    assert fused.camera.output.tolist() == [0, 0]


def test_two_objects_side_by_side_at_a_border_stay_two():
    views = ring()
    boxes = [around(27.0, 15.0, 0.0), around(38.0, 15.0, 0.0)]
    fused = fuse(views, lidar(boxes[:1], [0.7]), detected(views, boxes), boxes, surface_points(boxes))
    assert sorted(fused.outcomes.tolist()) == [Outcome.MATCHED, Outcome.RECOVERED]
    found = fused.detections.boxes[np.argsort(fused.outcomes)]
    np.testing.assert_allclose(found[:, :2], np.array(boxes)[:, :2], atol=1e-6)


def test_what_only_a_missing_camera_would_have_judged_is_out_of_view():
    views = ring()
    inside, at_border, ahead = around(120.0), around(90.0), around(0.0)
    found2d = detected(views, [ahead])
    del found2d["cam2"]
    fused = fuse(views, lidar([inside, at_border, ahead], [0.6, 0.5, 0.4]), found2d, [ahead], unmatched="drop")
    assert [fused.lidar.row(i)["reason"] for i in range(3)] == ["out_of_view", "unconfirmed", "confirmed"]
    assert [fused.lidar.row(i)["outcome"] for i in range(3)] == ["kept", "dropped", "matched"]
    assert fused.camera_names == ("cam0", "cam1", "cam3", "cam4", "cam5")
    assert any("camera cam2" in note for note in fused.notes)
    # with all six cameras somebody has looked there and seen nothing
    judged = fuse(views, lidar([inside], [0.6]), detected(views, [ahead]), [ahead], unmatched="drop")
    assert judged.lidar.row(0)["reason"] == "unconfirmed"
    assert not any("camera cam" in note for note in judged.notes)


def test_an_object_at_a_border_is_confirmed_by_the_camera_that_is_left():
    views = ring()
    box = around(30.0)
    found = detected(views, [box])
    del found["cam1"]
    fused = fuse(views, lidar([box], [0.7]), found, [box])
    assert fused.outcomes.tolist() == [Outcome.MATCHED]
    assert fused.camera_names[fused.lidar.camera[0]] == "cam0"


@pytest.mark.real
@pytest.mark.parametrize("noise_px", [0.0, 4.0])
def test_a_car_anywhere_around_the_real_vehicle_comes_out_once(shared: Path, noise_px: float) -> None:
    views = list(NuscenesDataset(shared / "data/nuscenes").frame(DEMO).cameras)
    assert len(views) == 6
    # cars stand on the ground 1.8 m below the LiDAR, and the cameras sit at different places and heights
    assert check_once(views, np.arange(0.0, 360.0, 6.0), noise_px) >= 10


@pytest.mark.real
def test_real_annotations_come_out_once_each(shared: Path) -> None:
    dataset = NuscenesDataset(shared / "data/nuscenes")
    frame = dataset.frame(DEMO)
    truth = frame.labels
    found = {}
    for view in frame.cameras:
        rectangles, visible = project_boxes(truth.boxes, view)
        seen = visible & (image_area(rectangles) > SMALLEST)
        found[view.name] = Detections2D(
            rectangles[seen], np.full(int(seen.sum()), 0.8), truth.labels[seen], truth.class_names
        )
    fusion = LateCascadeFusion(FusionConfig.preset("nuscenes").updated(recovery=False, cluster_iou=0.9))
    fused = fusion(frame, truth, found)
    assert len(fused) == len(truth)
    assert len(np.unique(fused.detections.boxes, axis=0)) == len(truth)
    shared_views = int((fused.camera.reason == Reason.OTHER_VIEW).sum())
    assert shared_views >= 5  # objects that two cameras see, among them the truck beside the vehicle
    without = fusion(frame, truth, {name: found[name] for name in found if name != "CAM_BACK"})
    lost = fused.lidar.reason != without.lidar.reason
    assert set(without.lidar.reason[lost].tolist()) <= {Reason.OUT_OF_VIEW, Reason.CONFIRMED, Reason.DOWNWEIGHTED}
    assert (without.lidar.reason == Reason.OUT_OF_VIEW).sum() > (fused.lidar.reason == Reason.OUT_OF_VIEW).sum()
    assert any("CAM_BACK " in note for note in without.notes)

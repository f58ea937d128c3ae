from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lcf3d.errors import ConfigError
from lcf3d.fusion.frustum import extract_frustums
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import bev_iou, image_iou, iou_3d
from lcf3d.localizers.geometric import GeometricLocalizer
from lcf3d.localizers.shapes import SHAPES, ObjectShape
from lcf3d.structures import ARGOVERSE_CLASSES, KITTI_CLASSES, NUSCENES_CLASSES, Detections2D, InstanceMask
from tests.localizers.scenes import camera, propose, scan, standing, turned_scene

CAR, PEDESTRIAN, CYCLIST = range(3)
localize = GeometricLocalizer()


def found(points, boxes, labels, localizer=localize, **options):
    """The located boxes in the LiDAR frame, and their qualities."""
    proposals = propose(points, boxes, labels, **options)
    assert len(proposals) == len(boxes)
    located, quality = localizer(proposals)
    assert located.shape == (len(boxes), 7)
    assert ((quality >= 0) & (quality <= 1)).all()
    return proposals.lidar_from_frustum(located), quality


def overlap(located, box):
    return bev_iou(located, np.array([box]))[0, 0]


def half_turn(angle):
    """Angle modulo half a turn, from -pi/2 to pi/2: a box says nothing of front and back."""
    return (angle + np.pi / 2) % np.pi - np.pi / 2


def person(x, y, yaw=0.0):
    """The parts that a LiDAR sees of a person, and the annotated box around them."""
    parts = [standing(x, y, 0.35, 0.5, 1.7, yaw), standing(x + 0.2, y + 0.1, 0.3, 0.2, 0.8, yaw)]
    return parts, standing(x, y, 0.84, 0.66, 1.75, yaw)


def rider(x, y, yaw):
    """The parts that a LiDAR sees of a cyclist, and the annotated box around them."""
    parts = [standing(x, y, 1.7, 0.1, 1.0, yaw), standing(x, y, 0.5, 0.5, 1.7, yaw)]
    return parts, standing(x, y, 1.8, 0.6, 1.75, yaw)


@pytest.mark.parametrize("distance", [8, 18, 35])
def test_cars_at_all_yaws(distance):
    overlaps, turned = [], []
    for degrees in range(0, 180, 15):
        box = standing(distance, 0.15 * distance, 4.1, 1.7, 1.5, np.radians(degrees))
        located, quality = found(scan([box]), [box], [CAR])
        overlaps.append(iou_3d(located, box[None])[0, 0])
        turned.append(abs(half_turn(located[0, 6] - box[6])))
        assert quality[0] > 0.6
    assert min(overlaps) > 0.6
    assert np.mean(overlaps) > 0.8
    assert np.degrees(np.median(turned)) < 4


@pytest.mark.parametrize("distance", [8, 20, 40])
def test_pedestrians(distance):
    for degrees in (0, 50, 100, 150):
        parts, box = person(distance, -0.1 * distance, np.radians(degrees))
        located, _ = found(scan(parts), [box], [PEDESTRIAN])
        assert np.linalg.norm(located[0, :3] - box[:3]) < 0.3
        assert overlap(located, box) > 0.4


@pytest.mark.parametrize("distance", [8, 20])
def test_cyclists_at_all_yaws(distance):
    for degrees in range(10, 180, 20):
        parts, box = rider(distance, 0.1 * distance, np.radians(degrees))
        located, _ = found(scan(parts), [box], [CYCLIST])
        assert overlap(located, box) > 0.45
        assert abs(np.degrees(half_turn(located[0, 6] - box[6]))) < 15


def test_an_occluder_in_front_is_not_the_car():
    car = standing(20, 1, 4.0, 1.65, 1.5, 0.4)
    pole, bush = standing(14, 0.6, 0.3, 0.3, 3, 0), standing(11, 1.6, 1.0, 1.0, 1.0, 0)
    located, _ = found(scan([car, pole, bush]), [car], [CAR])
    assert overlap(located, car) > 0.7


def test_a_car_behind_a_car():
    front, rear = standing(12, 0.2, 4.0, 1.65, 1.5, 0.0), standing(24, 1.6, 4.0, 1.65, 1.5, 0.0)
    located, _ = found(scan([front, rear]), [front, rear], [CAR, CAR])
    assert overlap(located[:1], front) > 0.7
    assert overlap(located[1:], rear) > 0.7


def test_background_through_the_windows():
    car = standing(12, -2, 4.0, 1.65, 1.5, 0.5)
    body, wall = standing(12, -2, 4.0, 1.65, 0.85, 0.5), standing(18, 0, 0.5, 30, 4, 0)
    points = scan([body, wall])
    proposals = propose(points, [car], [CAR])
    behind = (proposals.points[:, 0] > 16).mean()
    assert behind > 0.2  # the frustum does hold much of the wall
    located, _ = found(points, [car], [CAR])
    assert overlap(located, car) > 0.7


def test_a_hedge_that_hides_most_of_the_car():
    car, hedge = standing(22, 0.5, 4.0, 1.65, 1.5, 1.2), standing(13, 0.7, 0.5, 2.4, 1.4, 0)
    proposals = propose(scan([car, hedge]), [car], [CAR])
    assert (proposals.points[:, 0] < 14).mean() > 0.5  # more points on the hedge than on the rest
    assert overlap(proposals.lidar_from_frustum(localize(proposals)[0]), car) > 0.7


def test_a_wall_right_behind_a_pedestrian():
    parts, box = person(14, 1)
    located, _ = found(scan([*parts, standing(15.5, 0, 0.3, 20, 3, 0)]), [box], [PEDESTRIAN])
    assert overlap(located, box) > 0.4


@pytest.mark.parametrize("slope", [-0.05, 0.08])
def test_on_a_slope(slope):
    car = standing(25, 2, 4.0, 1.65, 1.5, 1.0, slope=slope)
    located, _ = found(scan([car], slope=slope), [car], [CAR])
    assert iou_3d(located, car[None])[0, 0] > 0.6


def test_few_points_still_give_a_box():
    car = standing(30, 0, 3.9, 1.6, 1.5, np.pi / 2)
    points = scan([car], keep=0.06, seed=3)
    proposals = propose(points, [car], [CAR])
    assert 10 <= len(proposals.points) < 25
    located, _ = found(points, [car], [CAR])
    assert overlap(located, car) > 0.4


def test_no_proposals():
    boxes, quality = localize(propose(np.zeros((0, 4), np.float32), [standing(10, 0, 4, 2, 1.5, 0)], [CAR]))
    assert boxes.shape == (0, 7)
    assert quality.shape == (0,)


def test_bare_ground_gives_no_box():
    proposals = propose(scan([]), [standing(15, 0, 4, 1.7, 1.5, 0)], [CAR])
    assert len(proposals) == 1
    boxes, quality = localize(proposals)
    assert np.isnan(boxes).all()
    assert quality[0] == 0


def test_a_wall_is_no_pedestrian():
    # nothing stands where the 2D box says, only a wall far behind
    someone = standing(10, 0, 0.8, 0.7, 1.75, 0)
    proposals = propose(scan([standing(30, 0, 0.5, 60, 6, 0)]), [someone], [PEDESTRIAN])
    boxes, quality = localize(proposals)
    assert np.isnan(boxes).all()
    assert quality[0] == 0


def test_quality_tells_a_car_from_a_bush():
    car, bush = standing(15, 0, 4.0, 1.65, 1.5, 0.5), standing(18, 0, 1.2, 1.2, 1.8, 0.3)
    _, good = found(scan([car]), [car], [CAR])
    _, poor = found(scan([bush]), [car], [CAR])
    assert good[0] > 0.8
    assert poor[0] < 0.5


def test_a_cloud_of_the_object_alone():
    # no ground in sight: the lowest point stands on it
    car = standing(15, 0, 4.0, 1.65, 1.5, 0.7)
    points = scan([car])
    on_car = (np.abs(points[:, 0] - 15) < 3) & (points[:, 2] > -1.6)
    located, _ = found(points[on_car], [car], [CAR])
    assert iou_3d(located, car[None])[0, 0] > 0.5


def test_points_that_are_not_numbers_change_nothing():
    car = standing(15, 1, 4.0, 1.65, 1.5, 0.7)
    points = scan([car])
    holes = points[:300].copy()
    holes[:100, 0], holes[100:200, 2], holes[200:, :3] = np.nan, np.nan, np.inf
    expected, _ = found(points, [car], [CAR])
    located, _ = found(np.vstack([points, holes]), [car], [CAR])
    np.testing.assert_array_equal(located, expected)
    proposals = propose(points, [car], [CAR])
    spoilt = np.full((5, 4), np.nan, np.float32)
    proposals = replace(
        proposals,
        points=np.vstack([proposals.points, spoilt]),
        gaussian=np.append(proposals.gaussian, np.ones(5, np.float32)),
        offsets=np.array([0, len(proposals.points) + 5]),
    )
    np.testing.assert_array_equal(proposals.lidar_from_frustum(localize(proposals)[0]), expected)


def test_unknown_class_takes_its_size_from_the_2d_box():
    box = standing(14, 1, 2.0, 1.8, 2.4, 0.3)
    located, _ = found(scan([box]), [box], [0], class_names=("Excavator",))
    projected, _ = project_boxes(located, camera())
    assert image_iou(projected, project_boxes(box[None], camera())[0])[0, 0] > 0.7
    assert np.linalg.norm(located[0, :3] - box[:3]) < 0.7
    assert located[0, 5] == pytest.approx(2.4, abs=0.4)


def test_shapes_can_be_given():
    box = standing(14, 1, 2.0, 1.8, 2.4, 0.3)
    shape = ObjectShape(2.0, 1.8, 2.4, 0.1, 0.1, 0.1)
    located, _ = found(scan([box]), [box], [0], GeometricLocalizer({"Excavator": shape}), class_names=("Excavator",))
    assert overlap(located, box) > 0.85


def test_the_mask_decides_between_two_persons():
    (near_parts, near), (far_parts, far) = person(12, 0.3), person(13.2, -0.45)
    both = np.array([near, far])
    points = scan([*near_parts, *far_parts])
    view = camera()
    boxes2d, _ = project_boxes(both, view)
    wide = np.array([[*np.minimum(boxes2d[0, :2], boxes2d[1, :2]), *np.maximum(boxes2d[0, 2:], boxes2d[1, 2:])]])
    for k in range(2):
        image = np.zeros((375, 1240), bool)
        x1, y1, x2, y2 = boxes2d[k].astype(int)
        image[y1:y2, x1:x2] = True
        image[:, int(boxes2d[1 - k, 0]) : int(boxes2d[1 - k, 2])] = False
        seen = Detections2D(wide, [0.9], [PEDESTRIAN], KITTI_CLASSES, (InstanceMask.from_image(image),))
        proposals = extract_frustums(points, [view], [seen], [np.array([0])], mask_mode="box+mask")
        located = proposals.lidar_from_frustum(localize(proposals)[0])
        distances = np.linalg.norm(both[:, :2] - located[0, :2], axis=1)
        assert distances.argmin() == k


def test_proposals_do_not_influence_one_another_and_runs_repeat():
    car = standing(18, 3, 4.0, 1.65, 1.5, 0.7)
    parts, someone = person(12, -2)
    points = scan([car, *parts])
    proposals = propose(points, [car, someone], [CAR, PEDESTRIAN])
    boxes, quality = localize(proposals)
    again, _ = GeometricLocalizer()(proposals)
    np.testing.assert_array_equal(boxes, again)
    for k, (box, label) in enumerate([(car, CAR), (someone, PEDESTRIAN)]):
        single, single_quality = localize(propose(points, [box], [label]))
        np.testing.assert_array_equal(single[0], boxes[k])
        assert single_quality[0] == quality[k]


@settings(deadline=None, max_examples=15)
@given(st.floats(-3.1, 3.1), st.floats(8, 30), st.floats(0, 3.1))
@example(0.5, 8.0, 0.21801100388364603)  # the worst found: 0.77; of 400 random scenes none is below 0.87
def test_a_turned_scene_turns_the_box(turn, distance, yaw):
    car = standing(distance, 0.1 * distance, 4.0, 1.65, 1.5, yaw)
    points = scan([car])
    located, _ = found(points, [car], [CAR])
    turned_points, turned_boxes = turned_scene(points, [car], turn)
    turned, _ = found(turned_points, turned_boxes, [CAR], view=camera(turn))
    _, expected = turned_scene(points, located, turn)
    # the cells of the ground model do not turn along, so a few of the lowest points may be ground in one scene only
    assert bev_iou(turned, expected)[0, 0] > 0.75
    assert np.abs(turned[0, 2] - expected[0, 2]) < 0.1
    assert -np.pi <= turned[0, 6] < np.pi


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarter_turns_turn_the_box_exactly(quarters):
    car = standing(15.3, 1.2, 4.0, 1.65, 1.5, 0.4)
    points = scan([car])
    located, _ = found(points, [car], [CAR])
    turn = quarters * np.pi / 2
    turned_points, turned_boxes = turned_scene(points, [car], turn)
    turned, _ = found(turned_points, turned_boxes, [CAR], view=camera(turn))
    assert iou_3d(turned, turned_scene(points, located, turn)[1])[0, 0] > 0.98


def test_yaws_are_wrapped():
    boxes = [standing(12, y, 4.0, 1.65, 1.5, yaw) for y, yaw in ((-4, 3.1), (0, 1.6), (4, -2.8))]
    proposals = propose(scan(boxes), boxes, [CAR] * 3)
    located, _ = localize(proposals)
    np.testing.assert_array_equal(located[:, 6], wrap_angle(located[:, 6]))


def test_a_car_cut_by_the_image():
    car = standing(7, 3.8, 4.0, 1.65, 1.5, 0.1)
    projected, _ = project_boxes(car[None], camera())
    assert projected[0, 0] == 0  # it leaves the image on the left
    located, _ = found(scan([car]), [car], [CAR])
    assert overlap(located, car) > 0.5


def test_every_class_of_the_datasets_has_a_shape():
    assert set(KITTI_CLASSES) | set(NUSCENES_CLASSES) <= set(SHAPES)
    # signs hang on poles: they are not recovered
    assert {name for name in ARGOVERSE_CLASSES if name not in SHAPES} == {
        "SIGN",
        "STOP_SIGN",
        "MOBILE_PEDESTRIAN_CROSSING_SIGN",
    }


def test_a_shape_without_extent_is_refused():
    with pytest.raises(ConfigError, match="width must be a positive number, got 0"):
        ObjectShape(1.0, 0.0, 1.0, 0.1, 0.1, 0.1)
    with pytest.raises(ConfigError, match="height_deviation"):
        ObjectShape(1.0, 1.0, 1.0, 0.1, 0.1, float("nan"))


@pytest.mark.real
def test_on_real_scans(shared):
    """Frustums of the labels' 2D boxes of the sixteen training frames that have all sensors."""
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.formats.kitti import detections_2d, detections_3d, read_objects

    dataset = KittiDataset(shared / "data/kitti", "sensor_train")
    overlaps = {name: [] for name in KITTI_CLASSES}
    for frame in dataset:
        view = frame.camera("left")
        objects = read_objects(shared / f"data/kitti/training/label_2/{frame.id}.txt", results=False)
        labels = detections_3d(objects, view.camera_from_lidar, KITTI_CLASSES)
        seen = detections_2d(objects, KITTI_CLASSES)
        proposals = extract_frustums(frame.points, [view], [seen], [np.arange(len(seen))])
        located = proposals.lidar_from_frustum(localize(proposals)[0])
        for k, d in enumerate(proposals.detection_index):
            name = KITTI_CLASSES[seen.labels[d]]
            overlaps[name].append(0 if np.isnan(located[k]).any() else overlap(located[k : k + 1], labels.boxes[d]))
    assert np.median(overlaps["Car"]) > 0.75
    assert np.median(overlaps["Pedestrian"]) > 0.5
    assert np.median(overlaps["Cyclist"]) > 0.5

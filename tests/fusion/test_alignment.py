from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lcf3d.distortion import Distortion
from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import (
    DISPLACEMENT,
    TIME,
    Alignment,
    BoxPairs,
    fit_alignment,
    realigned,
    rotation_of,
    vector_of,
)
from lcf3d.fusion.alignment_matching import Sighting, vote_rotation
from lcf3d.fusion.alignment_watch import AlignmentWatch, WatchSettings, estimate, judge
from lcf3d.geometry.camera import project_boxes, project_points
from lcf3d.structures import Camera, Detections2D
from tests.fusion.scenes import CAR, PEDESTRIAN, camera, car, lidar, pedestrian

NAMES = ("Car", "Pedestrian", "Cyclist")
angle = st.floats(-0.3, 0.3)


def street(rng, count=8):
    """Cars and people at various places in front of the camera, none of them on top of another."""
    boxes, labels = [], []
    for i in range(count):
        x, y = 8 + 5 * i + rng.uniform(0, 2), rng.uniform(-0.5, 0.5) * (8 + 5 * i)
        person = i % 3 == 2
        boxes.append(pedestrian(x, y) if person else car(x, y, rng.uniform(-3, 3)))
        labels.append(PEDESTRIAN if person else CAR)
    return np.array(boxes), np.array(labels)


def moments(degrees, count=20, noise=0.0, seed=0, move=None):
    """Frames of a camera that is turned by ``degrees`` against its calibration, with its detections."""
    rng = np.random.default_rng(seed)
    nominal = camera()
    real = realigned(nominal, np.deg2rad(degrees))
    for i in range(count):
        boxes, labels = street(rng)
        velocities = np.column_stack([rng.uniform(-10, 10, (len(boxes), 2)), np.zeros(len(boxes))])
        then = boxes.copy()
        if move is not None:
            then[:, :3] += move * velocities
        projected, visible = project_boxes(then, real)
        found = Detections2D(
            projected[visible] + noise * rng.normal(size=(visible.sum(), 4)),
            np.full(visible.sum(), 0.9),
            labels[visible],
            NAMES,
        )
        yield Frame(str(i), cameras=[nominal]), lidar(boxes, np.full(len(boxes), 0.8), labels), found, velocities


@given(st.tuples(angle, angle, angle))
def test_rotation_vectors_agree_with_scipy(vector):
    expected = Rotation.from_rotvec(vector).as_matrix()
    assert np.allclose(rotation_of(np.array(vector)), expected, atol=1e-12)
    assert np.allclose(vector_of(expected), vector, atol=1e-9)


def test_a_quarter_turn_to_the_right_moves_what_was_ahead_to_the_right_border():
    view = camera()  # 1000 pixels wide, focal length 500: 45 degrees to each border
    turned = realigned(view, np.array([0.0, np.deg2rad(45), 0.0]))
    pixels, _ = project_points(np.array([[10.0, 0.0, 0.0]]), turned)
    assert np.allclose(pixels, [[1000, 200]])


def test_turning_is_about_the_centre_of_the_camera_also_when_the_projection_has_an_offset():
    view = camera()
    shifted = type(view)(
        "left",
        view.projection @ np.array([[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]),
        view.camera_from_lidar,
        view.width,
        view.height,
    )
    vector = np.array([0.01, -0.05, 0.02])
    points = np.array([[10.0, 1.0, -1.0], [40.0, -9.0, 0.5]])
    matrix = shifted.intrinsics
    homogeneous = (
        np.column_stack([points, np.ones(2)])
        @ (matrix @ rotation_of(vector) @ np.linalg.inv(matrix) @ shifted.pixels_from_lidar).T
    )
    pixels, _ = project_points(points, realigned(shifted, vector))
    assert np.allclose(pixels, homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-5, 5)] * 2, st.floats(-2, 2)), st.integers(0, 5))
def test_any_turn_up_to_five_degrees_is_found(degrees, seed):
    sightings = [Sighting.of(f.cameras[0], boxes, found) for f, boxes, found, _ in moments(degrees, 10, seed=seed)]
    found = estimate(sightings, Alignment.nominal())
    assert np.abs(np.rad2deg(found.rotation) - degrees).max() < 0.05
    assert found.pairs > 30


def test_the_uncertainty_covers_the_error_and_falls_with_the_number_of_frames():
    deviations, errors = [], []
    for count in (5, 40):
        sightings = [
            Sighting.of(f.cameras[0], b, d, group=i)
            for i, (f, b, d, _) in enumerate(moments([0.3, -0.8, 0.2], count, 2.0))
        ]
        found = estimate(sightings, Alignment.nominal())
        deviations.append(found.deviation[:3])
        errors.append(np.abs(found.rotation - np.deg2rad([0.3, -0.8, 0.2])))
    assert (np.array(errors) < 3 * np.array(deviations)).all()
    assert (deviations[1] < deviations[0]).all()


def test_one_pair_ahead_tells_pitch_and_yaw_but_no_roll():
    view = camera()
    box = np.array([car(20.0)])
    pairs = BoxPairs.of(box, project_boxes(box, view)[0], view)
    found = fit_alignment(pairs, Alignment.nominal())
    pitch, yaw, roll = np.rad2deg(found.deviation[:3])
    assert max(pitch, yaw) < 0.5
    assert roll > 3


def test_outliers_do_not_move_the_estimate():
    view, rng = camera(), np.random.default_rng(3)
    boxes = np.array([car(10 + 4 * i, (-1) ** i * 3.0) for i in range(10)])
    edges, _ = project_boxes(boxes, realigned(view, np.array([0.0, 0.01, 0.0])))
    edges[:3] += rng.uniform(30, 60, (3, 4))
    found = fit_alignment(BoxPairs.of(boxes, edges, view), Alignment.nominal())
    assert np.allclose(np.rad2deg(found.rotation), np.rad2deg([0, 0.01, 0]), atol=0.05)


def test_an_edge_at_the_border_of_the_image_is_not_used():
    view = camera()
    box = np.array([car(8.0, 7.0)])
    edges, _ = project_boxes(box, view)
    pairs = BoxPairs.of(box, edges, view)
    assert edges[0, 0] == 0
    assert pairs.free[0].tolist() == [False, True, True, True]


def test_a_time_offset_is_told_from_a_rotation_by_objects_that_move_differently():
    sightings = [
        Sighting.of(f.cameras[0], boxes, found, v) for f, boxes, found, v in moments([0.0, 0.5, 0.0], 20, move=0.12)
    ]
    found = estimate(sightings, Alignment.nominal(), time=True)
    assert found.time_offset == pytest.approx(0.12, abs=0.005)
    assert np.rad2deg(found.rotation[1]) == pytest.approx(0.5, abs=0.05)
    without = estimate(sightings, Alignment.nominal())
    assert abs(without.state[TIME]) < 1e-6


def test_noise_in_velocities_and_boxes_does_not_make_a_time_offset_smaller():
    rng, view, late = np.random.default_rng(3), camera(), 0.2
    boxes = np.array([car(x, rng.uniform(-0.4, 0.4) * x) for x in rng.uniform(10, 45, 1500)])
    true = np.column_stack([np.zeros(len(boxes)), rng.choice([-2.0, 2.0], len(boxes)), np.zeros(len(boxes))])
    then = boxes.copy()
    then[:, :3] += late * true
    edges, _ = project_boxes(then, view)
    believed = true + rng.normal(0, 0.5, true.shape) * [1, 1, 0]
    seen = boxes + np.column_stack([rng.normal(0, 0.1, (len(boxes), 3)), np.zeros((len(boxes), 4))])
    sure = fit_alignment(BoxPairs.of(seen, edges, view, believed), Alignment.nominal(), time=True)
    # least squares that takes the velocities as exact: smaller by 0.25 / (4 + 0.25)
    assert sure.time_offset < 0.193
    known = BoxPairs.of(seen, edges, view, believed, unsure=np.full(len(boxes), 0.5))
    assert fit_alignment(known, Alignment.nominal(), time=True).time_offset == pytest.approx(late, abs=0.004)


def test_what_moves_is_seen_where_it_is_at_the_cameras_moment():
    view = replace(camera(), delay=0.1)
    boxes = np.array([car(12.0), car(25.0, 4.0)])
    found = Detections2D(project_boxes(boxes, view)[0], np.full(2, 0.9), np.zeros(2, int), NAMES)
    detections = replace(lidar(boxes, [0.9, 0.8]), velocities=np.array([[10.0, 5.0], [np.nan, np.nan]]))
    sighting = Sighting.of(view, detections, found)
    np.testing.assert_allclose(sighting.boxes[:, :2], boxes[:, :2] + [[1.0, 0.5], [0, 0]])


def test_what_stands_is_sure_to_and_what_moves_is_not():
    view = camera()
    boxes = np.array([car(12.0), car(25.0, 4.0)])
    found = Detections2D(project_boxes(boxes, view)[0], np.full(2, 0.9), np.zeros(2, int), NAMES)
    detections = replace(lidar(boxes, [0.9, 0.8]), velocities=np.array([[1.0, 0.5], [3.0, 0.0]]))
    sighting = Sighting.of(view, detections, found, np.zeros((2, 3)))
    assert sighting.unsure.tolist() == [0.0, 0.5]


def test_an_estimate_that_needs_impossible_boxes_raises_no_alarm():
    state = np.zeros(9)
    state[1] = np.deg2rad(5.0)
    sure = Alignment(state, np.diag(np.full(9, 1e-8)), 40)
    assert judge(sure, WatchSettings()) == "wrong"
    state = state.copy()
    state[6] = 0.25
    assert judge(replace(sure, state=state), WatchSettings()) == "unknown"


def test_displacement_is_held_near_zero_unless_many_pairs_ask_for_it():
    view = camera()
    moved = realigned(view, np.zeros(3), np.array([0.05, 0.0, 0.0]))
    boxes = np.array([car(5.0 + 1.5 * i, (-1) ** i * (1 + i / 4)) for i in range(40)])
    edges, _ = project_boxes(boxes, moved)
    one = fit_alignment(BoxPairs.of(boxes[:1], edges[:1], view), Alignment.nominal())
    many = fit_alignment(BoxPairs.of(boxes, edges, view), Alignment.nominal())
    assert abs(one.state[DISPLACEMENT][0]) < 0.02
    assert many.state[DISPLACEMENT][0] == pytest.approx(0.05, abs=0.02)
    fixed = fit_alignment(BoxPairs.of(boxes, edges, view), Alignment.nominal(), displacement=False)
    assert np.abs(fixed.state[DISPLACEMENT]).max() < 1e-4


def test_votes_find_the_turn_where_no_box_overlaps_its_detection():
    degrees = [0.0, 5.0, 0.0]
    sightings = [Sighting.of(f.cameras[0], boxes, found) for f, boxes, found, _ in moments(degrees, 10)]
    assert np.abs(np.rad2deg(vote_rotation(sightings)) - degrees).max() < 0.4
    assert vote_rotation([]).tolist() == [0, 0, 0]


def watch_over(degrees, count, **changes):
    watch = AlignmentWatch(NAMES, WatchSettings(**changes))
    for frame, boxes, found, _ in moments(degrees, count, noise=1.0):
        watch.observe(frame, boxes, {"left": found})
    return watch


def test_the_watch_says_ok_drifting_or_wrong():
    assert watch_over([0, 0, 0], 20).report("left").status == "ok"
    assert watch_over([0, 0.6, 0], 20).report("left").status == "drifting"
    assert watch_over([0, 0, 2.5], 20).report("left").status == "wrong"


def test_too_few_pairs_are_no_verdict_and_correct_nothing():
    watch = AlignmentWatch(NAMES)
    assert watch.report("left").status == "unknown"
    view = camera()
    assert watch.corrected(view) is view
    for i in range(10):
        watch.observe(Frame(str(i), cameras=[view]), lidar([], []), {"left": Detections2D.empty(NAMES)})
    assert watch.report("left").status == "unknown"
    assert watch.corrected(view) is view


def test_a_knock_is_noticed_within_twenty_frames_and_corrected():
    watch = watch_over([0, 0, 0], 60)
    for frame, boxes, found, _ in moments([0, 0.5, 0], 20, noise=1.0, seed=9):
        watch.observe(frame, boxes, {"left": found})
        if watch.report("left").status == "drifting":
            break
    assert watch.report("left").status == "drifting"
    corrected = watch.corrected(camera())
    real = realigned(camera(), np.deg2rad([0, 0.5, 0]))
    point = np.array([[30.0, 2.0, 0.0]])
    assert np.abs(project_points(point, corrected)[0] - project_points(point, real)[0]).max() < 2


def test_cameras_are_judged_apart_and_corrected_frames_keep_their_scan():
    left, right = camera("left"), camera("right", yaw=-0.3)
    real = realigned(right, np.deg2rad([0, 1.0, 0]))
    watch, rng = AlignmentWatch(NAMES), np.random.default_rng(1)
    points = np.zeros((3, 4), np.float32)
    for i in range(20):
        boxes, labels = street(rng, 12)
        camera_found = {}
        for name, view in (("left", left), ("right", real)):
            projected, visible = project_boxes(boxes, view)
            camera_found[name] = Detections2D(projected[visible], np.full(visible.sum(), 0.9), labels[visible], NAMES)
        frame = Frame(str(i), points, [left, right])
        watch.observe(frame, lidar(boxes, np.full(len(boxes), 0.8), labels), camera_found)
    assert watch.cameras == ("left", "right")
    assert watch.report("left").status == "ok"
    assert watch.report("right").status in ("drifting", "wrong")
    assert watch.report("right").to_json()["yaw"]["deg"] == pytest.approx(1.0, abs=0.1)
    corrected = watch.corrected_frame(frame)
    assert corrected.points is points
    assert np.allclose(corrected.camera("right").camera_from_lidar, real.camera_from_lidar, atol=0.02)


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ConfigError, match="window"):
        WatchSettings(window=0)
    with pytest.raises(ConfigError, match="drifting"):
        WatchSettings(drifting_deg=2.0)


def test_boxes_that_are_not_finite_take_no_part():
    frame, boxes, found, _ = next(moments([0, 0, 0], 1))
    bad = lidar(np.where(np.arange(8)[:, None] == 2, np.nan, boxes.boxes), boxes.scores, boxes.labels)
    assert (
        len(Sighting.of(frame.cameras[0], bad, found).boxes)
        == len(Sighting.of(frame.cameras[0], boxes, found).boxes) - 1
    )


def test_a_camera_with_a_wide_lens_is_found_too():
    fisheye = Camera(
        "left",
        camera(focal=300.0).projection,
        camera().camera_from_lidar,
        1000,
        400,
        distortion=Distortion("fisheye", (0.02, -0.004, 0.0, 0.0)),
    )
    degrees, rng, sightings = [0.5, -1.5, 0.3], np.random.default_rng(4), []
    for _ in range(20):
        boxes, labels = street(rng)
        projected, visible = project_boxes(boxes, realigned(fisheye, np.deg2rad(degrees)))
        found = Detections2D(projected[visible], np.full(visible.sum(), 0.9), labels[visible], NAMES)
        sightings.append(Sighting.of(fisheye, lidar(boxes, np.full(len(boxes), 0.8), labels), found))
    found = estimate(sightings, Alignment.nominal())
    assert np.abs(np.rad2deg(found.rotation) - degrees).max() < 0.05

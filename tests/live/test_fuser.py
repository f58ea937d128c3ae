import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import realigned
from lcf3d.fusion.alignment_watch import WatchSettings
from lcf3d.live.messages import CameraBoxes, CameraModel, EgoPose, Image, LidarBoxes, Scan
from lcf3d.live.synchronizer import SyncSettings
from tests.fusion.scenes import camera
from tests.live.streams import boxes2d, boxes3d, fingerprint, fuser, fusion, pose, run, stream, street


def entry(target, name):
    return next(e for e in target.diagnostics() if e["hardware_id"] == name)


def value(target, name, key):
    return next(v["value"] for v in entry(target, name)["values"] if v["key"] == key)


def test_a_stream_gives_the_boxes_that_files_would_give():
    view, offline = camera(), fusion()
    results = run(fuser(), stream(10))
    assert len(results) == 10
    for i, result in enumerate(results):
        frame = Frame(str(i), cameras=[view])
        expected = offline(frame, boxes3d(street(i)), {"left": boxes2d(view, street(i))})
        assert np.array_equal(result.fused.detections.boxes, expected.detections.boxes)
        assert np.array_equal(result.fused.detections.scores, expected.detections.scores)
        assert set(result.latency_ms) == {"wait", "fusion", "added"}


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_any_order_of_arrival_inside_the_tolerance_gives_the_same_bytes(seed):
    views = [camera("left"), camera("right", yaw=-0.2)]
    messages = list(stream(8, views)) + [pose(0.05 * i, 0.4 * i) for i in range(18)]
    messages.sort(key=lambda m: m.time)
    expected = fingerprint(run(fuser(views), messages))
    jitter = np.random.default_rng(seed).uniform(0, 0.04, len(messages))
    shuffled = [messages[i] for i in np.argsort([m.time + j for m, j in zip(messages, jitter, strict=True)])]
    assert fingerprint(run(fuser(views, poses=True), shuffled)) == fingerprint(run(fuser(views, poses=True), messages))
    assert len(expected) > 0


def test_a_camera_that_is_late_is_left_out_and_said():
    messages = [m for m in stream(5) if not (isinstance(m, CameraBoxes) and 0.15 < m.time < 0.25)]
    target = fuser()
    results = run(target, messages)
    assert [len(r.fused.camera_names) for r in results] == [1, 1, 0, 1, 1]
    assert "camera left" in results[2].fused.notes[0]
    assert value(target, "camera left", "absent") == "1"


def test_an_offset_says_when_a_camera_looks():
    messages = list(stream(5, delay=0.05))
    assert all(not r.fused.camera_names for r in run(fuser(), messages))
    assert all(r.fused.camera_names == ("left",) for r in run(fuser(offsets={"left": 0.05}), messages))


def test_boxes_are_moved_to_the_moment_of_each_camera():
    view = camera()
    # the car drives 20 m/s towards a standing box: 0.03 s later it is 0.6 m nearer
    there, nearer = street(0, 1), street(0, 1) - [0.6, 0, 0, 0, 0, 0, 0]
    target = fuser(poses=True)
    messages = [
        pose(0.0, 0.0),
        pose(0.1, 2.0),
        LidarBoxes(0.0, boxes3d(there)),
        CameraBoxes(0.03, "left", boxes2d(view, nearer)),
    ]
    (result,) = run(target, messages)
    assert result.fused.lidar.iou[0] == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(result.fused.detections.boxes, there)
    # nothing moves but the box itself, at 20 m/s towards us
    target = fuser()
    messages = [LidarBoxes(0.0, boxes3d(there, [[-20.0, 0.0]])), CameraBoxes(0.03, "left", boxes2d(view, nearer))]
    (result,) = run(target, messages)
    assert result.fused.lidar.iou[0] == pytest.approx(1.0, abs=1e-6)


def test_without_a_pose_for_the_moment_the_result_says_so():
    target = fuser(poses=True)
    (result,) = run(target, [EgoPose(0.0, np.eye(4)), *stream(1)])
    assert any("no ego pose" in note for note in result.fused.notes)


def test_clocks_minutes_apart_are_said_once_with_the_number_and_the_lidar_goes_on():
    view = camera()
    messages = []
    for i in range(5):
        messages += [
            LidarBoxes(0.1 * i, boxes3d(street(i))),
            CameraBoxes(0.1 * i + 180, "left", boxes2d(view, street(i))),
        ]
    target = fuser()
    results = run(target, messages)
    assert len(results) == 5
    assert all(not r.fused.camera_names for r in results)
    assert entry(target, "camera left")["level"] == 2
    assert entry(target, "camera left")["message"].count("+180.0 s") == 1


def test_time_that_goes_back_begins_anew():
    target = fuser()
    results = run(target, [*stream(4, start=100.0), *stream(4, start=0.0)])
    assert len(results) >= 7
    assert value(target, "fusion", "restarts") == "1"
    assert results[-1].fused.camera_names == ("left",)


def test_broken_times_and_poses_are_counted_and_nothing_stops():
    target = fuser()
    bad = [LidarBoxes(np.nan, boxes3d(street(0))), EgoPose(0.05, np.full((4, 4), np.nan)), EgoPose(0.06, np.eye(3))]
    results = run(target, [*list(stream(2)), *bad, *stream(2, start=0.2)])
    assert len(results) == 4
    assert value(target, "lidar", "dropped") == "1"


def test_after_time_went_back_poses_and_calibrations_are_those_of_the_new_time():
    view = camera()
    target = fuser([], poses=True)
    wrong = realigned(view, np.array([0.0, 0.3, 0.0]))
    target.push(CameraModel(90.0, wrong))
    target.push(CameraModel(99.0, view))
    old = [pose(100 + 0.05 * i, 0.0) for i in range(12)]
    run(target, sorted([*stream(4, start=100.0), *old], key=lambda m: m.time))
    # 20 m/s towards a standing box, from time 0 on
    there, nearer = street(0, 1), street(0, 1) - [0.6, 0, 0, 0, 0, 0, 0]
    target.push(LidarBoxes(0.0, boxes3d(there)))
    new = [pose(0.0, 0.0), pose(0.1, 2.0), CameraBoxes(0.03, "left", boxes2d(view, nearer))]
    results = run(target, new)
    assert results[-1].time == 0.0
    assert results[-1].fused.lidar.iou[0] == pytest.approx(1.0, abs=1e-6)


def test_a_clock_that_is_set_right_is_no_problem_any_more():
    view = camera()
    target = fuser()
    run(target, [LidarBoxes(0.0, boxes3d(street(0))), CameraBoxes(180.0, "left", boxes2d(view, street(0)))])
    assert "clock" in entry(target, "camera left")["message"]
    results = run(target, stream(3, start=0.1))
    assert results[-1].fused.camera_names == ("left",)
    assert "clock" not in entry(target, "camera left")["message"]


def test_messages_that_were_cut_off_are_counted_and_the_rest_goes_on():
    target = fuser(scans=True)
    bad = [
        Scan(0.0, np.zeros(7, np.float32)),
        Scan(0.0, np.zeros((5, 2), np.float32)),
        Image(0.0, "left", np.zeros((4, 4), np.uint8)),
        LidarBoxes(0.0, None),
        CameraBoxes(0.0, "left", None),
    ]
    scans = [Scan(0.1 * i, np.zeros((5, 4), np.float32)) for i in range(3)]
    results = run(target, [*bad, *sorted([*stream(3), *scans], key=lambda m: m.time)])
    assert len(results) == 3
    assert all(r.fused.camera_names == ("left",) for r in results)
    assert target.dropped() == {"camera left: broken": 2, "lidar: broken": 1, "scan: broken": 2}


def test_a_callback_that_raises_stops_nothing():
    def broken(result):
        raise RuntimeError("no network")

    target = fuser(on_result=broken)
    assert len(run(target, stream(3))) == 3
    assert entry(target, "fusion")["level"] == 2
    assert "no network" in value(target, "fusion", "last_error")


@pytest.mark.parametrize("gives", [None, [1, 2, 3]])
def test_a_detector_that_gives_something_else_is_reported(gives):
    target = fuser(detectors={"left": lambda images: [gives]}, lidar_detector=lambda points: gives)
    pixels, points = np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4), np.float32)
    assert run(target, [Scan(0.0, points), Image(0.0, "left", pixels)]) == []
    assert "must give Detections2D" in entry(target, "camera left")["message"]
    assert "must give Detections3D" in entry(target, "lidar")["message"]


def test_messages_of_a_camera_without_lidar_do_not_pile_up():
    view = camera()
    target = fuser()
    run(target, [CameraBoxes(0.05 * i, "left", boxes2d(view, street(0))) for i in range(100)])
    assert target.dropped() == {"camera left: overflow": 100 - 64}


def test_a_calibration_may_come_late_and_change():
    view, turned = camera(), realigned(camera(), np.array([0.0, 0.1, 0.0]))
    messages = []
    for i in range(6):
        seen = turned if i >= 4 else view
        messages += [LidarBoxes(0.1 * i, boxes3d(street(i))), CameraBoxes(0.1 * i, "left", boxes2d(seen, street(i)))]
    messages.insert(4, CameraModel(0.15, view))
    messages.insert(9, CameraModel(0.35, turned))
    target = fuser([])
    results = run(target, messages)
    assert [len(r.fused.camera_names) for r in results] == [0, 0, 1, 1, 1, 1]
    assert all(np.nanmin(r.fused.lidar.iou) > 0.99 for r in results[2:])
    notes = value(target, "fusion", "notes")
    assert "no calibration yet" in notes
    assert "new calibration at 0.350 s" in notes


def test_detectors_run_on_scans_and_images_in_order():
    view = camera()
    pixels = np.zeros((400, 1000, 3), np.uint8)
    points = np.zeros((5, 4), np.float32)
    target = fuser(
        detectors={"left": lambda images: [boxes2d(view, street(0)) for _ in images]},
        lidar_detector=lambda cloud: boxes3d(street(0)),
    )
    messages = [m for i in range(3) for m in (Scan(0.1 * i, points), Image(0.1 * i + 0.01, "left", pixels))]
    results = run(target, messages)
    assert len(results) == 3
    assert all(r.fused.camera_names == ("left",) for r in results)
    assert {"detect scan", "detect camera left"} <= set(results[0].latency_ms)
    assert results[0].frame.images["left"] is pixels


def test_images_without_a_detector_are_told_and_pixels_beside_boxes_are_shown():
    view, pixels = camera(), np.zeros((400, 1000, 3), np.uint8)
    target = fuser()
    boxes = boxes2d(view, street(0))
    messages = [
        LidarBoxes(0.0, boxes3d(street(0))),
        Image(0.0, "left", pixels),
        CameraBoxes(0.01, "left", boxes, pixels),
    ]
    (result,) = run(target, messages)
    assert result.frame.images["left"] is pixels
    assert result.fused.camera_names == ("left",)
    assert "there is no detector" in value(target, "fusion", "notes")


def test_a_detector_that_raises_is_reported_and_the_rest_goes_on():
    def broken(images):
        raise RuntimeError("no memory")

    target = fuser(detectors={"left": broken})
    pixels = np.zeros((4, 4, 3), np.uint8)
    messages = [m for i in range(4) for m in (LidarBoxes(0.1 * i, boxes3d(street(i))), Image(0.1 * i, "left", pixels))]
    results = run(target, messages)
    assert len(results) == 4
    message = entry(target, "camera left")["message"]
    assert "failed 4 times in the latest 30 s, last RuntimeError: no memory" in message


def test_a_detector_that_hangs_costs_the_deadline_and_drops_what_waited():
    release, pixels = threading.Event(), np.zeros((4, 4, 3), np.uint8)

    def hanging(images):
        release.wait(20)
        return [boxes2d(camera(), street(0))]

    target = fuser(realtime=True, detectors={"left": hanging}, deadline=0.1)
    results = []
    for i in range(6):
        results += target.push(LidarBoxes(0.1 * i, boxes3d(street(i))))
        results += target.push(Image(0.1 * i, "left", pixels))
    import time

    time.sleep(0.12)
    results += target.poll()
    assert len(results) == 6
    assert all(not r.fused.camera_names for r in results)
    message = entry(target, "camera left")["message"]
    assert "has not answered" in message
    assert "dropped (busy)" in message
    release.set()
    target.close()


def test_results_of_threads_come_through_the_callback():
    view, came = camera(), []
    target = fuser(
        realtime=True,
        on_result=came.append,
        detectors={"left": lambda images: [boxes2d(view, street(0))]},
        deadline=5.0,
    )
    target.push(LidarBoxes(0.0, boxes3d(street(0))))
    target.push(Image(0.0, "left", np.zeros((4, 4, 3), np.uint8)))
    target.flush()
    assert [r.fused.camera_names for r in came] == [("left",)]
    target.close()


def test_an_overflow_of_groups_is_counted():
    target = fuser(deadline=100.0, most_pending=3)
    results = run(target, [LidarBoxes(0.1 * i, boxes3d(street(i))) for i in range(10)])
    assert len(results) == 3
    assert "7 messages dropped (overflow)" in entry(target, "lidar")["message"]


def test_scores_that_are_no_probabilities_stop_no_stream():
    target = fuser()
    bad = boxes3d(street(0))
    object.__setattr__(bad, "scores", np.array([3.0, 2.0, 1.0, 0.5]))
    results = run(target, [LidarBoxes(0.0, bad), *stream(2, start=0.1)])
    assert len(results) == 2
    assert "could not be fused" in entry(target, "fusion")["message"]


def test_the_watch_corrects_a_turned_camera():
    view = camera()
    real = realigned(view, np.deg2rad([0, 2.0, 0]))
    rng = np.random.default_rng(0)
    messages = []
    for i in range(30):
        boxes = street(i, 6) + np.column_stack([rng.uniform(-2, 2, (6, 2)), np.zeros((6, 5))])
        messages += [LidarBoxes(0.1 * i, boxes3d(boxes)), CameraBoxes(0.1 * i, "left", boxes2d(real, boxes))]
    target = fuser(watch=WatchSettings(), correct=True)
    results = run(target, messages)
    assert np.nanmean(results[-1].fused.lidar.iou) > 0.95
    assert np.nanmean(results[0].fused.lidar.iou) < 0.8
    assert "turned by 2.0" in entry(target, "camera left")["message"]
    assert entry(target, "camera left")["level"] == 2


def test_in_real_time_the_watch_has_a_thread_of_its_own():
    target = fuser(realtime=True, watch=WatchSettings(every=1))
    messages = list(stream(8))
    for message in messages:
        target.push(message)
    target.flush()
    target.close()
    assert target.watch.report("left").frames >= 1
    assert target.watch.estimate("left").pairs > 0


def test_warm_up_runs_everything_without_a_result():
    calls = []
    target = fuser(detectors={"left": lambda images: calls.append(images) or [boxes2d(camera(), street(0))]})
    target.warm_up()
    assert calls[0][0].shape == (400, 1000, 3)
    assert target.flush() == []


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ConfigError, match="deadline"):
        SyncSettings(tolerance=0.1, deadline=0.1)
    with pytest.raises(ConfigError, match="above 0"):
        SyncSettings(tolerance=0.0)
    with pytest.raises(ConfigError, match="no camera"):
        fuser(offsets={"rear": 0.01})


def test_the_watch_waits_while_a_message_is_taken_in():
    target = fuser(realtime=True, watch=WatchSettings(every=1))
    with target._lock:
        for message in stream(3):
            target.push(message)
        assert not target._workers["watch"].wait_idle(0.2)
    assert target._workers["watch"].wait_idle(20)
    assert target.watch.report("left").frames >= 1
    target.close()


def test_what_is_no_message_is_refused_and_what_has_no_time_or_no_data_is_counted():
    target = fuser()
    with pytest.raises(ConfigError, match="not str"):
        target.push("hello")
    bad = [
        LidarBoxes(None, boxes3d(street(0))),
        CameraBoxes("soon", "left", boxes2d(camera(), street(0))),
        CameraModel(np.nan, camera()),
        CameraModel(0.0, None),
        Scan(0.0, None),
        Scan(0.0, np.full((3, 4), None)),
        EgoPose(0.0, np.zeros((4, 4))),
        EgoPose(0.0, np.diag([1.0, 1.0, -1.0, 1.0])),
    ]
    results = run(target, [*bad, *stream(3)])
    assert len(results) == 3
    assert all(r.fused.camera_names == ("left",) for r in results)
    assert target.dropped() == {
        "calibration left: broken": 1,
        "calibration: broken": 1,
        "camera left: broken": 1,
        "lidar: broken": 1,
        "pose: broken": 2,
        "scan: broken": 2,
    }


def test_a_camera_that_sends_without_a_calibration_has_an_entry_of_its_own():
    target, view = fuser(), camera("roof")
    results = run(target, [*stream(3), CameraBoxes(0.21, "roof", boxes2d(view, street(0)))])
    assert len(results) == 3
    status = entry(target, "camera roof")
    assert (status["level"], status["message"]) == (2, "has no calibration: nothing of it is used")
    target.push(CameraModel(0.0, view))
    assert entry(target, "camera roof")["level"] == 0


def test_whatever_goes_wrong_in_a_moment_the_next_one_is_fused(monkeypatch):
    target = fuser()
    inner = target._frame
    monkeypatch.setattr(target, "_frame", lambda group: 1 / 0 if 0.15 < group.time < 0.25 else inner(group))
    results = run(target, stream(5))
    assert [round(r.time, 1) for r in results] == [0.0, 0.1, 0.3, 0.4]
    assert "1 frames could not be fused" in entry(target, "fusion")["message"]
    assert "ZeroDivisionError" in value(target, "fusion", "last_error")


def test_images_of_another_size_than_the_calibration_is_for_are_told_once():
    target = fuser(detectors={"left": lambda images: [boxes2d(camera(), street(0))]})
    for i in range(3):
        target.push(Image(0.1 * i, "left", np.zeros((200, 500, 3), np.uint8)))
    notes = value(target, "fusion", "notes")
    assert notes.count("images of 500 x 200 pixels, but its calibration is for 1000 x 400") == 1


def test_a_scan_detector_that_hangs_costs_its_moments_and_is_told():
    release, points = threading.Event(), np.zeros((5, 4), np.float32)

    def hanging(cloud):
        release.wait(20)
        return boxes3d(street(0))

    target, view = fuser(realtime=True, lidar_detector=hanging, deadline=0.1), camera()
    for i in range(5):
        target.push(Scan(0.1 * i, points))
        target.push(CameraBoxes(0.1 * i, "left", boxes2d(view, street(i))))
    import time

    time.sleep(0.12)
    assert target.poll() == []
    assert "has not answered" in entry(target, "lidar")["message"]
    release.set()
    target._workers["scan"].wait_idle(20)
    # it answers again: new moments are fused
    results = []
    for i in range(5, 8):
        results += target.push(Scan(0.1 * i, points))
        results += target.push(CameraBoxes(0.1 * i, "left", boxes2d(view, street(i))))
        target._workers["scan"].wait_idle(20)
    assert len(results + target.flush()) >= 2
    target.close()

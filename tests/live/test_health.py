import numpy as np
import pytest

from lcf3d.live.messages import CameraBoxes, Image, LidarBoxes, Scan
from lcf3d.structures import Detections2D
from tests.fusion.scenes import camera
from tests.live.streams import NAMES, boxes2d, boxes3d, fuser, run, stream, street
from tests.live.test_fuser import entry, value


def test_a_healthy_stream_is_ok_with_its_rate():
    target = fuser()
    messages = list(stream(12))
    run(target, messages)
    assert entry(target, "camera left")["level"] == 0
    assert entry(target, "camera left")["message"] == "ok"
    assert value(target, "camera left", "rate_hz") == "10"
    assert float(value(target, "camera left", "confirmed_share")) == 1.0
    assert value(target, "fusion", "frames") == "12"


def test_a_camera_of_which_nothing_comes_is_stale():
    target = fuser([camera("left"), camera("rear", yaw=3.0)])
    run(target, stream(3))
    assert entry(target, "camera rear")["level"] == 3


def test_a_blinded_camera_is_left_out_and_comes_back():
    view, messages = camera(), []
    for i in range(150):
        found = boxes2d(view, street(i % 20))
        if 80 <= i < 110:
            found = Detections2D.empty(NAMES)
        messages += [LidarBoxes(0.1 * i, boxes3d(street(i % 20))), CameraBoxes(0.1 * i, "left", found)]
    target = fuser()
    results = run(target, messages)
    used = np.array([len(r.fused.camera_names) for r in results])
    assert used[:80].all()
    assert not used[100:110].any()
    assert used[130:].all()
    note = next(n for n in results[105].fused.notes if "sees far less" in n)
    assert note.startswith("camera left")
    # while it is believed, its silence lowers the boxes' scores; left out, LiDAR stands alone
    assert results[82].fused.detections.scores[0] < results[105].fused.detections.scores[0]


def test_a_frozen_camera_is_an_error():
    view, target = camera(), fuser()
    same = boxes2d(view, street(0))
    run(
        target,
        [m for i in range(6) for m in (LidarBoxes(0.1 * i, boxes3d(street(i))), CameraBoxes(0.1 * i, "left", same))],
    )
    assert "again and again" in entry(target, "camera left")["message"]
    target = fuser()
    nothing = Detections2D.empty(NAMES)
    run(
        target,
        [m for i in range(6) for m in (LidarBoxes(0.1 * i, boxes3d(street(i))), CameraBoxes(0.1 * i, "left", nothing))],
    )
    assert "again" not in entry(target, "camera left")["message"]


def test_a_missing_sector_of_the_scan_is_named_in_degrees():
    angles = np.deg2rad(np.arange(-180, 180, 0.2) + 0.1)
    whole = np.column_stack([10 * np.cos(angles), 10 * np.sin(angles), 0 * angles, 0 * angles]).astype(np.float32)
    degrees = np.rad2deg(angles)
    cut = whole[(degrees < 20) | (degrees > 50)]
    target = fuser(scans=True)
    messages = []
    for i in range(8):
        points = cut if i == 7 else whole
        boxes = street(i)
        messages += [
            Scan(0.1 * i, points),
            LidarBoxes(0.1 * i, boxes3d(boxes)),
            CameraBoxes(0.1 * i, "left", boxes2d(camera(), boxes)),
        ]
    run(target, messages)
    assert entry(target, "lidar")["message"] == "no points from 20 to 50 degrees"
    assert entry(target, "lidar")["level"] == 1


def test_every_value_is_text_as_ros_wants_it():
    target = fuser()
    run(target, stream(3))
    for status in target.diagnostics():
        assert set(status) == {"name", "level", "message", "hardware_id", "values"}
        assert all(isinstance(v["value"], str) and isinstance(v["key"], str) for v in status["values"])


def test_delays_are_those_beyond_the_quickest_sensor(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("lcf3d.live.fuser.perf_counter", lambda: now[0])
    target, view = fuser(), camera()
    for i in range(20):
        now[0] = 1000 + 0.1 * i + 0.02
        target.push(LidarBoxes(0.1 * i, boxes3d(street(i))))
        # the camera's message comes 50 ms after the LiDAR's of the same time, one in ten 20 ms later still
        now[0] += 0.05 + (0.02 if i % 10 == 9 else 0)
        target.push(CameraBoxes(0.1 * i, "left", boxes2d(view, street(i))))
    assert float(value(target, "lidar", "delay_ms")) == 0
    assert float(value(target, "camera left", "delay_ms")) == pytest.approx(50)
    assert float(value(target, "camera left", "delay_spread_ms")) == pytest.approx(20, abs=1)


def test_a_frozen_image_is_an_error():
    def found(images):
        return [boxes2d(camera(), street(0))]

    rng, level = np.random.default_rng(0), []
    for frozen in (False, True):
        target, pixels = fuser(detectors={"left": found}), rng.integers(0, 255, (400, 1000, 3), dtype=np.uint8)
        for i in range(6):
            shown = pixels if frozen else rng.integers(0, 255, (400, 1000, 3), dtype=np.uint8)
            run(target, [LidarBoxes(0.1 * i, boxes3d(street(i))), Image(0.1 * i, "left", shown)])
        level.append(entry(target, "camera left")["level"])
    assert level == [0, 2]


def cut_off(time):
    return CameraBoxes(time, "left", None)


def test_what_went_wrong_long_ago_raises_no_level_any_more_and_stays_in_the_counts():
    fails = [True]

    def found(images):
        if fails[0]:
            raise RuntimeError("no memory")
        return [boxes2d(camera(), street(0))]

    rng = np.random.default_rng(0)
    target = fuser(detectors={"left": found})

    def drive(first, last):
        for i in range(first, last):
            pixels = rng.integers(0, 255, (400, 1000, 3), dtype=np.uint8)
            run(target, [LidarBoxes(0.1 * i, boxes3d(street(i % 20))), Image(0.1 * i, "left", pixels)])

    drive(0, 3)
    target.push(cut_off(0.25))
    # a camera that lags: its moment is closed already
    target.push(Image(0.05, "left", np.zeros((4, 4, 3), np.uint8)))
    fails[0] = False
    drive(3, 20)
    first = entry(target, "camera left")
    assert first["level"] == 2
    assert "failed 4 times" in first["message"]
    assert "dropped (broken)" in first["message"]
    drive(20, 340)
    assert entry(target, "camera left")["message"] == "ok"
    assert entry(target, "camera left")["level"] == 0
    assert value(target, "camera left", "failed") == "4"
    assert value(target, "camera left", "dropped") == "1"


def test_a_fusion_that_failed_long_ago_is_forgiven():
    target = fuser()
    bad = boxes3d(street(0))
    object.__setattr__(bad, "scores", np.array([3.0, 2.0, 1.0, 0.5]))
    run(target, [LidarBoxes(0.0, bad), *stream(10, start=0.1)])
    assert entry(target, "fusion")["level"] == 2
    run(target, stream(320, start=1.1))
    assert entry(target, "fusion")["level"] == 0
    assert value(target, "fusion", "failed") == "1"


def test_a_camera_that_fell_silent_is_stale_and_comes_back():
    view = camera()
    target = fuser()
    run(target, stream(10))
    run(target, [LidarBoxes(1.0 + 0.1 * i, boxes3d(street(i))) for i in range(15)])
    status = entry(target, "camera left")
    assert status["level"] == 3
    assert "no message for 1.5 s" in status["message"]
    assert entry(target, "lidar")["level"] == 0
    run(target, [LidarBoxes(2.5, boxes3d(street(0))), CameraBoxes(2.51, "left", boxes2d(view, street(0)))])
    assert entry(target, "camera left")["level"] < 3


def test_a_lidar_that_fell_silent_is_stale_and_no_clock_is_blamed():
    target, view = fuser(), camera()
    run(target, stream(10))
    for i in range(100):
        target.push(CameraBoxes(1.0 + 0.1 * i, "left", boxes2d(view, street(i % 20))))
    assert entry(target, "lidar")["level"] == 3
    assert "no message for 10" in entry(target, "lidar")["message"]
    assert entry(target, "camera left")["message"] == "ok"
    results = run(target, stream(3, start=11.0))
    assert results[-1].fused.camera_names == ("left",)
    assert entry(target, "lidar")["level"] == 0


def test_in_real_time_a_stream_that_stopped_altogether_is_stale(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("lcf3d.live.fuser.perf_counter", lambda: now[0])
    target = fuser(realtime=True)
    for message in stream(10):
        target.push(message)
    assert entry(target, "lidar")["level"] == 0
    now[0] += 5.0
    assert entry(target, "lidar")["message"] == "no message for 5.0 s"
    assert entry(target, "camera left")["level"] == 3
    target.close()


def test_slow_sensors_are_not_silent_between_their_messages():
    target = fuser()
    run(target, stream(6, period=2.0))
    assert entry(target, "camera left")["level"] == 0


def test_a_camera_stays_blinded_however_long_it_sees_nothing():
    view, messages = camera(), []
    for i in range(600):
        found = boxes2d(view, street(i % 20)) if i < 60 else Detections2D.empty(NAMES)
        messages += [LidarBoxes(0.1 * i, boxes3d(street(i % 20))), CameraBoxes(0.1 * i, "left", found)]
    target = fuser()
    results = run(target, messages)
    assert not any(r.fused.camera_names for r in results[100:])
    assert "far fewer" in entry(target, "camera left")["message"]


def test_a_camera_whose_moments_never_fit_is_told():
    # 60 ms off its moment, tolerance 40 ms: nothing is dropped, and nothing is ever used
    target = fuser()
    run(target, stream(30, period=0.2, delay=0.06))
    status = entry(target, "camera left")
    assert status["level"] == 1
    assert "missing at 30 of 30 moments" in status["message"]


def test_a_clock_seconds_ahead_takes_no_other_camera_with_it():
    views = [camera("left"), camera("right", yaw=-0.2)]
    target, results = fuser(views), []
    for i in range(10):
        boxes = street(i)
        results += target.push(CameraBoxes(0.1 * i + 3.0, "left", boxes2d(views[0], boxes)))
        results += target.push(LidarBoxes(0.1 * i, boxes3d(boxes)))
        results += target.push(CameraBoxes(0.1 * i + 0.01, "right", boxes2d(views[1], boxes)))
    results += target.flush()
    assert len(results) == 10
    assert all(r.fused.camera_names == ("right",) for r in results[1:])
    assert "its clock is +" in entry(target, "camera left")["message"]


def test_a_clock_that_is_off_spoils_no_delay_of_others(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("lcf3d.live.fuser.perf_counter", lambda: now[0])
    target, view = fuser(), camera()
    for i in range(10):
        now[0] = 1000 + 0.1 * i
        target.push(LidarBoxes(0.1 * i, boxes3d(street(i))))
        target.push(CameraBoxes(0.1 * i + 180, "left", boxes2d(view, street(i))))
    assert float(value(target, "lidar", "delay_ms")) == 0
    assert not any(v["key"] == "delay_ms" for v in entry(target, "camera left")["values"])


def test_scans_that_are_waited_for_and_never_come_are_told():
    target = fuser(scans=True)
    run(target, stream(5))
    assert "no scan came" in entry(target, "lidar")["message"]
    assert entry(target, "lidar")["level"] == 1

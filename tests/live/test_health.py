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

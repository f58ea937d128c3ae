import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.errors import MissingExtraError
from lcf3d.frame import Frame
from lcf3d.fusion.memory import remember_sequence
from lcf3d.structures import InstanceMask
from lcf3d.visualization.rerun_log import RerunLog, point_colours
from lcf3d.visualization.scene import COLOURS, Scene
from tests.fusion.scenes import camera, car, lidar, seen

pytest.importorskip("rerun")


def fused_frame():
    view, boxes = camera(), [car(12.0), car(25.0, 4.0)]
    points = np.array([[12.0, 0.0, -0.8, 0.5], [40.0, 0.0, -0.8, 0.5]], np.float32)
    image = np.full((400, 1000, 3), 80, np.uint8)
    frame = Frame("0", points, [view], {"left": image}, timestamp=1.5)
    fusion = LateCascadeFusion(FusionConfig(recovery=False))
    mask = InstanceMask(450, 180, np.ones((40, 60), dtype=bool))
    found = replace(seen(view, boxes[:1], [0.8]), masks=(mask,))
    return frame, fusion(frame, lidar(boxes, [0.9, 0.5]), {"left": found})


def entities(path):
    """Entity paths of a recording, as Rerun's own command line reads them."""
    done = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "print", "-vv", str(path)],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout + done.stderr


def test_a_recording_holds_scan_boxes_cameras_reasons_and_curves(tmp_path):
    frame, fused = fused_frame()
    log = RerunLog(tmp_path / "a" / "drive.rrd", ["left"], stream=True)
    share = {"key": "confirmed_share", "value": "0.75"}
    for message in ("ok", "ok", "frozen"):
        status = {"hardware_id": "camera left", "level": 2, "message": message, "values": [share]}
        curves = {"latency_ms": {"added": 2.0}, "alignment_deg": {"left": 0.1}, "health": [status]}
        log.log(frame, fused, truth=fused.detections, **curves)
    log.close()
    path = tmp_path / "a" / "drive.rrd"
    assert path.stat().st_size > 1000
    told = entities(path)
    expected = (
        "/world/scan", "/world/boxes", "/world/truth", "/world/cameras/left/image", "/world/cameras/left/image/boxes",
        "/reasons", "/world/cameras/left/image/masks", "/latency/added", "/alignment/left", "/scores/highest",
        "/boxes/matched", "/health/left", "/confirmed/left", "/events",
    )  # fmt: skip
    assert [text for text in expected if text not in told] == []


def test_names_with_spaces_and_slashes_are_names_and_not_paths(tmp_path, capfd):
    frame, fused = fused_frame()
    (view,) = frame.cameras
    frame = frame.with_cameras([replace(view, name="front/left eye")])
    log = RerunLog(tmp_path / "drive.rrd", ["front/left eye"], stream=True)
    status = {"hardware_id": "camera front/left eye", "level": 0, "message": "ok", "values": []}
    log.log(frame, replace(fused, camera_names=("front/left eye",)), latency_ms={"detect scan": 2.0}, health=[status])
    log.close()
    told = entities(tmp_path / "drive.rrd")
    assert r"/world/cameras/front\/left\ eye/image" in told
    assert r"/latency/detect\ scan" in told
    assert r"/health/front\/left\ eye" in told
    assert "Unescaped" not in capfd.readouterr().err


def test_masks_colour_objects_and_leave_the_rest_alone(tmp_path):
    log, logged = watched(tmp_path)
    frame, fused = fused_frame()
    log.log(frame, fused)
    picture = logged["world/cameras/left/image/masks"][0].buffer.as_arrow_array().to_pylist()[0]
    assert set(picture) == {0, 1}
    log = RerunLog(tmp_path / "other.rrd", ["left"])
    log.close()
    told = entities(tmp_path / "other.rrd")
    assert "AnnotationContext" in told


def watched(tmp_path):
    """A log whose stream only keeps what is logged, by entity."""
    log, logged = RerunLog(tmp_path / "drive.rrd", ["left"], stream=True), {}
    log._stream = SimpleNamespace(
        log=lambda entity, thing, **_: logged.setdefault(entity, []).append(thing), set_time=lambda *_, **__: None
    )
    return log, logged


def test_boxes_carry_their_reasons_and_health_is_told_when_it_changes(tmp_path):
    frame, fused = fused_frame()
    log, logged = watched(tmp_path)
    for level, message in ((0, "ok"), (0, "ok"), (2, "frozen")):
        status = {"hardware_id": "camera left", "level": level, "message": message, "values": []}
        log.log(frame, fused, health=[status])
    labels = logged["world/boxes"][0].labels.as_arrow_array().to_pylist()
    assert labels[: len(fused)] == [fused.explain(i) for i in range(len(fused))]
    assert len(logged["health/left"]) == 3
    assert [str(line.text.as_arrow_array().to_pylist()[0]) for line in logged["events"]] == ["left: ok", "left: frozen"]
    assert "confirmed/left" not in logged


def test_tracks_have_trails_over_ground(tmp_path):
    log, logged = watched(tmp_path)
    frame, fused = fused_frame()
    pairs = []
    for i in range(4):
        world = np.eye(4)
        world[0, 3] = 2.0 * i
        moved = replace(fused.detections, boxes=fused.detections.boxes - [2.0 * i, 0, 0, 0, 0, 0, 0])
        moment = Frame(str(i), frame.points, frame.cameras, {}, timestamp=0.1 * i, world_from_lidar=world)
        pairs.append((moment, replace(fused, detections=moved)))
    for (moment, _), remembered in zip(pairs, remember_sequence(pairs), strict=True):
        log.log(moment, remembered)
    drawn = logged["world/trails"]
    assert len(drawn) == 4
    assert len(drawn[0].strips.as_arrow_array()) == 0
    strips = np.array(drawn[-1].strips.as_arrow_array().to_pylist()[0])
    # the cars stand while we drive past: in the last frame's coordinates all four places are the same
    assert strips.shape == (4, 3)
    assert np.abs(strips - strips[0]).max() < 0.3


def test_points_have_the_colour_of_what_was_decided():
    frame, fused = fused_frame()
    colours = point_colours(frame.points, Scene.from_fused(fused))
    assert tuple(colours[0]) == COLOURS["matched"]
    assert tuple(colours[1]) not in COLOURS.values()


def test_without_rerun_the_error_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"lcf3d\[viz\]"):
        RerunLog(tmp_path / "a.rrd", [])

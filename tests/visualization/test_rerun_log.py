import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.errors import MissingExtraError
from lcf3d.structures import Frame, InstanceMask
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
    log = RerunLog(tmp_path / "a" / "drive.rrd", ["left"])
    for _ in range(3):
        log.log(frame, fused, truth=fused.detections, latency_ms={"added": 2.0}, alignment_deg={"left": 0.1})
    log.close()
    path = tmp_path / "a" / "drive.rrd"
    assert path.stat().st_size > 1000
    told = entities(path)
    for entity in (
        "/world/scan", "/world/boxes", "/world/truth", "/world/cameras/left/image", "/world/cameras/left/image/boxes",
        "/reasons", "/world/cameras/left/image/masks", "/latency/added", "/alignment/left", "/scores/boxes",
    ):  # fmt: skip
        assert entity in told, told[:2000]


def test_points_have_the_colour_of_what_was_decided():
    frame, fused = fused_frame()
    colours = point_colours(frame.points, Scene.from_fused(fused))
    assert tuple(colours[0]) == COLOURS["matched"]
    assert tuple(colours[1]) not in COLOURS.values()


def test_without_rerun_the_error_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"lcf3d\[viz\]"):
        RerunLog(tmp_path / "a.rrd", [])

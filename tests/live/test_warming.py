import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from lcf3d import Fuser, FusionConfig, LateCascadeFusion
from lcf3d.live.messages import CameraBoxes, LidarBoxes, Scan, plain_points
from lcf3d.live.warming import made_up_cameras, rehearsal
from tests.fusion.scenes import camera
from tests.live.streams import NAMES, boxes2d, boxes3d, fuser, street

ROOT = Path(__file__).parents[2]

# in a process of its own: what other tests have compiled does not count
FIRST_FRAMES = """
import gc
import sys
import numpy as np
from dataclasses import replace
from numba.core.dispatcher import Dispatcher
from lcf3d import Fuser, FusionConfig, LateCascadeFusion, LiveSettings, SyncSettings
from lcf3d.fusion.alignment_watch import WatchSettings
from lcf3d.live.messages import CameraBoxes, LidarBoxes, Scan
from tests.fusion.scenes import camera
from tests.live.streams import NAMES, boxes2d, boxes3d, pose, street
from lcf3d.distortion import Distortion

lens = Distortion("fisheye", (0.02, -0.004, 0.0, 0.0))
views = [camera("left"), camera("right", yaw=-0.2), replace(camera("bent"), distortion=lens)]
settings = LiveSettings(SyncSettings(deadline=0.25), watch=WatchSettings(every=1), correct=True)
fuser = Fuser(LateCascadeFusion(FusionConfig()), views, settings=settings, memory=True)
if "cold" not in sys.argv:
    fuser.warm_up()

def ready():
    # a function that nothing was compiled for yet is no different from one that is not imported yet
    known = [d for d in gc.get_objects() if isinstance(d, Dispatcher) and d.py_func.__module__.startswith("lcf3d")]
    return {d.py_func.__qualname__: len(d.overloads) for d in known if d.overloads}

before, rng, results = ready(), np.random.default_rng(0), []
for i in range(15):
    boxes, t = street(i % 12, 6), 0.1 * i
    points = rng.uniform([0, -20, -1.8], [60, 20, -1.5], (3000, 3))
    on = boxes[:, None, :3] + rng.uniform(-0.7, 0.7, (len(boxes), 60, 3))
    points = np.column_stack([np.concatenate([points, on.reshape(-1, 3)]), np.zeros(3000 + 60 * len(boxes))])
    points.setflags(write=False)
    fuser.push(pose(t - 0.05, 5 * t - 0.25))
    fuser.push(pose(t + 0.05, 5 * t + 0.25))
    fuser.push(Scan(t, points if i % 2 else points.astype(np.float32)[::-1]))
    fuser.push(LidarBoxes(t, boxes3d(boxes[: 5 - i % 2], [[1.0, 0.0]] * (5 - i % 2) if i % 3 else None)))
    for view in views:
        results += fuser.push(CameraBoxes(t + 0.002, view.name, boxes2d(view, boxes[1:])))
assert len(results) == 15, len(results)
assert any("recovered" in text for r in results for text in r.fused.explanations())
print(*sorted(name for name, count in ready().items() if count > before.get(name, 0)))
"""


def late(*arguments):
    """Names of the functions that were compiled or loaded after the warm-up."""
    command = [sys.executable, "-c", FIRST_FRAMES, *arguments]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.split()


def test_no_function_is_compiled_or_loaded_after_the_warm_up():
    assert late() == []
    # the measure measures: without a warm-up there are many
    assert len(late("cold")) > 20


def test_detectors_are_shown_a_real_scan_and_images_of_their_camera():
    shown = {}
    view = camera()

    def lidar(points):
        shown.setdefault("scan", points)
        return boxes3d(street(0))

    def found(images):
        shown.setdefault("image", images[0])
        return [boxes2d(view, street(0)) for _ in images]

    target = fuser(lidar_detector=lidar, detectors={"left": found}, scans=True)
    target.warm_up()
    assert len(shown["scan"]) > 10_000
    assert shown["image"].shape == (view.height, view.width, 3)
    assert shown["image"].std() > 10
    # nothing of it is left
    assert target.flush() == []
    assert target.dropped() == {}
    assert target.watch is None or target.watch.cameras == ()


def test_a_detector_that_fails_at_the_warm_up_is_reported_and_stops_nothing(caplog):
    def broken(images):
        raise RuntimeError("no such layer")

    target = fuser(detectors={"left": broken})
    target.warm_up()
    assert "camera left failed" in caplog.text
    (status, *_) = target.diagnostics()
    notes = next(v["value"] for v in status["values"] if v["key"] == "notes")
    assert "camera left failed at the warm-up: RuntimeError: no such layer" in notes


def test_the_made_up_stream_goes_every_way():
    target = Fuser(LateCascadeFusion(FusionConfig(class_names=NAMES)), made_up_cameras(), memory=True)
    results = []
    for message in rehearsal(made_up_cameras(), NAMES):
        results += target.push(message)
    results += target.flush()
    assert len(results) == 7
    assert not target.health.last_error
    text = " ".join(text for r in results for text in r.fused.explanations())
    for outcome in ("matched", "recovered", "predicted"):
        assert outcome in text


def test_scans_of_any_layout_are_fused_alike():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 4))
    plain = plain_points(points)
    assert (plain.dtype, plain.shape) == (np.float32, (50, 4))
    for other in (points.astype(np.float32), points[:, ::-1][:, ::-1], np.asfortranarray(points)):
        assert np.array_equal(plain_points(other), plain)
        assert plain_points(other).flags.c_contiguous
    points.setflags(write=False)
    assert plain_points(points).flags.writeable
    target = fuser(scans=True)
    messages = [Scan(0.0, points[:, :3]), LidarBoxes(0.0, boxes3d(street(0)))]
    results = [r for m in [*messages, CameraBoxes(0.0, "left", boxes2d(camera(), street(0)))] for r in target.push(m)]
    assert results[0].frame.points.shape == (50, 4)

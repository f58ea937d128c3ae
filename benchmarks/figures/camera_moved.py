"""The two pictures of docs/camera-moved.md.

    python benchmarks/figures/camera_moved.py ap yaw.json docs/images/camera-moved-ap.png
    python benchmarks/figures/camera_moved.py knock KITTI_TRACKING docs/images/camera-moved-knock.png

``ap`` draws tables that ``benchmarks/calibration_watch.py --json`` wrote (several, joined by commas). ``knock`` streams
a drive of KITTI layout whose camera is knocked by half a degree in the middle, and back, past the watch.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

COLOURS = {"as_it_is": "#c0392b", "watch": "#1a9850", "lidar_alone": "#555555"}
NAMES = {"as_it_is": "fusion as it is", "watch": "fusion, watch correcting", "lidar_alone": "LiDAR alone"}


def draw_ap(tables: list[Path], out: Path) -> None:
    """AP over the angle, one panel a data set and class."""
    import matplotlib.pyplot as plt

    panels = []
    for path in tables:
        table = json.loads(path.read_text(encoding="utf-8"))
        for name in ("Car", "Pedestrian"):
            if np.isfinite(table["angles"][0]["watch"][name]):
                panels.append((f"{name}, {table['frames']} frames", name, table))
    figure, axes = plt.subplots(1, len(panels), figsize=(4.2 * len(panels), 3.4), layout="constrained")
    for axis, (title, name, table) in zip(np.atleast_1d(axes), panels, strict=True):
        places = np.arange(len(table["angles"]))
        for way in ("as_it_is", "watch"):
            axis.plot(places, [row[way][name] for row in table["angles"]], "o-", color=COLOURS[way], label=NAMES[way])
        axis.axhline(table["lidar_alone"][name], ls="--", color=COLOURS["lidar_alone"], label=NAMES["lidar_alone"])
        axis.set_xticks(places, [f"{row['degrees']:g}" for row in table["angles"]])
        axis.set(title=title, xlabel=f"camera turned ({table['axis']}), degrees", ylabel="3D AP R40, moderate")
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].legend(loc="lower left", fontsize=8)
    figure.savefig(out, dpi=110)


def draw_knock(root: Path, out: Path) -> None:
    """Estimated yaw with twice its deviation, and the status, over a drive with a knock."""
    import matplotlib.pyplot as plt

    from lcf3d import FusionConfig
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.fusion.alignment import realigned
    from lcf3d.fusion.alignment_watch import AlignmentWatch

    names = FusionConfig.preset("kitti").class_names
    data = KittiDataset(root, class_names=names)
    lidar = data.lidar_results(root / "results" / "pointrcnn", names)
    camera = data.camera_results(root / "results" / "rrc_2d", names)
    ids = data.ids[:450]
    watch, rows, truth = AlignmentWatch(names), [], []
    for i, frame_id in enumerate(ids):
        frame = data.frame(frame_id)
        knocked = 150 <= i < 300
        # the calibration is off by the opposite of what the camera has turned
        turn = np.deg2rad([0, -0.5 if knocked else 0.0, 0])
        shown = frame.with_cameras([realigned(frame.camera("left"), turn)])
        watch.observe(shown, lidar.detect(frame), {"left": camera.detect(frame, "left")})
        report = watch.report("left")
        rows.append(
            (np.rad2deg(report.alignment.rotation[1]), np.rad2deg(report.alignment.deviation[1]), report.status)
        )
        truth.append(0.5 if knocked else 0.0)
    yaw, deviation = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    known = np.array([row[2] != "unknown" for row in rows])
    figure, axis = plt.subplots(figsize=(9, 3.2), layout="constrained")
    frames = np.arange(len(rows))
    axis.fill_between(frames[known], (yaw - 2 * deviation)[known], (yaw + 2 * deviation)[known], color="#1a985033")
    axis.plot(frames, truth, color="#555555", ls="--", label="true turn")
    axis.plot(frames[known], yaw[known], color="#1a9850", label="estimate, twice its deviation")
    alarm = np.array([row[2] in ("drifting", "wrong") for row in rows])
    axis.fill_between(frames, -0.45, -0.4, where=alarm, color="#c0392b", step="mid", label="alarm")
    axis.set(xlabel="frame", ylabel="yaw, degrees", ylim=(-0.45, 0.95), title="A camera knocked by half a degree")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncols=3, loc="upper left")
    figure.savefig(out, dpi=110)
    for knock in (150, 300):
        changed = np.flatnonzero(alarm[knock:] == (knock == 150))
        print(f"camera moved at frame {knock}, status follows after {changed[0] + 1} frames")


if __name__ == "__main__":
    kind, source, target = sys.argv[1:]
    if kind == "ap":
        draw_ap([Path(name) for name in source.split(",")], Path(target))
    else:
        draw_knock(Path(source), Path(target))

"""How well the calibration watch finds a camera's time offset on Argoverse 2's real tracks, and on a made-up drive.

    python benchmarks/time_offset.py argoverse2/sensor/val/LOG --offsets 0 20 50 100 200
    python benchmarks/time_offset.py made-up --offsets 0 20 50 100 200

LiDAR boxes are the log's cuboids with noise, 10 a second. Camera detections are simulated at the cameras' own moments:
every track is moved on along its path to the true moment of the image, projected with the ego pose of that moment
(pinhole, no distortion), noised and thinned out; their time stamps are wrong by the offset. All of it goes through
`lcf3d.live.Fuser`. ``--velocities`` says how well the detector knows velocities: the standard deviation of their error
in m/s, or none for a detector without velocities (then only the car's own motion tells). The made-up drive is that of
`live_replay.py`, 30 seconds of it, with all six cameras.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from live_replay import Drive, poses

from lcf3d import Camera, Detections2D, Detections3D, FusionConfig, LateCascadeFusion
from lcf3d.fusion.alignment_watch import WatchSettings
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.rotation import invert_rigid, rigid_transforms, yaws_from_quaternions
from lcf3d.live.fuser import Fuser
from lcf3d.live.messages import CameraBoxes, EgoPose, LidarBoxes, Message
from lcf3d.live.poses import PoseBuffer
from lcf3d.live.settings import LiveSettings
from lcf3d.live.synchronizer import SyncSettings
from lcf3d.structures import BoolArray, FloatArray

CLASSES = {
    "REGULAR_VEHICLE": "car", "LARGE_VEHICLE": "car", "BOX_TRUCK": "car", "BUS": "car", "TRUCK": "car",
    "PEDESTRIAN": "pedestrian", "BICYCLIST": "pedestrian",
}  # fmt: skip
NAMES = ("car", "pedestrian")
# noise of the LiDAR boxes: centres and sizes in metres; of the 2D boxes: pixels and share of the side; share missed
CENTRE, SIZE, PIXELS, SHARE, MISSED = 0.1, 0.05, 2.0, 0.02, 0.15
# boxes further than this, or with fewer points, are not detected
RANGE, FEWEST_POINTS = 60.0, 10
# of the made-up drive
SECONDS = 30.0


class Log:
    """One log: tracks in the city frame, ego poses, cameras."""

    def __init__(self, root: Path, cameras: list[str]) -> None:
        from pyarrow.feather import read_table

        self.poses = PoseBuffer()
        poses = read_table(root / "city_SE3_egovehicle.feather").to_pandas()
        self.pose_times = poses["timestamp_ns"].to_numpy() * 1e-9
        self.pose_matrices = _transforms(poses)
        rows = read_table(root / "annotations.feather").to_pandas()
        rows = rows[rows["category"].isin(CLASSES)]
        self.times = np.unique(rows["timestamp_ns"].to_numpy()) * 1e-9
        stamp = rows["timestamp_ns"].to_numpy() * 1e-9
        boxes = np.column_stack(
            [
                rows[["tx_m", "ty_m", "tz_m", "length_m", "width_m", "height_m"]].to_numpy(),
                yaws_from_quaternions(rows[["qw", "qx", "qy", "qz"]].to_numpy()),
            ]
        )
        self.start = self.times[0]
        self.tracks: dict[str, tuple[FloatArray, FloatArray, int]] = {}
        self.moments: dict[float, tuple[list[str], FloatArray, BoolArray]] = {}
        tracks, labels = rows["track_uuid"].to_numpy(), rows["category"].map(CLASSES).map(NAMES.index).to_numpy()
        seen = (rows["num_interior_pts"].to_numpy() >= FEWEST_POINTS) & (np.hypot(*boxes[:, :2].T) < RANGE)
        for time in self.times:
            own = stamp == time
            self.moments[time] = (list(tracks[own]), boxes[own], seen[own])
        city = np.concatenate([transform_boxes(self.moments[t][1], self.pose(t)) for t in self.times])
        order = np.concatenate([np.flatnonzero(stamp == t) for t in self.times])
        for track in np.unique(tracks):
            own = tracks[order] == track
            self.tracks[track] = (stamp[order][own], city[own], int(labels[order][own][0]))
        intrinsics = read_table(root / "calibration" / "intrinsics.feather").to_pandas().set_index("sensor_name")
        mounts = read_table(root / "calibration" / "egovehicle_SE3_sensor.feather").to_pandas()
        transforms = dict(zip(mounts["sensor_name"], _transforms(mounts), strict=True))
        self.cameras = [_camera(name, intrinsics.loc[name], transforms[name]) for name in cameras]

    def pose(self, time: float) -> FloatArray:
        """City from ego at a moment."""
        i = int(np.clip(np.searchsorted(self.pose_times, time), 1, len(self.pose_times) - 1))
        buffer = PoseBuffer()
        for k in (i - 1, i):
            buffer.add(self.pose_times[k], self.pose_matrices[k])
        pose = buffer.at(float(time))
        assert pose is not None
        return pose

    def at(self, track: str, time: float) -> FloatArray | None:
        """(7,) box of a track at a moment in the city frame, None outside its life."""
        times, boxes, _ = self.tracks[track]
        if not times[0] <= time <= times[-1]:
            return None
        box = boxes[int(np.argmin(np.abs(times - time)))].copy()
        for axis in range(3):
            box[axis] = np.interp(time, times, boxes[:, axis])
        return box

    def velocity(self, track: str, time: float) -> FloatArray:
        """(2,) m/s over ground in the ego frame's axes."""
        before, after = self.at(track, time - 0.1), self.at(track, time + 0.1)
        if before is None or after is None:
            return np.full(2, np.nan)
        city = (after[:3] - before[:3]) / 0.2
        return np.asarray((self.pose(time)[:3, :3].T @ city)[:2])


def messages(log: Log, offset: float, velocities: float | None, rng: np.random.Generator) -> list[Message]:
    """The stream: boxes of the LiDAR, poses, and 2D boxes that were taken ``offset`` seconds after their stamp."""
    out: list[Message] = []
    for pose_time, matrix in zip(log.pose_times, log.pose_matrices, strict=True):
        out.append(EgoPose(float(pose_time - log.start), matrix))
    for time in log.times:
        tracks, boxes, seen = log.moments[time]
        kept = np.flatnonzero(seen & (rng.random(len(boxes)) > MISSED / 3))
        noisy = boxes[kept].copy()
        noisy[:, :3] += rng.normal(0, CENTRE, (len(kept), 3))
        noisy[:, 3:6] += rng.normal(0, SIZE, (len(kept), 3))
        labels = np.array([log.tracks[tracks[k]][2] for k in kept], dtype=np.int64)
        speed = None
        if velocities is not None:
            speed = np.array([log.velocity(tracks[k], time) for k in kept]).reshape(-1, 2)
            speed = speed + rng.normal(0, velocities, speed.shape)
        lidar = Detections3D(noisy, rng.uniform(0.6, 0.95, len(kept)), labels, NAMES, speed)
        out.append(LidarBoxes(float(time - log.start), lidar))
        for c, camera in enumerate(log.cameras):
            stamp = time + 0.005 * (c + 1)
            out.append(CameraBoxes(float(stamp - log.start), camera.name, _seen(log, camera, stamp + offset, rng)))
    return sorted(out, key=lambda message: message.time)


def _seen(log: Log, camera: Camera, time: float, rng: np.random.Generator) -> Detections2D:
    """2D detections of an image taken at a moment."""
    nearest = log.times[int(np.argmin(np.abs(log.times - time)))]
    tracks, _, seen = log.moments[nearest]
    there = [(log.at(t, time), log.tracks[t][2]) for t, s in zip(tracks, seen, strict=True) if s]
    city = np.array([box for box, _ in there if box is not None]).reshape(-1, 7)
    labels = np.array([label for box, label in there if box is not None], dtype=np.int64)
    projected, visible = project_boxes(transform_boxes(city, invert_rigid(log.pose(time))), camera)
    visible &= rng.random(len(visible)) > MISSED
    edges = projected[visible]
    sides = np.concatenate([edges[:, 2:] - edges[:, :2]] * 2, axis=1)
    edges = edges + rng.normal(size=edges.shape) * np.sqrt(PIXELS**2 + (SHARE * sides) ** 2)
    limits = np.array([camera.width, camera.height] * 2)
    edges = np.clip(edges, 0, limits)
    good = (edges[:, 2] > edges[:, 0] + 2) & (edges[:, 3] > edges[:, 1] + 2)
    return Detections2D(edges[good], rng.uniform(0.6, 0.95, int(good.sum())), labels[visible][good], NAMES)


def made_up(drive: Drive, offset: float, velocities: float | None, rng: np.random.Generator) -> list[Message]:
    """The same of a made-up drive of `SECONDS`, 10 scans a second."""
    out: list[Message] = list(poses(0.0, SECONDS + 0.5))
    for i in range(round(10 * SECONDS)):
        for message in drive.frame(i / 10, rng, offset):
            if isinstance(message, LidarBoxes):
                speeds = message.detections.velocities
                assert speeds is not None
                noisy = None if velocities is None else speeds + rng.normal(0, velocities, speeds.shape)
                message = replace(message, detections=replace(message.detections, velocities=noisy))
            out.append(message)
    return sorted(out, key=lambda message: message.time)


def measure(cameras: Sequence[Camera], stream: list[Message], offset: float, window: int) -> dict[str, Any]:
    """Estimates of every camera at the end of the log and on the way."""
    config = FusionConfig(class_names=NAMES, recovery=False)
    sync = SyncSettings(tolerance=0.045, deadline=0.25, scans=False, poses=True)
    watch = WatchSettings(time=True, window=window)
    fuser = Fuser(LateCascadeFusion(config), cameras, settings=LiveSettings(sync, watch=watch))
    assert fuser.watch is not None
    errors: dict[str, list[float]] = {camera.name: [] for camera in cameras}
    sure: dict[str, list[float]] = {camera.name: [] for camera in cameras}
    alarms = dict.fromkeys(errors, 0)
    for message in stream:
        for _ in fuser.push(message):
            for name in errors:
                report = fuser.watch.report(name)
                deviation = 1e3 * float(report.alignment.deviation[8])
                if report.frames >= window and report.status != "unknown":
                    errors[name].append(1e3 * (report.alignment.time_offset - offset))
                    sure[name].append(deviation)
                    alarms[name] += report.status in ("drifting", "wrong")
    rows = {}
    for name, values in errors.items():
        array, deviation = np.array(values), np.array(sure[name])
        told = np.asarray(deviation < 10, dtype=bool)
        rows[name] = {
            "moments": len(array),
            "told_to_10_ms": int(told.sum()),
            "rms_ms": round(float(np.sqrt((array[told] ** 2).mean())), 2) if told.any() else None,
            "max_ms": round(float(np.abs(array[told]).max()), 2) if told.any() else None,
            "rms_all_ms": round(float(np.sqrt((array**2).mean())), 2) if len(array) else None,
            "alarm_share": round(alarms[name] / max(len(array), 1), 3),
        }
    return rows


def _transforms(table: Any) -> FloatArray:
    return rigid_transforms(
        table[["qw", "qx", "qy", "qz"]].to_numpy(dtype=np.float64),
        table[["tx_m", "ty_m", "tz_m"]].to_numpy(dtype=np.float64),
    )


def _camera(name: str, row: Any, ego_from_camera: FloatArray) -> Camera:
    projection = np.array([[row.fx_px, 0, row.cx_px, 0], [0, row.fy_px, row.cy_px, 0], [0, 0, 1, 0]])
    return Camera(name, projection, invert_rigid(ego_from_camera), int(row.width_px), int(row.height_px))


def main() -> None:
    """Read, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", help="folder of a log, or made-up")
    parser.add_argument("--offsets", type=float, nargs="+", default=[0, 20, 50, 100, 200], help="milliseconds")
    parser.add_argument("--velocities", default="0.5", help="standard deviation of their error in m/s, or none")
    parser.add_argument("--cameras", nargs="+", default=["ring_front_center", "ring_front_left", "ring_side_right"])
    parser.add_argument("--window", type=int, default=50)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    velocities = None if options.velocities == "none" else float(options.velocities)
    source = Drive() if options.log == "made-up" else Log(Path(options.log), options.cameras)
    table = []
    for offset in options.offsets:
        rng = np.random.default_rng(0)
        write = made_up if isinstance(source, Drive) else messages
        stream = write(source, offset / 1e3, velocities, rng)  # type: ignore[operator]
        row = {"offset_ms": offset, "cameras": measure(source.cameras, stream, offset / 1e3, options.window)}
        table.append(row)
        print(json.dumps(row), flush=True)
    if options.json:
        options.json.write_text(json.dumps({"velocities": options.velocities, "rows": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()

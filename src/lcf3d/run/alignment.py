"""How the cameras of a whole drive stand against the LiDAR: for ``lcf3d check`` and ``lcf3d run --self-calibrate``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.datasets.check import Finding
from lcf3d.errors import DatasetError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import Alignment, realigned
from lcf3d.fusion.alignment_matching import Sighting
from lcf3d.fusion.alignment_watch import CORRELATED, FEWEST_PAIRS, CameraReport, WatchSettings, estimate, judge
from lcf3d.run.sources import CameraOnImages

# frames that are looked at, evenly over the drive; the same where a camera detector has to be run on them
FRAMES, FRAMES_WITH_IMAGES = 200, 40
# with fewer frames than this in a half of the drive the halves are not compared
HALF = 20


def find_alignment(
    dataset: Dataset,
    frame_ids: Sequence[str],
    lidar: LidarSource,
    cameras: Mapping[str, CameraSource],
    class_names: Sequence[str],
) -> dict[str, list[CameraReport]]:
    """For each camera a report over the whole drive, and where it is long enough one of each half.

    Args:
        dataset: whose frames they are.
        frame_ids: the frames, in order of time.
        lidar: the LiDAR branch.
        cameras: the camera branch by camera name.
        class_names: classes that both detect.

    Raises:
        DatasetError: no camera has detections in any of the frames looked at.
    """
    step = _step(frame_ids, cameras)
    seen: dict[str, list[Sighting]] = {}
    for i, frame in enumerate(map(dataset.frame, frame_ids[::step])):
        views = [c for c in frame.cameras if c.name in cameras and cameras[c.name].sees(frame, c.name)]
        boxes = lidar.detect(frame).with_classes(class_names) if views else None
        for view in views:
            assert boxes is not None
            found = cameras[view.name].detect(frame, view.name).with_classes(class_names)
            group = i if step >= CORRELATED else i // CORRELATED
            seen.setdefault(view.name, []).append(Sighting.of(view, boxes, found, group=group))
    if not seen:
        raise DatasetError(
            f"no frame has detections of {' or '.join(cameras)}: nothing to compare with the LiDAR boxes"
        )
    return {name: _reports(sightings) for name, sightings in seen.items()}


def looked_at(frame_ids: Sequence[str], cameras: Mapping[str, CameraSource]) -> Sequence[str]:
    """The frames that `find_alignment` looks at."""
    return frame_ids[:: _step(frame_ids, cameras)]


def _step(frame_ids: Sequence[str], cameras: Mapping[str, CameraSource]) -> int:
    most = FRAMES_WITH_IMAGES if any(isinstance(source, CameraOnImages) for source in cameras.values()) else FRAMES
    return -(-len(frame_ids) // most) or 1


def _reports(sightings: list[Sighting]) -> list[CameraReport]:
    """Of all sightings, then of each half."""
    middle = len(sightings) // 2
    parts = [sightings, *([sightings[:middle], sightings[middle:]] if middle >= HALF else [])]
    reports = []
    for part in parts:
        alignment = estimate(part, Alignment.nominal())
        reports.append(CameraReport(judge(alignment, WatchSettings()), alignment, len(part)))
    return reports


def aligned_frame(frame: Frame, alignment: Mapping[str, Alignment]) -> Frame:
    """The frame with each camera turned as estimated, where the estimate rests on enough pairs."""
    if not alignment:
        return frame
    return frame.with_cameras(
        [
            realigned(camera, alignment[camera.name].rotation, alignment[camera.name].state[3:6])
            if camera.name in alignment and alignment[camera.name].pairs >= FEWEST_PAIRS
            else camera
            for camera in frame.cameras
        ]
    )


def alignment_findings(reports: Mapping[str, list[CameraReport]]) -> list[Finding]:
    """What `find_alignment` found, as findings: ``CAM01`` turned, ``CAM02`` turned in the middle, ``CAM03`` unknown."""
    findings = []
    settings = WatchSettings()
    for name, (whole, *halves) in reports.items():
        said = describe(whole)
        if whole.status in ("drifting", "wrong"):
            message = f"camera {name} is turned against its calibration: {said}; run with --self-calibrate"
            findings.append(Finding("CAM01", "error" if whole.status == "wrong" else "warning", message))
        if whole.status == "unknown":
            findings.append(Finding("CAM03", "warning", f"camera {name}: too little to tell how it stands: {said}"))
        if len(halves) == 2 and all(half.alignment.pairs >= FEWEST_PAIRS for half in halves):
            moved = np.rad2deg(halves[1].alignment.surely_beyond(settings.sure, halves[0].alignment))
            if moved > settings.drifting_deg:
                message = f"camera {name} moved during the drive: {describe(halves[0])} in its first half, then "
                findings.append(Finding("CAM02", "warning", message + describe(halves[1])))
    return findings


def describe(report: CameraReport) -> str:
    """Pitch, yaw and roll with their deviations in words."""
    angles, deviations = np.rad2deg(report.alignment.rotation), np.rad2deg(report.alignment.deviation[:3])
    parts = [
        f"{name} {angle:+.2f} \u00b1 {deviation:.2f}"
        for name, angle, deviation in zip(("pitch", "yaw", "roll"), angles, deviations, strict=True)
    ]
    return f"{', '.join(parts)} degrees from {report.alignment.pairs} pairs in {report.frames} frames"

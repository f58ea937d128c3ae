"""How the cameras of a whole drive stand against the LiDAR: for ``lcf3d check`` and ``lcf3d run --self-calibrate``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.datasets.check import Finding
from lcf3d.errors import DatasetError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import Alignment, realigned
from lcf3d.fusion.alignment_matching import Sighting
from lcf3d.fusion.alignment_watch import CORRELATED, FEWEST_PAIRS, CameraReport, WatchSettings, estimate, judge
from lcf3d.provenance import FusedDetections
from lcf3d.run.sources import in_files
from lcf3d.structures import Detections2D, Detections3D

# frames that are looked at, evenly over the drive; the same where a camera detector has to be run on them
FRAMES, FRAMES_WITH_IMAGES = 200, 40
# frames of a finished run that are looked at again
LOOKED_BACK = 50
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
    chosen, step = _looked_at(frame_ids, cameras)

    def detections(frame: Frame) -> tuple[Detections3D, dict[str, Detections2D]] | None:
        names = [c.name for c in frame.cameras if c.name in cameras and cameras[c.name].sees(frame, c.name)]
        return (lidar.detect(frame), {name: cameras[name].detect(frame, name) for name in names}) if names else None

    seen = _sightings(map(dataset.frame, chosen), step, detections, class_names)
    if not seen:
        raise DatasetError(
            f"no frame has detections of {' or '.join(cameras)}: nothing to compare with the LiDAR boxes"
        )
    return {name: _reports(sightings) for name, sightings in seen.items()}


def looked_at(frame_ids: Sequence[str], cameras: Mapping[str, CameraSource]) -> Sequence[str]:
    """The frames that `find_alignment` looks at."""
    return _looked_at(frame_ids, cameras)[0]


def _looked_at(frame_ids: Sequence[str], cameras: Mapping[str, CameraSource]) -> tuple[Sequence[str], int]:
    return evenly(frame_ids, FRAMES if in_files(cameras) else FRAMES_WITH_IMAGES)


def turned_warnings(
    dataset: Dataset, frame_ids: Sequence[str], read: Callable[[str], FusedDetections], class_names: Sequence[str]
) -> tuple[str, ...]:
    """A sentence for each camera that the results of a run show to be turned against its calibration.

    For a run that did not look before: some of its frames are read again, nothing is detected anew.

    Args:
        dataset: whose frames they are.
        frame_ids: the frames of the run.
        read: gives the result of a frame.
        class_names: classes that both branches detect.
    """
    chosen, step = evenly(frame_ids, LOOKED_BACK)

    def detections(frame: Frame) -> tuple[Detections3D, dict[str, Detections2D]]:
        fused = read(frame.id)
        return fused.lidar_inputs, dict(zip(fused.camera_names, fused.camera_inputs, strict=True))

    warnings = []
    for name, sightings in _sightings(map(dataset.frame, chosen), step, detections, class_names).items():
        report = _reports(sightings)[0]
        if report.status in ("drifting", "wrong"):
            warnings.append(
                f"camera {name} looks turned against its calibration ({describe(report)}): it confirms and recovers "
                "boxes in the wrong places; run again with --self-calibrate --overwrite, or mend the calibration"
            )
    return tuple(warnings)


def evenly(frame_ids: Sequence[str], most: int) -> tuple[Sequence[str], int]:
    """At most so many frames, evenly, and the step from one to the next."""
    step = -(-len(frame_ids) // most) or 1
    return frame_ids[::step], step


def _sightings(
    frames: Iterable[Frame],
    step: int,
    detections: Callable[[Frame], tuple[Detections3D, Mapping[str, Detections2D]] | None],
    class_names: Sequence[str],
) -> dict[str, list[Sighting]]:
    """What each camera and the LiDAR saw in frames that are ``step`` apart."""
    seen: dict[str, list[Sighting]] = {}
    for i, frame in enumerate(frames):
        given = detections(frame)
        if given is None:
            continue
        boxes = given[0].with_classes(class_names)
        group = i if step >= CORRELATED else i // CORRELATED
        for view in frame.cameras:
            if view.name in given[1]:
                found = given[1][view.name].with_classes(class_names)
                seen.setdefault(view.name, []).append(Sighting.of(view, boxes, found, group=group))
    return seen


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

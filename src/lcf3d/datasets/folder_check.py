"""Sanity rules of a plain folder: do its sensors stand to each other as ``sensors.yaml`` says?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.base import CameraSource, LidarSource
from lcf3d.datasets.check import Finding, check_frames
from lcf3d.datasets.folder_poses import (
    AXES,
    UPRIGHT,
    agreement,
    axes_of,
    filled_share,
    ground_of,
    label_axes_shares,
    pose_guesses,
    uprightness,
)
from lcf3d.datasets.folder_results import KITTI, FolderLabels
from lcf3d.datasets.folder_sensors import Sensors, canonical_from_axes
from lcf3d.errors import DatasetError, Lcf3dError
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import Camera, FloatArray

RULES = {
    "FLD01": "every file of every sensor belongs to a frame",
    "FLD02": "cameras stand upright, and boxes meet 2D boxes and points, with their poses as they are (else a likely "
    "mistake is looked for)",
    "FLD03": "the ground of the scans lies below the LiDAR",
    "FLD04": "labels hold points in their axes as they are",
    "FLD05": "the classes of the labels are among the classes of sensors.yaml",
    "FLD06": "intensities lie between 0 and 1",
}
SAMPLE = 10
"""Frames that are looked at for poses and axes, evenly over the folder."""

# a pose is doubted below this agreement, and explained by one that agrees as much better
_POOR, _BETTER = 0.3, 2.0
_ABOVE_M = 0.5
# guesses that agree so much alike cannot be told apart
_ALIKE = 0.02


class FolderFrames(Protocol):
    """What the rules ask of a plain folder."""

    ids: tuple[str, ...]
    class_names: tuple[str, ...]
    sensors: Sensors
    root: Path
    unmatched: dict[str, int]

    @property
    def labels_from(self) -> FolderLabels | None:
        """Where the labels come from."""
        ...

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras."""
        ...

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id."""
        ...

    def lidar_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
        """3D detections."""
        ...

    def camera_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> CameraSource:
        """2D detections."""
        ...


class _Evidence(NamedTuple):
    """What the sampled frames hold: points, 3D boxes, and 2D boxes by camera."""

    ids: list[str]
    points: list[NDArray[np.float32]]
    boxes: list[FloatArray]
    image_boxes: dict[str, list[FloatArray]]


def check_folder(
    dataset: FolderFrames, results: Path | None = None, progress: Callable[[], None] = lambda: None
) -> list[Finding]:
    """Everything that `RULES` find wrong, then the rules of every dataset.

    Args:
        dataset: the folder.
        results: detections, 2D or 3D, which the poses are held against too; or None.
        progress: called after every frame.
    """
    findings = [
        Finding("FLD01", "warning", f"{count} files of {what} belong to no frame")
        for what, count in dataset.unmatched.items()
    ]
    try:
        evidence = _gather(dataset, results)
    except Lcf3dError as error:
        frames = check_frames(dataset, results, progress)
        told = any(finding.id == "FRM01" for finding in frames)
        return [*findings, *([] if told else [Finding("FRM01", "error", str(error))]), *frames]
    ground = _check_ground(dataset, evidence)
    # with the ground in the wrong place, labels say nothing more
    labels = [] if ground else _check_labels(dataset, evidence)
    findings += ground + labels
    if not ground and not labels:
        findings += _check_poses(dataset, evidence)
    findings += _check_classes(dataset) + _check_intensity(evidence)
    return findings + check_frames(dataset, results, progress)


def _gather(dataset: FolderFrames, results: Path | None) -> _Evidence:
    count = min(SAMPLE, len(dataset.ids))
    ids = [dataset.ids[i] for i in np.linspace(0, len(dataset.ids) - 1, count).round().astype(int)]
    frames = [dataset.frame(frame_id) for frame_id in ids]
    found = _Evidence(ids, [], [], {camera.name: [] for camera in dataset.cameras})
    lidar, camera = _branches(dataset, results, frames[0])
    for frame in frames:
        found.points.append(np.zeros((0, 4), np.float32) if frame.points is None else frame.points)
        labels = frame.labels
        if labels is None and lidar is not None:
            labels = lidar.detect(frame)
        found.boxes.append(np.zeros((0, 7)) if labels is None else labels.boxes)
        for name, seen in found.image_boxes.items():
            seen.append(np.zeros((0, 4)) if camera is None else camera.detect(frame, name).boxes)
    return found


def _branches(
    dataset: FolderFrames, results: Path | None, frame: Frame
) -> tuple[LidarSource | None, CameraSource | None]:
    """The results as 3D detections, and the 2D labels, else the results, as 2D detections; None where they are not."""
    labels = None if dataset.sensors.labels_2d is None else dataset.root / dataset.sensors.labels_2d
    lidar: LidarSource | None = None
    camera: CameraSource | None = None
    try:
        if results is not None:
            lidar = dataset.lidar_results(results, dataset.class_names, "empty")
            lidar.detect(frame)
    except Lcf3dError:
        lidar = None
    try:
        path = labels or results
        if path is not None and dataset.cameras:
            camera = dataset.camera_results(path, dataset.class_names, "empty")
            camera.detect(frame, dataset.cameras[0].name)
    except Lcf3dError:
        if labels is not None:
            raise
        camera = None
    if results is not None and lidar is None and (camera is None or labels is not None):
        raise DatasetError(f"{results} holds neither 3D nor 2D detections of this folder")
    return lidar, camera


def _check_ground(dataset: FolderFrames, evidence: _Evidence) -> list[Finding]:
    """Rule FLD03, on the first LiDAR's axes."""
    seen = [ground for ground in map(ground_of, evidence.points) if ground is not None]
    if not seen:
        return []
    axis = int(np.bincount([a for a, _ in seen]).argmax())
    place = float(np.median([p for a, p in seen if a == axis]))
    if axis == 2 and place < _ABOVE_M:
        return []
    ours = canonical_from_axes(dataset.sensors.lidar_axes)
    normal = np.zeros(3)
    normal[axis] = -np.sign(place)
    fitting = [axes for axes in AXES if (canonical_from_axes(axes) @ ours.T @ normal)[2] > 0.5]
    where = "above the LiDAR" if axis == 2 else f"{abs(place):.1f} m to its {_side(axis, place)}"
    return [
        Finding(
            "FLD03",
            "error",
            f"the ground lies {where}: the scans' axes are not {dataset.sensors.lidar_axes}; "
            f"{' or '.join(fitting)} would put it below",
        )
    ]


def _side(axis: int, place: float) -> str:
    return ("front" if place > 0 else "back") if axis == 0 else ("left" if place > 0 else "right")


def _check_labels(dataset: FolderFrames, evidence: _Evidence) -> list[Finding]:
    """Rule FLD04: the axes that labels and points agree in."""
    source = dataset.labels_from
    given = filled_share(evidence.points, evidence.boxes)
    if source is None or source.form == KITTI or not given < _POOR:
        return []
    back = invert_rigid(source.lidar_from_labels)
    shares = label_axes_shares(evidence.points, [transform_boxes(boxes, back) for boxes in evidence.boxes])
    best = max(shares, key=lambda axes: shares[axes])
    if not shares[best] > max(_POOR, _BETTER * given):
        return []
    # the same turn, undone on the scans
    ours = canonical_from_axes(dataset.sensors.label_axes) @ canonical_from_axes(best).T
    lidar_axes = axes_of(ours @ canonical_from_axes(dataset.sensors.lidar_axes))
    return [
        Finding(
            "FLD04",
            "error",
            f"{given:.0%} of the near labels hold points, {shares[best]:.0%} would with 'label_axes: {best}'; or the "
            f"first LiDAR's axes are {lidar_axes}",
        )
    ]


def _check_poses(dataset: FolderFrames, evidence: _Evidence) -> list[Finding]:
    """Rule FLD02, camera by camera."""
    findings = []
    for number, camera in enumerate(dataset.cameras):
        score, measure = _scorer(dataset, evidence, camera, number == 0)
        given = score(camera.camera_from_lidar)
        if np.isnan(given):
            score, measure, given = uprightness, "image-up that points up", uprightness(camera.camera_from_lidar)
        poor = given < (UPRIGHT if score is uprightness else _POOR)
        if not poor:
            continue
        guesses = [
            (float(np.nan_to_num(score(guess.camera_from_lidar))), guess)
            for guess in pose_guesses(dataset.sensors, camera.name)
        ]
        best = max(value for value, _ in guesses)
        fitting = " or ".join(guess.words for value, guess in guesses if value > best - _ALIKE)
        asked = f"camera {camera.name}: {measure} {given:.2f} as its pose is"
        if best > max(UPRIGHT if score is uprightness else _POOR, _BETTER * given):
            findings.append(Finding("FLD02", "error", f"{asked}, {best:.2f} if {fitting}"))
        else:
            unexplained = f"{asked}, and no likely mistake explains it (best {best:.2f})"
            findings.append(Finding("FLD02", "warning", unexplained))
    return findings


def _scorer(
    dataset: FolderFrames, evidence: _Evidence, camera: Camera, first: bool
) -> tuple[Callable[[FloatArray], float], str]:
    """What tells a right pose of a camera from a wrong one, 0 to 1, and what it is called."""
    source = dataset.labels_from
    if first and source is not None and source.form == KITTI:
        # boxes in the first camera's frame follow its pose: the points say whether it is right
        def filled(pose: FloatArray) -> float:
            tried = replace(camera, camera_from_lidar=pose)
            ids = [frame_id for frame_id in evidence.ids if source.has(frame_id)]
            boxes = [source.detections(frame_id, [tried]).boxes for frame_id in ids]
            return filled_share([p for i, p in zip(evidence.ids, evidence.points, strict=True) if i in ids], boxes)

        return filled, "share of near labels that hold points"
    seen = evidence.image_boxes[camera.name]
    return lambda pose: agreement(camera, pose, evidence.boxes, seen), "overlap of boxes with 2D boxes"


def _check_classes(dataset: FolderFrames) -> list[Finding]:
    """Rule FLD05."""
    if dataset.labels_from is None:
        return []
    counts = dataset.labels_from.class_counts(dataset.ids)
    strange = {name: n for name, n in counts.items() if name not in dataset.class_names and name != "DontCare"}
    if not strange:
        return []
    names = ", ".join(f"{name} ({n})" for name, n in sorted(strange.items()))
    return [
        Finding(
            "FLD05",
            # labels of which nothing is taken are no labels
            "warning" if any(name in dataset.class_names for name in counts) else "error",
            f"labels of {names} are left out: the classes of sensors.yaml are {', '.join(dataset.class_names)}",
        )
    ]


def _check_intensity(evidence: _Evidence) -> list[Finding]:
    """Rule FLD06."""
    most = max((float(points[:, 3].max()) for points in evidence.points if len(points)), default=0.0)
    if most <= 1.5:
        return []
    scale = 1 / 255 if most <= 256 else 1 / 65535
    return [
        Finding(
            "FLD06",
            "warning",
            f"intensities go to {most:.0f}; networks expect 0 to 1: write 'intensity_scale: {scale:.6g}' for the LiDAR",
        )
    ]

"""What a run learns from a sample of its frames before the first one is fused: score calibration, classes reported.

The sample depends on the frames of the whole run alone, so that a part of it (``--shard``) learns the same from a few
hundred files and has no need to read those of all other parts.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
from lcf3d.detectors.joins import LeftOut
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import Alignment
from lcf3d.fusion.calibration import Calibration, load_calibration
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.self_calibration import self_calibrate
from lcf3d.run.alignment import aligned_frame, evenly
from lcf3d.run.joins import FEW_FRAMES
from lcf3d.run.sources import DetectorOnFrames, LidarOnScans, in_files
from lcf3d.structures import Detections2D

log = logging.getLogger(__name__)

TEACHING_FRAMES = 400
"""Frames that a run looks at beforehand, evenly over all of them."""
TEACHING_IMAGES = 40
"""The same where a camera detector has to be run on them."""

Looked = list[tuple[Frame, dict[str, Detections2D]]]


def teaching_frames(frame_ids: Sequence[str]) -> Sequence[str]:
    """The sample of a run's frames: at most `TEACHING_FRAMES`."""
    return evenly(frame_ids, TEACHING_FRAMES)[0]


def look(dataset: Dataset, frame_ids: Sequence[str], cameras: Mapping[str, CameraSource]) -> Looked:
    """The sample of some frames, and what the cameras that can be looked through detect in each."""
    chosen = teaching_frames(frame_ids)
    if not in_files(cameras):
        chosen = evenly(chosen, TEACHING_IMAGES)[0]
    looked = []
    for frame in map(dataset.frame, chosen):
        there = [c.name for c in frame.cameras if c.name in cameras and cameras[c.name].sees(frame, c.name)]
        looked.append((frame, {name: cameras[name].detect(frame, name) for name in there}))
    return looked


def look_in_files(dataset: Dataset, frame_ids: Sequence[str], cameras: Mapping[str, CameraSource]) -> Looked:
    """As `look` where all detections are in files; nothing else, for what a detector can report it says itself."""
    return look(dataset, frame_ids, cameras) if in_files(cameras) else []


def reported_classes(
    cameras: Mapping[str, CameraSource], config: FusionConfig, frames: int, looked: Looked
) -> dict[str, Sequence[str]]:
    """The classes that each camera's detector can report at all, where that is known.

    A detector says so (``reports``); of result files it is what they hold of the sample, if the run has enough frames
    to tell. Cameras of one source are taken together.
    """
    held: dict[int, set[str]] = {}
    for _, found in looked if frames >= FEW_FRAMES else ():
        for name, one in found.items():
            labels = set(one.labels.tolist())
            held.setdefault(id(cameras[name]), set()).update(one.class_names[label] for label in labels)
    reported: dict[str, Sequence[str]] = {}
    for name, source in cameras.items():
        reports = getattr(source, "reports", None)
        if reports is None and isinstance(getattr(source, "left_out", None), LeftOut):
            reports = held.get(id(source)) or None
        if reports is not None:
            reported[name] = tuple(c for c in config.class_names if c in set(reports))
    return reported


def find_calibration(
    wanted: str,
    dataset: Dataset,
    frame_ids: Sequence[str],
    lidar: LidarSource,
    cameras: Mapping[str, CameraSource],
    config: FusionConfig,
    alignment: Mapping[str, Alignment] | None = None,
    looked: Looked | None = None,
) -> Calibration | None:
    """The calibration of the file asked for, or one taught by the camera, where that is needed or costs nothing.

    Args:
        wanted: a file, ``none``, or ``auto``.
        dataset: whose frames they are.
        frame_ids: the frames of the run.
        lidar: the LiDAR branch.
        cameras: the camera branch by camera name.
        config: settings.
        alignment: how cameras stand beside what their calibration says, by name.
        looked: what `look` gave for these frames, where that is known.

    Raises:
        ConfigError: there is no such file.
    """
    if wanted != "auto":
        return load_calibration(wanted)
    if isinstance(lidar, (LidarOnScans, DetectorOnFrames)):
        return None
    boxes = {frame_id: lidar.detect(dataset.frame(frame_id)) for frame_id in teaching_frames(frame_ids)}
    scores = [found.scores for found in boxes.values() if len(found)]
    low, high = (min((float(s.min()) for s in scores), default=0.0), max((float(s.max()) for s in scores), default=0.0))
    probabilities = low >= 0 and high <= 1
    # probabilities need no map, but evidence also asks which classes the camera knows, which files tell at no cost
    if probabilities and not (config.ensemble == "evidence" and in_files(cameras) and len(frame_ids) >= FEW_FRAMES):
        return None
    looked = looked or look(dataset, frame_ids, cameras)
    if not probabilities:
        log.warning(
            "LiDAR scores go from %.4g to %.4g and are no probabilities: calibrated without labels on %d frames, with "
            "the camera as teacher; 'lcf3d calibrate' on labelled frames does better",
            low,
            high,
            len(looked),
        )
    teaching = [(aligned_frame(frame, alignment or {}), boxes[frame.id], found) for frame, found in looked if found]
    calibration = self_calibrate(teaching, config)
    if len(looked) < FEW_FRAMES:
        calibration = calibration.model_copy(update={"camera_classes": None})
    return calibration

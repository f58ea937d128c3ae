"""Detections of another tool, read from its result files: the detector kind ``results:PATH``."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.formats.coco import read_camera_detections
from lcf3d.formats.kitti import KittiObjects, detections_2d, detections_3d, read_folder
from lcf3d.structures import Detections2D, Detections3D, Frame

Missing = Literal["error", "empty"]


class KittiResults:
    """A folder of KITTI result files, one a frame, read whole so that a bad line stops a run before it starts.

    Args:
        folder: holds ``ID.txt`` for every frame; a folder written by ``lcf3d run`` (with ``data/``) will do.
        class_names: classes to take; detections of others are left out.
        missing: ``error`` refuses a folder that lacks frames, ``empty`` takes them as frames without detections.
    """

    def __init__(self, folder: str | Path, class_names: Sequence[str], missing: Missing = "error") -> None:
        path = Path(folder)
        if missing not in ("error", "empty"):
            raise ConfigError(f"missing results are taken as error or empty, got {missing!r}")
        self.folder = path / "data" if (path / "data").is_dir() else path
        self.class_names = tuple(class_names)
        self.missing: Missing = missing
        self._frames: dict[str, KittiObjects] = {}

    def load(self, frame_ids: Sequence[str]) -> None:
        """Read the files of these frames.

        Raises:
            DatasetError: the folder misses some of them; says how many and which first.
            FormatError: a line is malformed; names file and line.
        """
        frames = read_folder(self.folder, frame_ids, results=True, missing=self.missing)
        self._frames = dict(zip(frame_ids, frames, strict=True))

    def require_probabilities(self, calibrated: Collection[str]) -> None:
        """See that the scores that `load` has read lie in [0, 1], but for those of classes that are ``calibrated``.

        Raises:
            ConfigError: some do not; names the file.
        """
        for frame_id, objects in self._frames.items():
            if objects.scores is None:
                continue
            taken = np.isin(objects.class_names, [name for name in self.class_names if name not in calibrated])
            wrong = np.flatnonzero(taken & ~((objects.scores >= 0) & (objects.scores <= 1)))
            if len(wrong):
                score, name = objects.scores[wrong[0]], objects.class_names[wrong[0]]
                raise ConfigError(
                    f"{self.folder / frame_id}.txt: scores must lie in [0, 1], got {score:.4g} for a {name}; "
                    "fit a calibration with 'lcf3d calibrate' and pass --calibration FILE"
                )

    def objects(self, frame: Frame) -> KittiObjects:
        """The result lines of one frame, read now unless `load` has read them."""
        if frame.id not in self._frames:
            self.load([frame.id])
        return self._frames[frame.id]


class LidarResults(KittiResults):
    """3D detections of a LiDAR detector."""

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one frame in its LiDAR frame.

        Raises:
            DatasetError: the files hold detections, but none with a 3D box.
        """
        objects = self.objects(frame)
        if len(objects) and not objects.has_box3d.any():
            raise DatasetError(
                f"{self.folder / frame.id}.txt holds no 3D boxes: these are 2D results, pass them as the camera branch"
            )
        return detections_3d(objects, frame.cameras[0].camera_from_lidar, self.class_names)


class CameraResults(KittiResults):
    """2D detections of a camera detector."""

    def sees(self, frame: Frame, camera: str) -> bool:
        """Always: a frame without detections was looked at."""
        return True

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one frame, clipped to the image of ``camera``."""
        return _clipped(detections_2d(self.objects(frame), self.class_names), frame, camera)


class NuscenesLidarResults:
    """3D detections of a nuScenes submission file.

    Args:
        path: the JSON file.
        dataset: the samples they belong to.
        class_names: classes to take.

    Raises:
        FormatError: not a submission, or it lacks samples.
    """

    def __init__(self, path: str | Path, dataset: NuscenesDataset, class_names: Sequence[str]) -> None:
        self._frames = dataset.read_results(Path(path))
        self.class_names = tuple(class_names)

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one sample in its LiDAR frame."""
        return self._frames[frame.id].with_classes(self.class_names)


class NuscenesCameraResults:
    """2D detections of a JSON list by sample and camera (see ``lcf3d.formats.coco``), with masks where it has some.

    Args:
        path: the JSON file.
        class_names: classes to take.

    Raises:
        FormatError: not such a list; names the record.
    """

    def __init__(self, path: str | Path, class_names: Sequence[str]) -> None:
        self._found = read_camera_detections(Path(path), class_names)
        self._empty = Detections2D.empty(class_names)

    def sees(self, frame: Frame, camera: str) -> bool:
        """Always: a camera without detections looked and saw nothing."""
        return True

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one camera of one sample, clipped to its image."""
        return _clipped(self._found.get((frame.id, camera), self._empty), frame, camera)


def _clipped(found: Detections2D, frame: Frame, camera: str) -> Detections2D:
    view = frame.camera(camera)
    limits = np.array([view.width, view.height, view.width, view.height], dtype=np.float64)
    return Detections2D(np.clip(found.boxes, 0, limits), found.scores, found.labels, found.class_names, found.masks)

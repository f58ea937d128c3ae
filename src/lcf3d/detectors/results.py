"""Detections of another tool, read from KITTI result files: the detector kind ``results:DIR``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.formats.kitti import KittiFrames, KittiObjects, detections_2d, detections_3d, read_folder
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
        self.folder = path / "data" if (path / "data").is_dir() else path
        self.class_names = tuple(class_names)
        self.missing: Missing = missing
        self._frames: dict[str, KittiObjects] = {}

    def load(self, frame_ids: Sequence[str]) -> KittiFrames:
        """Read the files of these frames.

        Raises:
            DatasetError: the folder misses some of them; says how many and which first.
            FormatError: a line is malformed; names file and line.
        """
        frames = read_folder(self.folder, frame_ids, results=True, missing=self.missing)
        self._frames = dict(zip(frame_ids, frames, strict=True))
        return frames

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

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one frame, clipped to the image of ``camera``."""
        found = detections_2d(self.objects(frame), self.class_names)
        view = frame.camera(camera)
        limits = np.array([view.width, view.height, view.width, view.height], dtype=np.float64)
        return Detections2D(np.clip(found.boxes, 0, limits), found.scores, found.labels, found.class_names)

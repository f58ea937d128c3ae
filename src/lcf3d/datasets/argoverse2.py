"""Argoverse 2 Sensor data set: ring cameras, stereo pair, LiDAR sweeps, ego poses and annotations, without its package.

    ROOT/SPLIT/LOG/annotations.feather              cuboids by sweep (absent in the test split)
    ROOT/SPLIT/LOG/calibration/*.feather            intrinsics, egovehicle_SE3_sensor
    ROOT/SPLIT/LOG/city_SE3_egovehicle.feather      ego poses at the times of all sensors
    ROOT/SPLIT/LOG/sensors/lidar/TIME.feather       sweeps, both LiDARs joined, in the egovehicle frame
    ROOT/SPLIT/LOG/sensors/cameras/NAME/TIME.jpg    images, undistorted

A frame is a moment with a sweep or with annotations; its id is ``LOG_TIME`` with the time in nanoseconds. Its LiDAR
frame is the egovehicle frame at that time: x forward, y left, z up, origin at the middle of the rear axle. Each
camera's ``camera_from_lidar`` leads through the ego poses at both times, since images are not taken with the sweeps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lcf3d.datasets.argoverse2_frames import id_of, split_id
from lcf3d.datasets.argoverse2_log import CALIBRATION, Argoverse2Log, find_logs
from lcf3d.datasets.base import BaseDataset, CameraSource, LidarSource, ResultWriter, require_folder
from lcf3d.datasets.check import Finding
from lcf3d.datasets.images import ImageFiles
from lcf3d.errors import DatasetError
from lcf3d.formats.argoverse import Cuboids, read_sweep
from lcf3d.frame import Frame
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import ARGOVERSE_CLASSES, Camera, FloatArray

RING_CAMERAS = (
    "ring_front_center",
    "ring_front_left",
    "ring_front_right",
    "ring_side_left",
    "ring_side_right",
    "ring_rear_left",
    "ring_rear_right",
)
STEREO_CAMERAS = ("stereo_front_left", "stereo_front_right")

MAX_CAMERA_DELAY_S = 0.05
"""Longest accepted time between an image and its sweep: a ring camera takes one every 50 ms."""


class Argoverse2Dataset(BaseDataset):
    """Frames of an Argoverse 2 Sensor folder.

    Args:
        root: a folder of splits, one split, or one log.
        split: ``train``, ``val`` or ``test``: only the logs in a folder of that name; None for all.
        log: only this log.
        max_camera_delay_s: longest accepted time between an image and its frame; later images are left out.
        min_points: annotations with fewer LiDAR points are no labels (official evaluation: 1).

    Raises:
        DatasetError: no such log is there.
        FormatError: the annotations of a log are no feather file.
    """

    class_names = ARGOVERSE_CLASSES
    camera_names: tuple[str, ...] = (*RING_CAMERAS, *STEREO_CAMERAS)
    used_cameras: tuple[str, ...] = RING_CAMERAS
    stereo_pair = STEREO_CAMERAS
    preset = "argoverse2"
    evaluation = "lcf3d.evaluation.argoverse_task:ArgoverseEvaluation"

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        *,
        log: str | None = None,
        max_camera_delay_s: float = MAX_CAMERA_DELAY_S,
        min_points: int = 1,
    ) -> None:
        self.root = require_folder(Path(root).expanduser())
        self.split = split
        self.max_camera_delay_s = max_camera_delay_s
        self.min_points = min_points
        folders = find_logs(self.root)
        chosen = [f for f in folders if split in (None, f.parent.name) and log in (None, f.name)]
        if not chosen:
            splits = ", ".join(sorted({folder.parent.name for folder in folders})) or "none"
            wanted = f"{f' {log}' if log else ''}{f' of split {split!r}' if split else ''}"
            raise DatasetError(
                f"{self.root} holds no Argoverse 2 log{wanted}; expected ROOT/SPLIT/LOG/{CALIBRATION}; "
                f"logs found: {len(folders)}, splits: {splits}"
            )
        self._folders = {folder.name: folder for folder in chosen}
        self.log_ids = tuple(self._folders)
        # log by log in order of time
        self.ids = tuple(id_of(folder.name, int(time)) for folder in chosen for time in Argoverse2Log(folder).times())
        self._open = Argoverse2Log(chosen[0])

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether a folder looks like this layout."""
        return bool(find_logs(root))

    def log(self, log_id: str) -> Argoverse2Log:
        """The log of that id; the last one asked for stays in memory.

        Raises:
            DatasetError: there is none.
        """
        if log_id not in self._folders:
            raise DatasetError(f"{self.root} has no log {log_id!r}; its first is {self.log_ids[0]}")
        if self._open.id != log_id:
            self._open = Argoverse2Log(self._folders[log_id])
        return self._open

    def frame(self, frame_id: str) -> Frame:
        """The frame ``LOG_TIME``; sweep, images and labels are read when first asked for.

        Raises:
            DatasetError: no such log, or no ego pose at that time.
            FormatError: its calibration or poses are malformed.
        """
        log_id, time = split_id(frame_id)
        log = self.log(log_id)
        sweep = log.sweeps.get(time)
        if sweep is None and log.annotations is None:
            raise DatasetError(f"log {log_id} has no sweep at {time} ns")
        city_from_ego = log.city_from_ego(time)
        cameras, images = [], {}
        for name in self.camera_names:
            if name not in log.calibration.intrinsics:
                continue
            image = log.image(name, time, self.max_camera_delay_s)
            taken = time
            if image is not None:
                taken, images[name] = image
            cameras.append(_camera(log, name, log.city_from_ego(taken), city_from_ego))
        return Frame(
            frame_id,
            points=None if sweep is None else lambda: read_sweep(sweep),
            cameras=cameras,
            images=ImageFiles(images),
            labels=None if log.annotations is None else lambda: log.labels(time, self.min_points),
            timestamp=time * 1e-9,
            world_from_lidar=city_from_ego,
            sequence=log_id,
        )

    def has_image(self, frame_id: str, camera: str) -> bool:
        """Whether there is an image, without reading it."""
        log_id, time = split_id(frame_id)
        return self.log(log_id).image(camera, time, self.max_camera_delay_s) is not None

    def lidar_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
        """3D detections in the submission form, or of a run folder."""
        from lcf3d.datasets.argoverse2_results import ArgoverseLidarResults

        return ArgoverseLidarResults(path, self.ids, class_names, missing)

    def camera_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> CameraSource:
        """2D detections of a list by frame and camera (`lcf3d.formats.coco`)."""
        from lcf3d.datasets.nuscenes_results import NuscenesCameraResults

        return NuscenesCameraResults(path, class_names, self.camera_names, self.image_sizes())

    def writer(self, folder: Path) -> ResultWriter:
        """One file in the submission form."""
        from lcf3d.datasets.argoverse2_results import ArgoverseWriter

        return ArgoverseWriter(folder)

    def check(self, results: Path | None = None, progress: Callable[[], None] = lambda: None) -> list[Finding]:
        """The rules ``ARG``, then those of every dataset."""
        from lcf3d.datasets.argoverse2_check import check_argoverse2

        return check_argoverse2(self, results, progress)

    def ground_truth(self) -> Cuboids:
        """Annotations of all logs that have any."""
        found = [Argoverse2Log(folder).annotations for folder in self._folders.values()]
        return Cuboids.concatenate([part for part in found if part is not None])


def _camera(log: Argoverse2Log, name: str, city_from_camera_ego: FloatArray, city_from_ego: FloatArray) -> Camera:
    camera_from_ego = invert_rigid(log.calibration.ego_from_sensor[name])
    camera_from_lidar = camera_from_ego @ invert_rigid(city_from_camera_ego) @ city_from_ego
    projection = np.hstack([log.calibration.intrinsics[name], np.zeros((3, 1))])
    return Camera(name, projection, camera_from_lidar, *log.calibration.sizes[name])

"""``folder:ROOT``: images and scans in folders, described by ``sensors.yaml`` (`lcf3d.datasets.folder_sensors`).

A frame is a scan of the first LiDAR (without LiDARs, an image of the first camera) and is named like its file. Files of
the other sensors belong to it by name or by time. The LiDAR frame is the first LiDAR's, turned to forward-left-up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.base import BaseDataset, CameraSource, LidarSource, require_folder
from lcf3d.datasets.check import Finding
from lcf3d.datasets.folder_files import IMAGE_SUFFIXES, files_in, matched, times_of
from lcf3d.datasets.folder_results import FolderLabels, folder_camera_results, folder_lidar_results
from lcf3d.datasets.folder_sensors import CANONICAL_AXES, FILE, Sensors, read_by_frame, turn
from lcf3d.datasets.images import ImageFiles, image_size
from lcf3d.errors import DatasetError
from lcf3d.formats.point_files import SUFFIXES, read_scan
from lcf3d.frame import Frame, Sweep
from lcf3d.geometry.rotation import invert_rigid, rigid_transforms
from lcf3d.structures import Camera, Detections3D, FloatArray

# name of a sensor, folder and suffixes of its files, and where they are kept
_Files = tuple[str, Path, tuple[str, ...], dict[str, dict[str, Path]]]


class FolderDataset(BaseDataset):
    """Frames of a folder with a ``sensors.yaml``.

    Args:
        root: the folder.
        split: ``ROOT/ImageSets/SPLIT.txt``, frame names one a line; all frames without it.

    Raises:
        DatasetError: a folder or file that ``sensors.yaml`` names is absent, or fits no frame.
        ConfigError: ``sensors.yaml`` is not what it should be.
    """

    def __init__(self, root: Path | str, split: str | None = None) -> None:
        self.root = require_folder(Path(root).expanduser())
        self.sensors = Sensors.load(self.root)
        self.class_names = tuple(self.sensors.classes)
        self.camera_names = tuple(self.sensors.cameras)
        self._scans: dict[str, dict[str, Path]] = {}
        self._images: dict[str, dict[str, Path]] = {}
        self.unmatched: dict[str, int] = {}
        self._all_ids = self._join()
        self.ids = self._all_ids if split is None else self._listed(split)
        axes = self.sensors.lidar_axes
        if self.sensors.lidars and axes != CANONICAL_AXES:
            self.native_from_canonical = invert_rigid(turn(axes))

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether a folder has a ``sensors.yaml``."""
        return (root / FILE).is_file()

    def _join(self) -> tuple[str, ...]:
        """Files by sensor and frame; the frames are those of the first sensor."""
        kinds: list[_Files] = [
            (name, self.root / s.scans, SUFFIXES, self._scans) for name, s in self.sensors.lidars.items()
        ]
        kinds += [
            (name, self.root / s.images, IMAGE_SUFFIXES, self._images) for name, s in self.sensors.cameras.items()
        ]
        ids: tuple[str, ...] = ()
        for name, folder, suffixes, into in kinds:
            what = f"{'LiDAR' if into is self._scans else 'camera'} {name}"
            files = files_in(folder, suffixes, what)
            ids = ids or tuple(files)
            into[name], left = matched(ids, files, self.sensors.match, self.sensors.max_delay_s, what)
            if left:
                self.unmatched[what] = left
        return ids

    def _listed(self, split: str) -> tuple[str, ...]:
        path = self.root / "ImageSets" / f"{split}.txt"
        if not path.is_file():
            known = sorted(p.stem for p in path.parent.glob("*.txt"))
            raise DatasetError(f"{path} does not exist; the splits there are: {', '.join(known) or 'none'}")
        listed = tuple(dict.fromkeys(path.read_text(encoding="utf-8").split()))
        absent = sorted(set(listed) - set(self._all_ids))
        if absent or not listed:
            raise DatasetError(f"{path} names {len(absent)} frames that are not there, first {absent[:1] or 'none'}")
        return listed

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, of every frame the same."""
        found = []
        for name, setup in self.sensors.cameras.items():
            size = setup.size or image_size(next(iter(self._images[name].values())))
            found.append(self.sensors.camera(name, size))
        return tuple(found)

    @cached_property
    def labels_from(self) -> FolderLabels | None:
        """Where the labels come from, None without any."""
        if self.sensors.labels is None:
            return None
        return FolderLabels(self.root / self.sensors.labels, self.class_names, self.sensors.lidar_from_labels())

    @cached_property
    def times(self) -> dict[str, float]:
        """Seconds of the frames whose time is known: of the file, else of names that are times."""
        if self.sensors.timestamps is not None:
            path = self.root / self.sensors.timestamps
            rows = read_by_frame(path, self._all_ids, (1,), "times")
            return {frame_id: float(row[0]) for frame_id, row in rows.items()}
        if self.sensors.match == "time":
            found = times_of(self._all_ids)
            assert found is not None
            return dict(zip(self._all_ids, found.tolist(), strict=True))
        return {}

    @cached_property
    def poses(self) -> dict[str, FloatArray]:
        """(4, 4) ``world_from_lidar`` by frame, of the frames that the file has."""
        if self.sensors.poses is None:
            return {}
        rows = read_by_frame(self.root / self.sensors.poses, self._all_ids, (7, 12, 16), "poses")
        found = {}
        for frame_id, row in rows.items():
            if len(row) == 7:
                pose = rigid_transforms(row[None, 3:], row[None, :3])[0]
            else:
                pose = np.vstack([row.reshape(-1, 4), np.eye(4)[3:]])[:4]
            axes = self.sensors.lidars[next(iter(self.sensors.lidars))].axes if self.sensors.lidars else None
            found[frame_id] = pose @ self._pose_from_lidar(axes)
        return found

    def _pose_from_lidar(self, axes: str | None) -> FloatArray:
        """(4, 4) coordinates that the poses are of from the common LiDAR frame."""
        if self.sensors.poses_of == "ego":
            return self.sensors.ego_from_lidar()
        if axes is None:
            return np.eye(4)
        return invert_rigid(self.sensors.lidar_from_own(next(iter(self.sensors.lidars))))

    def points(self, frame_id: str) -> NDArray[np.float32]:
        """(N, 4) points of all LiDARs of a frame in its LiDAR frame.

        Raises:
            FormatError: a scan cannot be read.
        """
        parts = []
        for name, setup in self.sensors.lidars.items():
            path = self._scans[name].get(frame_id)
            if path is None:
                continue
            points = read_scan(path, setup.columns)
            turn = self.sensors.lidar_from_own(name).astype(np.float32)
            points[:, :3] = points[:, :3] @ turn[:3, :3].T + turn[:3, 3]
            points[:, 3] *= np.float32(setup.intensity_scale)
            parts.append(points)
        return np.concatenate(parts) if parts else np.zeros((0, 4), np.float32)

    def image_paths(self, frame_id: str) -> dict[str, Path]:
        """The image files of a frame by camera name."""
        return {name: files[frame_id] for name, files in self._images.items() if frame_id in files}

    def has_image(self, frame_id: str, camera: str) -> bool:
        """Whether there is an image, without reading it."""
        return frame_id in self._images[camera]

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id; scan, images and labels are read when first asked for.

        Raises:
            DatasetError: there is no such frame.
        """
        if not any(frame_id in files for files in (*self._scans.values(), *self._images.values())):
            raise DatasetError(f"{self.root} has no frame {frame_id!r}; its first is {self.ids[0]!r}")
        source = self.labels_from
        labels: Callable[[], Detections3D] | None = None
        if source is not None and source.has(frame_id):
            labels = lambda: source.detections(frame_id, self.cameras)  # noqa: E731
        return Frame(
            frame_id,
            points=(lambda: self.points(frame_id)) if self.sensors.lidars else None,
            cameras=self.cameras,
            images=ImageFiles(self.image_paths(frame_id)),
            labels=labels,
            timestamp=self.times.get(frame_id),
            world_from_lidar=self.poses.get(frame_id),
            sequence=self.root.name if self.times or self.poses else None,
            sweeps=(lambda count: self._sweeps(frame_id, count)) if self.times and self.poses else None,
        )

    def _sweeps(self, frame_id: str, count: int) -> list[Sweep]:
        """The scans before a frame whose time and pose are known, the latest first."""
        place = self._all_ids.index(frame_id)
        if frame_id not in self.times or frame_id not in self.poses:
            return []
        lidar_from_world = invert_rigid(self.poses[frame_id])
        earlier = [i for i in reversed(self._all_ids[:place]) if i in self.times and i in self.poses][:count]
        return [
            Sweep(self.points(i), lidar_from_world @ self.poses[i], self.times[frame_id] - self.times[i])
            for i in earlier
        ]

    def lidar_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
        """3D detections as KITTI text, parquet or JSON of our own, or of a run folder."""
        return folder_lidar_results(path, class_names, missing)

    def camera_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> CameraSource:
        """2D detections as KITTI text, COCO JSON, parquet or JSON of our own."""
        index = None if self.sensors.coco_index is None else self.root / self.sensors.coco_index
        images = {str(p): (i, name) for name, files in self._images.items() for i, p in files.items()}
        return folder_camera_results(path, class_names, missing, index, images)

    def describe(self) -> list[str]:
        """Frames, sensors and their places, times, poses and labels."""
        from lcf3d.datasets.folder_text import describe_folder

        return describe_folder(self)

    def check(self, results: Path | None = None, progress: Callable[[], None] = lambda: None) -> list[Finding]:
        """The rules ``FLD``, then those of every dataset."""
        from lcf3d.datasets.folder_check import check_folder

        return check_folder(self, results, progress)

"""KITTI object layout: ``ROOT/training/{calib,image_2,image_3,velodyne,label_2}`` and ``ROOT/ImageSets/SPLIT.txt``.

Any subset of the sensor folders may be there. Frames cut from a raw drive may keep the calibration of its day
(``calib_cam_to_cam.txt`` and ``calib_velo_to_cam.txt`` in ``training/calib``, ``training`` or the root) for all of
them. Camera ``left`` is the left colour camera (``image_2``, ``P2``) and ``right`` the right one (``image_3``, ``P3``).
The LiDAR frame is the Velodyne's: x forward, y left, z up already.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.base import BaseDataset, CameraSource, LidarSource, ResultWriter, require_folder
from lcf3d.datasets.check import Finding
from lcf3d.datasets.images import ImageFiles
from lcf3d.datasets.kitti_calibration import (
    CAMERAS,
    RAW_CAMERAS,
    KittiCalibration,
    cameras_of,
    parse_image_size,
    read_calibration,
    read_raw_calibration,
)
from lcf3d.datasets.kitti_sequences import FRAMES_PER_S, lidar_pose, sequence_of
from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import list_files
from lcf3d.formats.kitti import detections_3d, read_frame_ids, read_objects
from lcf3d.formats.kitti_drives import read_camera_poses
from lcf3d.formats.scans import read_scan, unit_intensity
from lcf3d.frame import Frame
from lcf3d.structures import KITTI_CLASSES, Detections3D, FloatArray

PARTS = ("training", "testing")
SCANS = (".bin", ".npy")
IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".ppm")


def read_points(path: Path) -> NDArray[np.float32]:
    """(N, 4) float32 ``x, y, z, reflectance`` (0 to 1) of a ``.bin`` or ``.npy`` scan, see `lcf3d.formats.scans`.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it is cut off or no scan, or holds NaN or infinite values.
    """
    points = np.ascontiguousarray(read_scan(path)[:, :4])
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise FormatError(f"{path} holds {bad} points with NaN or infinite values; remove them first")
    return unit_intensity(points, path)


def is_tracking(root: Path) -> bool:
    """Whether a folder has the layout of the tracking benchmark, which also begins with ``training``."""
    return any(
        any(path.is_dir() for path in list_files(root / part / folder))
        for part in PARTS
        for folder in ("image_02", "image_03", "velodyne")
    ) or any((root / part / "label_02").is_dir() and not (root / part / "label_2").is_dir() for part in PARTS)


class KittiLikeDataset(BaseDataset):
    """What KITTI's layouts have in common: the cameras, and results as text files, one a frame."""

    camera_names = tuple(name for name, _, _ in CAMERAS)
    used_cameras = ("left",)
    stereo_pair = ("left", "right")
    preset = "kitti"

    @abstractmethod
    def image_paths(self, frame_id: str) -> dict[str, Path]:
        """The image files of a frame that are there, by camera name."""

    def has_image(self, frame_id: str, camera: str) -> bool:
        """Whether there is an image, without reading it."""
        return camera in self.image_paths(frame_id)

    def lidar_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
        """3D detections of KITTI result files."""
        from lcf3d.datasets.kitti_results import KittiLidarResults

        return KittiLidarResults(Path(path), class_names, missing)

    def camera_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> CameraSource:
        """2D detections of KITTI result files."""
        from lcf3d.datasets.kitti_results import KittiCameraResults

        return KittiCameraResults(Path(path), class_names, missing)

    def writer(self, folder: Path) -> ResultWriter:
        """A KITTI result file a frame."""
        from lcf3d.datasets.kitti_results import KittiWriter

        return KittiWriter(folder)


class KittiDataset(KittiLikeDataset):
    """Frames of a KITTI-layout folder.

    Args:
        root: folder that holds ``training`` (or ``testing``) and, for splits, ``ImageSets``.
        split: name of a file in ``ImageSets`` (one frame id a line); None for all frames that have a calibration.
        part: ``training`` or ``testing``; without it the one that holds the frames of the split (``testing`` for splits
            whose name begins with ``test``, where both do).
        class_names: classes of the ground truth that frames give.
        image_size: (width, height), or ``WIDTHxHEIGHT``, of frames whose images are not there and whose calibration is
            none of KITTI's own.

    Raises:
        DatasetError: the folder or the split does not exist.
    """

    evaluation = "lcf3d.evaluation.kitti_task:KittiEvaluation"
    tracking = "lcf3d.evaluation.kitti_tracking:KittiTracking"

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        *,
        part: str | None = None,
        class_names: Sequence[str] = KITTI_CLASSES,
        image_size: tuple[int, int] | str | None = None,
    ) -> None:
        self.root = require_folder(Path(root).expanduser())
        self.class_names = tuple(class_names)
        self.default_image_size = parse_image_size(image_size)
        self.split = split
        self._poses_read: dict[str, FloatArray | None] = {}
        self._listed = () if split is None else read_frame_ids(self._split_path(split))
        self.folder = self.root / (part or self._part_of(self._listed))
        if not self.folder.is_dir():
            raise DatasetError(f"{self.root} has no folder {self.folder.name!r}; expected the KITTI object layout")

    @cached_property
    def ids(self) -> tuple[str, ...]:  # type: ignore[override]
        """The frames of the split; without one, all that have a calibration."""
        return self._all_ids() if self.split is None else self._listed

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether a folder looks like this layout."""
        return any((root / part).is_dir() for part in PARTS) and not is_tracking(root)

    def _part_of(self, listed: Sequence[str]) -> str:
        """The part that holds the frames of a split."""
        there = [part for part in PARTS if (self.root / part).is_dir()] or list(PARTS)
        if self.split is not None and self.split.lower().startswith("test"):
            there.reverse()
        # frames cut from a raw drive have no calibration files of their own
        names = ("calib/{}.txt", "velodyne/{}.bin", "image_2/{}.png")
        return max(
            there, key=lambda part: sum(any((self.root / part / n.format(i)).is_file() for n in names) for i in listed)
        )

    def _split_path(self, split: str) -> Path:
        path = self.root / "ImageSets" / f"{split}.txt"
        if not path.is_file():
            known = [p.stem for p in list_files(path.parent, ".txt")]
            raise DatasetError(f"{path} does not exist; the splits there are: {', '.join(known) or 'none'}")
        return path

    def _all_ids(self) -> tuple[str, ...]:
        ids: tuple[str, ...] = tuple(sorted(self._calibrated))
        if not ids and self._raw is not None:
            ids = tuple(sorted({*self._present["velodyne"], *self._present["image_2"]}))
        if not ids:
            raise DatasetError(f"{self.folder / 'calib'} holds no calibration files")
        return ids

    @cached_property
    def _calibrations(self) -> Path:
        return self.folder / "calib"

    @cached_property
    def _calibrated(self) -> frozenset[str]:
        """Frames that have a calibration file of their own."""
        return frozenset(p.stem for p in list_files(self.folder / "calib", ".txt") if not p.name.startswith("calib_"))

    @cached_property
    def _raw(self) -> tuple[KittiCalibration, dict[str, tuple[int, int]]] | None:
        """Calibration and image sizes of the recording day, for the frames that have none of their own."""
        folders = (self.folder / "calib", self.folder, self.root)
        found = next((folder for folder in folders if (folder / RAW_CAMERAS).is_file()), None)
        return None if found is None else read_raw_calibration(found)

    @cached_property
    def _present(self) -> dict[str, dict[str, Path]]:
        """Files by folder and frame id, listed once."""
        endings = {"velodyne": SCANS, "label_2": (".txt",), **{folder: IMAGES for _, folder, _ in CAMERAS}}
        return {name: {p.stem: p for p in list_files(self.folder / name, *ends)} for name, ends in endings.items()}

    def require_complete(self, frame_ids: Sequence[str]) -> None:
        """See that every frame has a calibration file, before any work begins.

        Raises:
            DatasetError: some have none; says how many and which first.
        """
        absent = [frame_id for frame_id in frame_ids if frame_id not in self._calibrated]
        if absent and self._raw is None:
            raise DatasetError(
                f"{self.folder / 'calib'} lacks {len(absent)} of {len(frame_ids)} frames, first {absent[0]}.txt; "
                "copy the calibration files or leave those frames out of the split"
            )

    def calibration(self, frame_id: str) -> KittiCalibration:
        """The calibration of a frame, or of the recording day where the frame has none of its own."""
        if self._raw is not None and frame_id not in self._calibrated:
            return self._raw[0]
        return read_calibration(self._calibrations / f"{frame_id}.txt")

    def image_paths(self, frame_id: str) -> dict[str, Path]:
        """The image files of a frame that are there, by camera name."""
        found = {name: self._present[folder].get(frame_id) for name, folder, _ in CAMERAS}
        return {name: path for name, path in found.items() if path is not None}

    def check(self, results: Path | None = None, progress: Callable[[], None] = lambda: None) -> list[Finding]:
        """The rules ``KIT``."""
        from lcf3d.datasets.kitti_check import check_kitti

        return check_kitti(self, results, progress)

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id; scan, images and labels are read when first asked for.

        Raises:
            DatasetError: its calibration is missing.
            FormatError: its calibration is malformed.
        """
        calibration = self.calibration(frame_id)
        images = self.image_paths(frame_id)
        scan, label = self._present["velodyne"].get(frame_id), self._present["label_2"].get(frame_id)

        def labels() -> Detections3D:
            assert label is not None
            return detections_3d(read_objects(label, results=False), calibration.camera_from_lidar, self.class_names)

        sequence, number = sequence_of(frame_id)
        poses = None if sequence is None else self._poses(sequence)
        return Frame(
            frame_id,
            points=(lambda: read_points(scan)) if scan else None,
            cameras=cameras_of(calibration, images, self._raw[1] if self._raw else {}, self.default_image_size),
            images=ImageFiles(images),
            labels=labels if label else None,
            timestamp=None if sequence is None else number / FRAMES_PER_S,
            world_from_lidar=None if poses is None else lidar_pose(poses, number, calibration.camera_from_lidar),
            sequence=sequence,
        )

    def _poses(self, sequence: str) -> FloatArray | None:
        """(F, 4, 4) first camera from the camera of each frame of a sequence, read once; None without the file."""
        if sequence not in self._poses_read:
            path = self.root / "poses" / f"{sequence}.txt"
            self._poses_read[sequence] = read_camera_poses(path) if path.is_file() else None
        return self._poses_read[sequence]
